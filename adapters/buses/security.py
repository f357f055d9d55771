"""Who may say what on the wire: keys or a token say who somebody is, an access-control list what that role may do.

Knowledge is the router that all others connect to, so its list is the only one there is. `RIGHTS` is that list as
people read it; whatever is not in it is denied. Knowledge's own session is the router's, and no list holds for it.

A denial is silent: a put is dropped, a query gets no reply, and whoever sent it learns nothing. Knowledge's process
can have each of them logged; see `log_refusals`.
"""

from __future__ import annotations

import contextlib
import os
import ssl
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from adapters.roles import KNOWLEDGE, OPERATOR
from adapters.roles import ROLES as STAGES
from mape.errors import ConfigError, UnknownName
from mape.near import did_you_mean, nearest_path

CLIENTS = (*STAGES, OPERATOR)
"""The roles that connect to Knowledge."""

ROLES = (KNOWLEDGE, *CLIENTS)
"""All who have a certificate. Its common name is the role, and nothing else."""

AUTHORITY = "ca"
"""What the files of the certificate authority are called, beside those that are called as the roles."""


class Right(NamedTuple):
    """That some roles may do something on a key expression; ``{role}`` in it stands for the role's own name."""

    verb: str
    key: str
    roles: tuple[str, ...]


RIGHTS = (
    Right("subscribe", "mape/*/*/execute", ("monitor",)),
    Right("subscribe", "mape/*/*/monitor", ("analyze",)),
    Right("subscribe", "mape/*/*/analyze", ("plan",)),
    Right("subscribe", "mape/*/*/plan", ("execute",)),
    Right("subscribe", "mape/*/*/*", (OPERATOR,)),
    Right("query", "mape/*/*/append/{role}", STAGES),
    Right("query", "mape/*/knowledge/join/{role}", STAGES),
    Right("query", "mape/*/knowledge/snapshot/{role}", STAGES),
    Right("query", "mape/*/knowledge/piece/{role}", STAGES),
    Right("query", "mape/*/knowledge/swapped/{role}", STAGES),
    Right("query", "mape/*/knowledge/event/{role}", STAGES),
    Right("query", "mape/*/knowledge/remember/plan", ("plan",)),
    Right("query", "mape/*/knowledge/since", CLIENTS),
    Right("query", "mape/*/knowledge/table", ("plan", "execute", OPERATOR)),
    Right("query", "mape/*/knowledge/status", CLIENTS),
    Right("query", "mape/*/knowledge/swap", (OPERATOR,)),
    Right("answer", "mape/*/control/{role}", STAGES),
    Right("publish", "mape/*/knowledge/beat/{role}", STAGES),
    Right("be seen", "mape/*/alive/{role}/*", STAGES),
    Right("see", "mape/*/alive/**", CLIENTS),
)
"""Everything that a client may do. No client may put anything into a stream of records: that is Knowledge's."""

# Verb -> flow -> messages: what the router takes from a client, and what it hands to it. For Zenoh an undeclaration
# counts as the declaration that it takes back.
_MESSAGES: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "subscribe": {"ingress": ("declare_subscriber",), "egress": ("put",)},
    "query": {"ingress": ("query",), "egress": ("reply",)},
    "answer": {"ingress": ("declare_queryable", "reply"), "egress": ("query",)},
    "publish": {"ingress": ("put",)},
    "be seen": {"ingress": ("liveliness_token",)},
    "see": {"ingress": ("liveliness_query", "declare_liveliness_subscriber"), "egress": ("liveliness_token",)},
}

# Knowledge's and others' declarations: a client sends only what it knows to be wanted. They tell keys, and no values.
_TOLD = ("declare_subscriber", "declare_queryable")


def access_control(proven_by: str = "cert_common_names") -> dict[str, Any]:
    """Return Knowledge's ``access_control`` for Zenoh's config: `RIGHTS`, and else nothing.

    A role is known by the common name of its certificate, or, with a token, by its user name: ``usernames``.

    Nothing is ever denied by a rule, only by default: a rule holds for the keys that its own key includes, so a
    wildcard that reaches beyond it slips past a rule that denies, and is not let through by a rule that allows.
    """
    rules = {role: _rules(role) for role in CLIENTS}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for of_role in rules.values() for rule in of_role],
        "subjects": [{"id": role, proven_by: [role]} for role in CLIENTS],
        "policies": [
            {"rules": [rule["id"] for rule in of_role], "subjects": [role]} for role, of_role in rules.items()
        ],
    }


def _rules(role: str) -> list[dict[str, Any]]:
    rules = [_rule(role, "be told", "egress", _TOLD, ["mape/**"])]
    for verb, flows in _MESSAGES.items():
        keys = [right.key for right in RIGHTS if right.verb == verb and role in right.roles]
        for flow, messages in flows.items():
            # What is handed out answers what was taken in, and was held against the role's own name then.
            name = role if flow == "ingress" else "*"
            if keys:
                rules.append(_rule(role, verb, flow, messages, [key.format(role=name) for key in keys]))
    return rules


def _rule(role: str, verb: str, flow: str, messages: tuple[str, ...], keys: list[str]) -> dict[str, Any]:
    return {
        "id": f"{role}: {verb}, {flow}",
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": keys,
    }


def tls(folder: Path, role: str) -> dict[str, Any]:
    """Return ``transport/link`` for Zenoh's config: mutual TLS under the certificate of `role`, and no other link.

    What Zenoh would only answer with a timeout is looked at before: the certificate is shown to the authority in a
    handshake within this process.

    Parameters
    ----------
    folder
        What `adapters.buses.certificates.make` has made, or the part of it that is this host's: ``ca.pem``,
        ``<role>.pem``, ``<role>.key``.
    role
        One of `ROLES`.

    Raises
    ------
    UnknownName
        There is no such role.
    ConfigError
        A file is missing or unreadable; the certificate is not good today, not that of this role, not signed by the
        authority, or not that of the key.
    """
    if role not in ROLES:
        raise UnknownName("role", role, ROLES)
    folder = folder.absolute()  # Zenoh's paths are relative to the folder in which the process stands
    authority, certificate, key = authority_of(folder), folder / f"{role}.pem", folder / f"{role}.key"
    for path in (authority, certificate, key):
        _check_readable(path)
    _check_certificates(authority, certificate, key, role)
    side = "listen" if role == KNOWLEDGE else "connect"
    return {
        "protocols": ["tls"],
        "tls": {
            "root_ca_certificate": str(authority),
            f"{side}_certificate": str(certificate),
            f"{side}_private_key": str(key),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        },
    }


def authority_of(folder: Path) -> Path:
    """Return the file of the authority's certificate."""
    return folder.absolute() / f"{AUTHORITY}.pem"


def check_host(folder: Path, host: str) -> None:
    """Look whether Knowledge's certificate is good for being reached as `host`, a name or an address.

    Raises
    ------
    ConfigError
        It names others, or does not hold.
    """
    server, client = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    server.load_cert_chain(folder / f"{KNOWLEDGE}.pem", folder / f"{KNOWLEDGE}.key", password="")
    client.load_verify_locations(authority_of(folder))
    try:
        _shake_hands(server, client, host)
    except ssl.SSLCertVerificationError as error:
        raise ConfigError(
            f"{folder / f'{KNOWLEDGE}.pem'} does not let {KNOWLEDGE} be reached as {host} "
            f"({error.verify_message.rstrip('.')}). Listen where it does, such as on 127.0.0.1; or renew it where "
            f"{AUTHORITY}.key is: `mapek keys {folder} --renew {KNOWLEDGE} --host {host}`."
        ) from error


def _check_readable(path: Path) -> None:
    try:
        path.open("rb").close()
    except FileNotFoundError:
        # Of another role's file in the same folder nobody thought.
        near = did_you_mean(None if path.parent.is_dir() else nearest_path(path, os.path.isfile))
        raise ConfigError(
            f"there is no {path}{near} Make all keys with `mapek keys DIR`, in a new folder, and give each host "
            "ca.pem and the .pem and .key of its roles."
        ) from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror or error}") from error


def dates(folder: Path, role: str) -> list[tuple[Path, float, float]]:
    """Return when the certificates begin and end by which a role proves who it is: file, and seconds since the epoch.

    Raises
    ------
    ConfigError
        As `tls`.
    """
    tls(folder, role)
    folder = folder.absolute()
    found = _check_certificates(authority_of(folder), folder / f"{role}.pem", folder / f"{role}.key", role)
    seconds = ssl.cert_time_to_seconds
    return [(path, float(seconds(one["notBefore"])), float(seconds(one["notAfter"]))) for path, one in found]


def _check_certificates(
    authority: Path, certificate: Path, key: Path, role: str
) -> list[tuple[Path, Mapping[str, Any]]]:
    """Look at a certificate and those of its authority, and return them, each with its file."""
    anew = "Make all keys anew: `mapek keys DIR`, in a new folder."
    renew = f"Renew it where {AUTHORITY}.key is: `mapek keys {certificate.parent} --renew {role}`."
    server, client = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    judge = client if role == KNOWLEDGE else server
    client.check_hostname = False
    client.verify_mode = server.verify_mode = ssl.CERT_NONE
    judge.verify_mode = ssl.CERT_REQUIRED
    judge.verify_flags |= _NO_CHECK_TIME
    try:
        for side in (server, client):
            # The password keeps OpenSSL from asking for one at the terminal.
            side.load_cert_chain(certificate, key, password="")
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            raise ConfigError(f"{key} does not belong to the certificate {certificate}. {renew}") from error
        raise ConfigError(
            f"{certificate} and {key} are not a certificate and its private key, as PEM and without a password "
            f"({error.reason or error}). {renew}"
        ) from error
    with contextlib.suppress(ssl.SSLError):
        judge.load_verify_locations(authority)
    if not (roots := judge.get_ca_certs()):
        raise ConfigError(f"{authority} is no certificate of an authority, as PEM. {anew}")
    for root in roots:
        _check_dates(authority, root, anew)
    try:
        seen = _shake_hands(server, client)[judge]
    except ssl.SSLCertVerificationError as error:
        raise ConfigError(
            f"{certificate} does not hold as that of {role} under {authority}: {error.verify_message}. {renew}"
        ) from error
    _check_dates(certificate, seen, renew)
    names = [value for part in seen["subject"] for name, value in part if name == "commonName"]
    if names != [role]:
        raise ConfigError(
            f"{certificate} is the certificate of {' and '.join(names) or 'nobody'}, not of {role}: its common name "
            f"has to be the role. {renew}"
        )
    return [*((authority, root) for root in roots), (certificate, seen)]


# The standard library does not read certificates, but it tells what the other end of a handshake has shown; with
# OpenSSL's X509_V_FLAG_NO_CHECK_TIME also where the dates are not good.
_NO_CHECK_TIME = ssl.VerifyFlags(0x200000)


def _shake_hands(server: ssl.SSLContext, client: ssl.SSLContext, host: str | None = None) -> dict[ssl.SSLContext, Any]:
    """Return the certificate that each side has seen of the other; the client asks for `host`, if for anybody."""
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (
        client.wrap_bio(to_client, to_server, server_hostname=host),
        server.wrap_bio(to_server, to_client, server_side=True),
    )
    for _ in range(4):
        for end in ends:
            with contextlib.suppress(ssl.SSLWantReadError):
                end.do_handshake()
    return {end.context: end.getpeercert() for end in ends}


def _check_dates(path: Path, certificate: Mapping[str, Any], way_out: str) -> None:
    begin, end = certificate["notBefore"], certificate["notAfter"]
    if time.time() < ssl.cert_time_to_seconds(begin):
        raise ConfigError(f"{path} is not valid before {begin}; is this host's clock right? {way_out}")
    if time.time() >= ssl.cert_time_to_seconds(end):
        raise ConfigError(f"{path} expired on {end}. {way_out}")


REFUSALS = ",".join(
    (
        "error",
        "zenoh_link_tls::unicast=debug",  # handshakes: who came, by common name and address, and who was turned away
        "zenoh_transport::unicast::manager=debug",  # the session that then began, by its id
        "zenoh::net::routing::interceptor::access_control=info",  # a common name that is no role
        "zenoh::net::routing::interceptor=trace",  # a message that was denied
        "zenoh::net::primitives::demux=trace",  # the session that it came from
    )
)
"""The filter of `log_refusals`, as ``RUST_LOG`` takes it."""


def log_refusals() -> None:
    """Have Zenoh write down who connects, who is turned away, and each message that is denied; call it before `open`.

    One line each on standard output, which is all that Zenoh offers; and only the first logging of a process counts, or
    ``RUST_LOG`` where it is set. A denied message is ``Msg intercepted!``, with the beginning of the id of the session
    that sent it. With ``RUST_LOG=error,zenoh::net::routing::interceptor=trace`` the line before it names role, message
    and key, but then each message that is allowed is written down too.
    """
    if not sys.stdout.isatty():
        os.environ.setdefault("NO_COLOR", "1")
    zenoh.init_log_from_env_or(REFUSALS)
