"""Where a run's processes may meet, and what is found there before anything is opened.

Zenoh takes whatever stands at a socket's path out of its way, and of a link that does not come about it says no more
than that time is up. So the place is looked at before somebody listens there, and after somebody was not answered.
"""

from __future__ import annotations

import errno
import os
import re
import socket
import ssl
import stat
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from mape.errors import BusError, ConfigError

UNIX = "unixsock-stream/"
"""What the endpoint of a socket in a folder begins with; its path follows."""

LOOK_WITHIN = 0.3
"""Seconds that somebody has to answer who is only looked at."""

SPEAKS_WITHIN = 1.0
"""Seconds that who listens has at least to say the first word over a link that stands."""

ROUND_TRIPS = 20
"""So many times as long as the link itself took, the first word over it is waited for."""

FAR = 0.02
"""Seconds that a link takes to come about where time may have been up before one was let in."""

LONGEST_PATH = 107
"""Bytes of the longest path that the kernel takes for a socket."""

_NET = re.compile(r"(?:tcp|tls)/(?P<host>\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+):(?P<port>\d{1,5})")
_LOOPBACK = re.compile(r"127(?:\.\d{1,3}){3}|localhost|\[::1\]")
_WILDCARD = re.compile(r"0\.0\.0\.0|\[[0:]+\]")


def check_endpoint(endpoint: str, anywhere: bool) -> None:
    """Refuse what is no endpoint, or, unless `anywhere`, one that other machines can reach.

    Raises
    ------
    ConfigError
        Says what is legal.
    """
    if endpoint.startswith(UNIX):
        path = endpoint.removeprefix(UNIX)
        if not path or re.search(r"[?#;]", path):
            raise ConfigError(f"endpoint {endpoint!r} needs a path without ?, # and ; after {UNIX}")
        if (size := len(os.fsencode(path))) > LONGEST_PATH:
            raise ConfigError(
                f"the socket's path {path!r} has {size} bytes; the kernel takes fewer than {LONGEST_PATH + 1}"
            )
        return
    found = _NET.fullmatch(endpoint)
    if found is None or not 1 <= int(found["port"]) <= 65_535:
        raise ConfigError(
            f"endpoint {endpoint!r} is neither {UNIX}PATH nor tcp/HOST:PORT with a port from 1 to 65535, such as "
            "tcp/127.0.0.1:7447"
        )
    if not anywhere and not on_this_machine(endpoint):
        raise ConfigError(
            f"endpoint {endpoint!r} can be reached from other machines, and without keys all that is sent can be read. "
            "Make keys with `mapek keys DIR` and give --tls DIR; or stay on 127.0.0.1; or, where the network itself is "
            "trusted, give --insecure, and the run's token on each machine, --token FILE"
        )


def reached(endpoint: str, keys: bool) -> str:
    """Return the endpoint by which one that is listened on is reached from this machine.

    Raises
    ------
    ConfigError
        It names an IPv6 address, and with `keys` Zenoh holds no certificate against one.

    Examples
    --------
    >>> reached("tcp/0.0.0.0:7447", True), reached("tcp/[::]:7447", False), reached("tcp/[::1]:7447", False)
    ('tcp/127.0.0.1:7447', 'tcp/127.0.0.1:7447', 'tcp/[::1]:7447')
    """
    found = _NET.fullmatch(endpoint)
    if found is None:
        return endpoint
    if _WILDCARD.fullmatch(found["host"]):
        return f"tcp/127.0.0.1:{found['port']}"
    if keys and found["host"].startswith("["):
        other = f"tcp/127.0.0.1:{found['port']}" if _LOOPBACK.fullmatch(found["host"]) else "the name of the machine"
        raise ConfigError(
            f"endpoint {endpoint!r} cannot be reached with keys: Zenoh holds no certificate against an IPv6 address. "
            f"Give {other} instead"
        )
    return endpoint


def on_this_machine(endpoint: str) -> bool:
    """Whether an endpoint can be reached from this machine alone.

    >>> on_this_machine("tcp/127.0.0.1:7447"), on_this_machine("tcp/10.0.0.7:7447")
    (True, False)
    """
    found = _NET.fullmatch(endpoint)
    return found is None or _LOOPBACK.fullmatch(found["host"]) is not None


def place_of(endpoint: str) -> tuple[str, int] | None:
    """Return host and port of an endpoint of the network.

    >>> place_of("tcp/[::1]:7447"), place_of("unixsock-stream/k.sock")
    (('::1', 7447), None)
    """
    found = _NET.fullmatch(endpoint)
    return None if found is None else (found["host"].strip("[]"), int(found["port"]))


def folder_of(endpoint: str) -> Path | None:
    """Return the folder of an endpoint that is a socket.

    >>> folder_of("unixsock-stream/run/k.sock"), folder_of("tcp/127.0.0.1:7447")
    (PosixPath('run'), None)
    """
    return Path(endpoint.removeprefix(UNIX)).parent if endpoint.startswith(UNIX) else None


def check_free(endpoint: str) -> None:
    """Look whether one can listen there, without taking anybody's place.

    Raises
    ------
    BusError
        Somebody listens there already, or nobody can.
    ConfigError
        Something that is no socket stands at its path.
    """
    place = place_of(endpoint)
    try:
        if place is None:
            _check_path(endpoint, endpoint.removeprefix(UNIX))
        else:
            _check_port(*place)
    except UnicodeError as error:
        raise BusError(f"cannot listen on {endpoint}: its host is no name of a machine ({error})") from error
    except OSError as error:
        said = error.strerror or str(error)
        if error.errno == errno.EADDRINUSE:
            raise BusError(f"cannot listen on {endpoint}; is another Knowledge running there? ({said})") from error
        raise BusError(f"cannot listen on {endpoint}: {said}") from error


def _check_port(host: str, port: int) -> None:
    failed, free = [], 0
    for family, kind, number, _, address in socket.getaddrinfo(
        host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    ):
        with socket.socket(family, kind, number) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # links of a process that died do no harm
            try:
                probe.bind(address)
                free += 1
            except OSError as error:
                failed.append(error)
    for one in failed:
        if one.errno == errno.EADDRINUSE or not free:
            raise one


def _check_path(endpoint: str, path: str) -> None:
    folder = Path(path).absolute().parent
    if not os.path.isdir(folder):
        raise OSError(errno.ENOENT, f"there is no folder {folder}")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OSError(errno.EACCES, f"{folder} may not be written by you")
    # Zenoh removes both: the first before it listens, the second, its own lock, when it leaves.
    _check_replaceable(endpoint, path, stat.S_ISSOCK)
    _check_replaceable(endpoint, f"{path}.lock", stat.S_ISREG)
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(LOOK_WITHIN)
        try:
            probe.connect(path)
        except (FileNotFoundError, ConnectionRefusedError):
            return  # what is left of a process that died
        except OSError:
            pass  # alive, and too busy, or of another kind
    raise OSError(errno.EADDRINUSE, os.strerror(errno.EADDRINUSE))


def _check_replaceable(endpoint: str, path: str, kind: Callable[[int], bool]) -> None:
    try:
        found = os.lstat(path)
    except FileNotFoundError:
        return
    if not kind(found.st_mode) or found.st_size:
        raise ConfigError(
            f"cannot listen on {endpoint}: {path} is something else than a socket and its lock, and would be removed. "
            "Name a new path"
        )


class Found(NamedTuple):
    """Who was found at a host and port, as a sentence; and whether all that is known is that time was up."""

    why: str
    slow: bool = False


def who_listens(place: tuple[str, int], authority: Path | None, within: float) -> Found | None:
    """Say why who listens at a host and port does not answer, as far as can be seen; None where nobody listens.

    Parameters
    ----------
    place
        Host and port.
    authority
        Certificate of the authority of one's own keys; None without keys.
    within
        Seconds that a link has to come about.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    if authority is None:
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    else:
        context.load_verify_locations(authority)
    begun = time.monotonic()
    try:
        link = socket.create_connection(place, within)
    except TimeoutError:
        return Found(f"no link to it came about within {within:.1f} s: the network is slow, or cut", slow=True)
    except (OSError, UnicodeError):  # the second, where the host's name is none
        return None
    took = time.monotonic() - begun
    # Who has not said a word after so many round trips does not do so because the way is long.
    answers_within = max(SPEAKS_WITHIN, ROUND_TRIPS * took)
    with link:
        link.settimeout(answers_within)
        try:
            context.wrap_socket(link, server_hostname=place[0]).close()
        except ssl.SSLCertVerificationError as error:
            return Found(
                f"who listens there has a certificate that does not hold under {authority}: "
                f"{error.verify_message.rstrip('.')}"
            )
        except TimeoutError:
            told = f"a link stood after {took:.2g} s, and nothing was said on it within {answers_within:.1f} s"
            if authority is None:
                return Found(f"who listens there does not answer ({told}): it is slow, or no Knowledge", slow=True)
            return Found(
                f"who listens there uses no keys, or stands still ({told}): give --tls to all processes of a run, or "
                "to none",
                slow=True,
            )
        except OSError:  # of which TLS's errors are a kind
            if authority is None:
                return Found("who listens there does not answer")
            return Found("who listens there uses no keys: give --tls to all processes of a run, or to none")
    if authority is None:
        return Found("who listens there asks for keys: give --tls DIR")
    if took > FAR:
        return Found(
            f"who listens there answers, and lets nobody in yet who has the keys of {authority.parent}: a link takes "
            f"{took:.2g} s, and to be let in some times as long",
            slow=True,
        )
    return Found(f"who listens there does not let one in who has the keys of {authority.parent}")
