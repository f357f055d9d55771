"""Keys and certificates of one deployment: a certificate authority of its own, and a certificate for each role.

    ca.pem, ca.key              the authority; its key signs renewals, and no process of a run needs it
    <role>.pem, <role>.key      a pair for each role; the common name of the certificate is the role

Whoever holds the key of a role is that role, and whoever holds the authority's key may be any. A host needs ``ca.pem``
and the pairs of its own roles; ``ca.key`` stays where renewals are made.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from adapters.buses.security import AUTHORITY, ROLES
from adapters.roles import KNOWLEDGE
from mape.errors import ConfigError, UnknownName

if TYPE_CHECKING:
    from adapters.buses.signing import Pem

DEFAULT_DAYS = 365
"""How long a certificate is good."""

AUTHORITY_DAYS = 3650
"""How long a certificate authority is good; no certificate outlives it."""

LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")
"""What Knowledge is always reached as, on its own host."""

# The clock of another host may be behind the one by which a certificate was made.
_EARLIER = timedelta(minutes=5)

_LABEL = "[a-z0-9_]([a-z0-9_-]{0,61}[a-z0-9_])?"
_NAME = re.compile(rf"(?=.{{1,253}}\Z){_LABEL}(\.{_LABEL})*", re.IGNORECASE)


def make(
    folder: Path, hosts: Iterable[str] = (), days: int = DEFAULT_DAYS, *, start: datetime | None = None
) -> list[Path]:
    """Make a certificate authority, and a key and a certificate for each role.

    Keys are ECDSA P-256, as PKCS#8. Knowledge's certificate is good for being connected to, under `hosts` and
    `LOCAL_HOSTS`, and those of the other roles for connecting. So no other role's key can stand in for Knowledge.

    Parameters
    ----------
    folder
        New, or empty; from then on only its owner can look into it.
    hosts
        Further names and IP addresses under which Knowledge is reached.
    days
        How long the certificates are good, from 1 to `AUTHORITY_DAYS`.
    start
        From when on, with its time zone; by default from now.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    ConfigError
        The folder is neither new nor empty, or cannot be written; a host or the number of days is not legal;
        `cryptography` is not installed. Nothing is left behind.
    """
    _need_cryptography()
    from adapters.buses import signing

    hosts = _checked_hosts(hosts)
    begin, end = _span(days, start)
    authority = signing.Authority.new(*_span(AUTHORITY_DAYS, start))
    files: dict[str, bytes] = {}
    for role in ROLES:
        files |= _files(role, authority.sign(role, _hosts_for(role, hosts), begin, end))
    # The authority's certificate comes last: a folder whose making was cut short is of no use to anybody.
    files |= _files(AUTHORITY, authority.pem)
    with _writing(folder), _empty(folder):
        folder.chmod(0o700)
        return _write(folder, files)


def renew(
    folder: Path, role: str, hosts: Iterable[str] = (), days: int = DEFAULT_DAYS, *, start: datetime | None = None
) -> list[Path]:
    """Make a new key and a new certificate for one role, signed by the authority that is in the folder.

    The old certificate is good until it expires, for nobody can be told that it should not be: after a theft make all
    keys anew.

    Parameters
    ----------
    folder
        Holds ``ca.pem`` and ``ca.key``.
    role
        Whose pair is replaced, or made where it is missing.
    hosts
        As in `make`, and for Knowledge only; those of its old certificate are kept.
    days, start
        As in `make`.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    UnknownName
        There is no such role.
    ConfigError
        The authority cannot be read, or has expired; and as in `make`.
    """
    _need_cryptography()
    from adapters.buses import signing

    if role not in ROLES:
        raise UnknownName("role", role, ROLES)
    hosts = _checked_hosts(hosts)
    if hosts and role != KNOWLEDGE:
        raise ConfigError(
            f"hosts are those of {KNOWLEDGE}, which others connect to; {role} only connects, and has none"
        )
    begin, end = _span(days, start)
    try:
        key, certificate = ((folder / f"{AUTHORITY}{ending}").read_bytes() for ending in (".key", ".pem"))
        authority = signing.Authority(signing.Pem(key, certificate))
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(
            f"the authority of {folder} cannot be read ({error}). Renew where {AUTHORITY}.key and {AUTHORITY}.pem are; "
            "without them make all keys anew: `mapek keys DIR`, in a new folder"
        ) from error
    if authority.end <= begin:
        raise ConfigError(
            f"the authority of {folder} expired on {authority.end:%Y-%m-%d}; make all keys anew: `mapek keys DIR`, in "
            "a new folder"
        )
    # There is nothing to be kept of a certificate that is missing or damaged.
    with contextlib.suppress(OSError, ValueError):
        hosts += signing.hosts_of((folder / f"{role}.pem").read_bytes())
    with _writing(folder):
        return _write(folder, _files(role, authority.sign(role, _hosts_for(role, hosts), begin, end)))


def _need_cryptography() -> None:
    try:
        import cryptography  # noqa: F401
    except ImportError:
        raise ConfigError(
            "keys are made by the library cryptography, which is not installed: pip install cryptography"
        ) from None


def _span(days: int, start: datetime | None) -> tuple[datetime, datetime]:
    if not 1 <= days <= AUTHORITY_DAYS:
        raise ConfigError(f"{days} days: a certificate is good for 1 to {AUTHORITY_DAYS:,} days")
    start = start or datetime.now(UTC)
    return start - _EARLIER, start + timedelta(days=days)


def _checked_hosts(hosts: Iterable[str]) -> list[str]:
    found = []
    for host in hosts:
        try:
            found.append(str(ipaddress.ip_address(host)))
        except ValueError:
            # A name that ends in a number would be taken for an address that is none.
            if not _NAME.fullmatch(host) or host.rpartition(".")[2].isdecimal():
                raise ConfigError(
                    f"host {host!r} is neither an IP address nor a name, such as 192.0.2.7 or knowledge.example.org, "
                    "without protocol and port"
                ) from None
            found.append(host.lower())
    return found


def _hosts_for(role: str, hosts: Iterable[str]) -> list[str]:
    return list(dict.fromkeys((*LOCAL_HOSTS, *hosts))) if role == KNOWLEDGE else []


def _files(name: str, pem: Pem) -> dict[str, bytes]:
    return {f"{name}.key": pem.key, f"{name}.pem": pem.certificate}


@contextlib.contextmanager
def _writing(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ConfigError(
            f"keys cannot be written to {folder}: {error.strerror or error}. Make that possible, or name another folder"
        ) from error


@contextlib.contextmanager
def _empty(folder: Path) -> Iterator[None]:
    """Have an empty folder, and leave it, or none, as it was before if what is done with it fails."""
    new = not folder.exists()
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    names = sorted(path.name for path in folder.iterdir())
    if any(f"{name}{ending}" in names for name in (AUTHORITY, *ROLES) for ending in (".key", ".pem")):
        raise ConfigError(
            f"{folder} holds keys already, and they are not overwritten: `mapek keys {folder} --renew ROLE` makes new "
            "ones for a role; or name a new folder"
        )
    if names:
        raise ConfigError(f"{folder} holds other files, such as {names[0]}; name a new folder, or an empty one")
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            for path in folder.iterdir():
                path.unlink()
            if new:
                folder.rmdir()
        raise


def _write(folder: Path, files: Mapping[str, bytes]) -> list[Path]:
    """Write all files apart, and then move each to its place; a key is its owner's only from the first byte."""
    with tempfile.TemporaryDirectory(dir=folder, prefix=".new-") as apart:
        for name, text in files.items():
            mode = 0o600 if name.endswith(".key") else 0o644
            with open(os.open(Path(apart, name), os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
        return [Path(apart, name).replace(folder / name) for name in files]
