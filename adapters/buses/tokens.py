"""A run's token: what proves who somebody is, where no certificates do.

It is a file with a line ``role:secret`` for each role, which is also how Zenoh takes it. Knowledge makes it; whoever
can read it may be any of the roles. It stands in the user's own runtime folder under the name of the endpoint, so that
the other processes of the same user find it by themselves. There it stays: a Knowledge that is started again takes the
same, and who waits for it is let in. A secret is never sent: in `Wire.proof`, as in Zenoh's own authentication of
users, a random challenge is answered by a keyed hash.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
import tempfile
from collections.abc import Iterable, Iterator
from hashlib import sha256
from pathlib import Path
from urllib.parse import quote, unquote

from adapters.buses import endpoints
from mape.errors import BusError, ConfigError
from mape.ownership import not_ones_own

_SUFFIX = ".token"
_LONGEST_NAME = 200  # of a file, whose name most file systems limit to 255 bytes


class NoToken(BusError):
    """There is no token, or not yet."""


def make(endpoint: str, roles: Iterable[str], given: Path | None = None) -> Path:
    """Return the file of an endpoint's token, made if it is not there yet.

    Parameters
    ----------
    endpoint, roles
        Where Knowledge listens, and for whom there is a secret.
    given
        The file that the user names; None for the one in the runtime folder.

    Raises
    ------
    ConfigError
        What is there is not the user's alone, or no token; or none can be made.
    """
    path = given or _runtime_folder() / _name(endpoint)
    with contextlib.suppress(FileNotFoundError):
        _read(path)
        return path
    if given is None:
        _forget_left_behind(path.parent)
    try:
        _write(path, "".join(f"{role}:{secrets.token_urlsafe(32)}\n" for role in roles))
    except OSError as error:
        raise ConfigError(f"the run's token {path} cannot be made: {error.strerror or error}") from error
    return path


def find(endpoint: str, given: Path | None = None) -> Path:
    """Return the file of the token of an endpoint.

    Raises
    ------
    NoToken
        There is none.
    """
    name = _name(endpoint)
    candidates = [given] if given is not None else [folder / name for folder in _folders()]
    for path in candidates:
        if os.path.lexists(path):
            return path
    raise NoToken(
        f"there is no token {candidates[0]}: Knowledge makes it where it is started; from another user or machine, "
        "give the file of its token as --token FILE"
    )


def secret(path: Path, role: str) -> str:
    """Return the secret of a role.

    Raises
    ------
    ConfigError
        The file is not the user's alone, or holds none for the role.
    """
    try:
        known = _read(path)
    except FileNotFoundError:
        raise NoToken(f"there is no token {path}") from None
    if role not in known:
        raise ConfigError(f"the token {path} holds no line for {role}; it has {', '.join(known) or 'none'}")
    return known[role]


def forget(endpoint: str) -> None:
    """Remove the token of an endpoint that will not be listened on again."""
    for folder in _folders():
        with contextlib.suppress(OSError):
            (folder / _name(endpoint)).unlink()


def _folders() -> Iterator[Path]:
    if base := os.environ.get("XDG_RUNTIME_DIR"):
        yield Path(base, "mapek")
    yield Path(tempfile.gettempdir(), f"mapek-run-{os.getuid()}")


def _runtime_folder() -> Path:
    why = ""
    for folder in _folders():
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
            # Anybody may have made the one with a name that can be guessed.
            foreign = f"{folder} is a link" if folder.is_symlink() else not_ones_own(folder, 0o700)
        except OSError as error:
            foreign = f"{folder} cannot be made: {error.strerror or error}"
        if foreign is None:
            return folder
        why = why or foreign
    raise ConfigError(
        f"no folder can hold the run's token: {why}. Let XDG_RUNTIME_DIR name a folder of your own, mode 700; or give "
        "the token a place, --token FILE"
    )


def _name(endpoint: str) -> str:
    if endpoint.startswith(endpoints.UNIX):
        whole = endpoints.UNIX + os.path.realpath(endpoint.removeprefix(endpoints.UNIX))
    else:
        whole = endpoints.reached(endpoint, keys=False).replace("/localhost:", "/127.0.0.1:")
    name = quote(whole, safe="")
    return (name if len(name) <= _LONGEST_NAME else sha256(whole.encode()).hexdigest()) + _SUFFIX


def _forget_left_behind(folder: Path) -> None:
    """Remove the tokens of sockets whose folder is gone, and with it whoever listened there."""
    for path in folder.glob(f"{quote(endpoints.UNIX, safe='')}*{_SUFFIX}"):
        socket = Path(unquote(path.name.removesuffix(_SUFFIX)).removeprefix(endpoints.UNIX))
        if not socket.parent.exists():
            path.unlink(missing_ok=True)


def _write(path: Path, text: str) -> None:
    # Whole or not at all, and never in the place of what somebody else has made meanwhile.
    file, name = tempfile.mkstemp(dir=path.parent, suffix=".tmp")  # mode 600
    try:
        with open(file, "w", encoding="utf-8") as opened:
            opened.write(text)
        with contextlib.suppress(FileExistsError):
            os.link(name, path)
    finally:
        os.unlink(name)
    _read(path)


def _read(path: Path) -> dict[str, str]:
    """Return role -> secret.

    Raises
    ------
    FileNotFoundError
        There is no such file.
    ConfigError
        It is not the user's alone, or no token.
    """
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), encoding="utf-8") as opened:
            about = os.fstat(opened.fileno())
            if not stat.S_ISREG(about.st_mode) or about.st_uid != os.getuid() or about.st_mode & 0o077:
                raise ConfigError(
                    f"the token {path} is not yours alone: it has to be a file of the user {os.getuid()} with mode "
                    f"600, and is one of {about.st_uid} with mode {about.st_mode & 0o777:o}. Who else can read it may "
                    "be any of the roles; remove it, and start Knowledge anew"
                )
            lines = [line.partition(":") for line in opened.read(1 << 16).splitlines()]
    except FileNotFoundError:
        raise
    except (OSError, UnicodeError) as error:
        raise ConfigError(f"the token {path} cannot be read: {error}") from error
    if not lines or not all(role and len(value) >= 32 for role, _, value in lines):
        raise ConfigError(f"{path} is no token: it has a line role:secret for each role. Remove it, or name another")
    return {role: value for role, _, value in lines}
