"""What all processes of a run agree on: who may say what under which key, and how a session is opened.

    mape/<system>/<loop>/<role>                  records of that role's stage, published by Knowledge
    mape/<system>/<loop>/append/<role>           query: take these records
    mape/<system>/knowledge/join/<role>          query: I am <role>, with this config; what is my epoch?
    mape/<system>/knowledge/since                query: the records of a loop from a pass on
    mape/<system>/knowledge/snapshot/<role>      query: keep my state; or, without a payload, give it back
    mape/<system>/knowledge/piece/<role>         query: a piece of what is too large for one message
    mape/<system>/knowledge/swap                 query: have another part put in; handed on to the role whose part it is
    mape/<system>/knowledge/swapped/<role>       query: from this pass on I work with the part that was asked for
    mape/<system>/knowledge/event/<role>         query: note this beside the records
    mape/<system>/knowledge/table                query: a Q-table, by its hash or by the pass at whose end it was
    mape/<system>/knowledge/remember/plan        query: keep this Q-table for a later plan
    mape/<system>/knowledge/status               query: who is there, and how far is the run?
    mape/<system>/control/<role>                 query by Knowledge, answered by the role: replace a part, hand out Q
    mape/<system>/knowledge/beat/<role>          heartbeat of the thread that does the role's work
    mape/<system>/alive/<role>/<epoch>           liveliness token, declared last

The roles stand in `adapters.roles`. Knowledge is the router; `operator` is a person who looks on, or replaces a part.
"""

from __future__ import annotations

import ctypes
import hmac
import json
import os
import re
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import zenoh

from adapters.buses import endpoints, security, tokens
from adapters.buses.round_trip import RoundTrip
from adapters.roles import KNOWLEDGE, OPERATOR, ROLES
from knowledge import STAGES, ChangePlan, ChangeRequest, Observation, Record, Symptom
from mape.errors import BusError, ConfigError

WIRE_VERSION = 2
"""Version of the keys and messages; processes of different ones refuse each other."""

INPUT: dict[str, type[Record]] = {
    "execute": ChangePlan,
    "monitor": Observation,
    "analyze": Symptom,
    "plan": ChangeRequest,
}
"""Role -> the kind of record that it waits for."""

ORDERED: dict[str, Any] = {"congestion_control": zenoh.CongestionControl.BLOCK, "priority": zenoh.Priority.DATA}
"""Put and query options. Zenoh keeps order within one priority only, and drops by default when a link is busy."""

LARGEST_MESSAGE = 1 << 20
"""Bytes of the largest message that is taken; the largest that a run sends, a piece among them, is some tens of kB."""

LARGEST = 128 << 20
"""Bytes of the largest message that a process takes in; what is larger is thrown away before it is whole."""

LARGEST_TABLE = 1 << 30
"""Bytes of the largest message that is taken in pieces: a state, or a Q-table."""

SINCE_LIMIT = 512
"""Most records in one answer to `since`; a shorter answer reaches the end of the log."""

MISSING = "missing: "
"""What a refusal begins with of a message whose pieces Knowledge does not have, since its restart say."""

OF_CONFIG = "config: "
"""What a refusal begins with that is a matter of the config."""

LEASE_MS = 2_000
"""After that long a process on this machine that is frozen is taken for gone; one that died is seen at once."""

PATIENCE = 60.0
"""Seconds for which an answer over a network may be waited for, at most, before it is asked for again."""

LEASES = 6
"""Over a network, a process that is frozen, or cut off, is taken for gone after this part of the patience."""

PENDING = 1_000
"""Most handshakes that Knowledge has under way at the same time; on a slow network each takes a while."""

_SEGMENT = re.compile(r"[a-z0-9_-]+")


class Unanswered(BusError):
    """Nobody can be joined at an endpoint.

    Attributes
    ----------
    found : who is there all the same, as far as can be seen; None where nobody listens.
    """

    def __init__(self, said: str, found: endpoints.Found | None) -> None:
        super().__init__(said)
        self.found = found

    @property
    def slow(self) -> bool:
        """Whether more patience may help."""
        return self.found is not None and self.found.slow


@dataclass(frozen=True)
class Wire:
    """Where a run's processes meet.

    Parameters
    ----------
    endpoint
        ``unixsock-stream/PATH`` or ``tcp/HOST:PORT``.
    system
        Name of the managed system; part of every key expression. ``*`` for an operator, who asks whoever is there.
    tls
        Folder with certificates, as `mapek keys` makes it: both ends then prove who they are.
    insecure
        Allow hosts beyond this one without certificates: what is sent can then be read on the way.
    patience
        Seconds for which an answer may be waited for, at most, before it is asked for again.
    token
        File of the run's token, by which both ends prove who they are where there are no certificates; None for the one
        in the user's runtime folder, under the endpoint's name.
    largest
        Bytes of the largest message that is taken in here.

    Raises
    ------
    ConfigError
        A name or an endpoint that is not legal.

    Examples
    --------
    >>> wire = Wire("tcp/127.0.0.1:7447", "gridworld")
    >>> wire.stream("monitor", 0), wire.append("monitor", 0), wire.ask("since")
    ('mape/gridworld/0/monitor', 'mape/gridworld/0/append/monitor', 'mape/gridworld/knowledge/since')
    """

    endpoint: str
    system: str
    tls: Path | None = None
    insecure: bool = False
    patience: float = PATIENCE
    token: Path | None = None
    largest: int = LARGEST

    def __post_init__(self) -> None:
        if self.system != "*":
            segment(self.system, "the system's name")
        endpoints.check_endpoint(self.endpoint, self.tls is not None or self.insecure)
        if self.tls is not None and self.endpoint.startswith(endpoints.UNIX):
            raise ConfigError(f"endpoint {self.endpoint!r} takes no keys; with --tls give tcp/HOST:PORT")
        if self.tls is not None and self.token is not None:
            raise ConfigError("with keys everybody proves who they are, and needs no token; leave out --tls or --token")

    @property
    def lease(self) -> float:
        """Seconds after which a process that is frozen, or cut off, is taken for gone."""
        if self.endpoint.startswith(endpoints.UNIX):
            return LEASE_MS / 1000
        return max(LEASE_MS / 1000, self.patience / LEASES)

    def stream(self, role: str, loop: int | str = "*") -> str:
        """Key on which a role's records are published."""
        return f"mape/{self.system}/{loop}/{role}"

    def append(self, role: str, loop: int | str = "*") -> str:
        """Key that takes a role's records to Knowledge."""
        return f"mape/{self.system}/{loop}/append/{role}"

    def ask(self, what: str) -> str:
        """Key of a question to Knowledge."""
        return f"mape/{self.system}/knowledge/{what}"

    def ask_any(self, what: str) -> str:
        """Key of a question to Knowledge, of whatever system it is."""
        return f"mape/*/knowledge/{what}"

    def control(self, role: str) -> str:
        """Key of a question to a role."""
        return f"mape/{self.system}/control/{role}"

    def beat(self, role: str) -> str:
        """Key of a role's heartbeat."""
        return f"mape/{self.system}/knowledge/beat/{role}"

    def alive(self, role: str, epoch: int | str = "*") -> str:
        """Key of a role's liveliness token: each start has its own, so a restart is not taken for a return."""
        return f"mape/{self.system}/alive/{role}/{epoch}"

    def check_listen(self) -> None:
        """Look whether `listen` would find its endpoint free and its keys in place; make the run's token.

        Raises
        ------
        BusError
            The endpoint is taken, or cannot be made.
        ConfigError
            A certificate is missing, or of no use; the token cannot be made, or is not the user's alone; or a file that
            is no socket stands at the endpoint's path.
        """
        if self.tls is not None:
            security.tls(self.tls, KNOWLEDGE)
        endpoints.check_free(self.endpoint)
        if self.tls is None:
            tokens.make(self.endpoint, security.CLIENTS, self.token)

    def check_here(self) -> None:
        """Look whether all processes of a run can meet on this machine: `check_listen`, and the others' keys.

        Raises
        ------
        BusError, ConfigError
            As `check_listen`; or with keys nobody would reach the endpoint, as Knowledge's certificate does not name
            it.
        """
        place = endpoints.place_of(endpoints.reached(self.endpoint, self.tls is not None))
        self.check_listen()
        if self.tls is not None and place is not None:
            for role in (*ROLES, OPERATOR):
                security.tls(self.tls, role)
            security.check_host(self.tls, place[0])

    def listen(self) -> zenoh.Session:
        """Open the meeting point: a router on the endpoint.

        Raises
        ------
        BusError, ConfigError
            As `check_listen`.
        """
        self.check_listen()
        edges: dict[str, Any] = {"listen": {"endpoints": [self._address(self.endpoint)]}}
        if self.tls is not None:
            edges["access_control"] = security.access_control()
            security.log_refusals()
        else:
            edges["access_control"] = security.access_control("usernames")
        taken = f"cannot listen on {self.endpoint}; is another Knowledge running there?"
        router = _open(self._config("router", KNOWLEDGE, **edges), lambda said: BusError(f"{taken} ({said})"))
        return never_freed(router)

    def join(self, role: str, patience: float) -> zenoh.Session:
        """Open a client's session, waiting up to `patience` seconds for the meeting point.

        An endpoint that stands for all addresses of a machine is reached on this one.

        Raises
        ------
        Unanswered
            Nobody listens on the endpoint, or who does refuses this role's certificate, or has none.
        ConfigError
            A certificate is missing, or of no use; or the endpoint cannot be reached with keys.
        """
        endpoint = endpoints.reached(self.endpoint, self.tls is not None)
        connect = {
            "endpoints": [self._address(endpoint)],
            "timeout_ms": max(1, round(patience * 1000)),
            "exit_on_failure": True,
            "retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
        }
        try:
            config = self._config("client", role, connect=connect)
        except tokens.NoToken as error:
            unanswered = self._unanswered(endpoint, role, str(error), patience)
            raise Unanswered(str(unanswered), unanswered.found and unanswered.found._replace(slow=False)) from error
        return _open(config, lambda said: self._unanswered(endpoint, role, said, patience))

    def proof(self, role: str, challenge: str) -> str:
        """Return what shows a role that Knowledge has the token too; empty with keys, which have shown it.

        Parameters
        ----------
        role, challenge
            Who wants to see it, and what it has thought of to be answered.
        """
        if self.tls is not None:
            return ""
        key = tokens.secret(tokens.find(self.endpoint, self.token), role)
        return hmac.digest(key.encode(), f"Knowledge has the token of {role}: {challenge}".encode(), "sha256").hex()

    def join_patiently(self, role: str, least: float) -> zenoh.Session:
        """Open a client's session as `join` does; while only a slow network is in the way, again, with more time.

        Raises
        ------
        Unanswered, ConfigError
            As `join`; of a slow network after the patience, of this machine at once.
        """
        patience, until = RoundTrip(self.patience), time.monotonic()
        # Who proves itself by keys may take its time here too, so that a role tries for longer; a person is told.
        if not endpoints.on_this_machine(endpoints.reached(self.endpoint, self.tls is not None)):
            until += max(least, self.patience)
        while True:
            try:
                return self.join(role, patience.within(least))
            except Unanswered as error:
                if not error.slow or time.monotonic() > until:
                    raise
                patience.in_vain()

    def _unanswered(self, endpoint: str, role: str, said: str, patience: float) -> Unanswered:
        place, found = endpoints.place_of(endpoint), None
        if place is not None:
            authority = None if self.tls is None else security.authority_of(self.tls)
            found = endpoints.who_listens(place, authority, patience)
        why = found.why if found else "start it, or look at the address"
        if self.tls is None and found:
            why += ", or has another token"
            if endpoints.on_this_machine(endpoint):  # where nothing is slow, and to ask again changes no token
                found = found._replace(slow=False)
        if self.tls is not None and not found:
            why += f" and at whether it trusts the certificate of {role} in {self.tls}"
        return Unanswered(f"no Knowledge answers on {self.endpoint}; {why} ({said})", found)

    def _address(self, endpoint: str) -> str:
        return endpoint if self.tls is None else endpoint.replace("tcp/", "tls/", 1)

    def _config(self, mode: str, role: str, **edges: Any) -> zenoh.Config:
        quiet = {"enabled": False}
        # A queue that stays full for the lease belongs to a process that is gone, on this machine; over a slow network
        # it may just be long, and who is gone there is told by the lease alone.
        lease, most = round(self.lease * 1000), round(self.patience * 1000)
        far = not self.endpoint.startswith(endpoints.UNIX)
        blocked = {"congestion_control": {"block": {"wait_before_close": (most if far else lease) * 1000}}}
        link: dict[str, Any] = {"tx": {"lease": lease, "queue": blocked}, "rx": {"max_message_size": self.largest}}
        handshakes = {"open_timeout": most, "accept_timeout": most, "accept_pending": PENDING}
        transport: dict[str, Any] = {"shared_memory": quiet, "unicast": handshakes, "link": link}
        if self.tls is not None:
            link |= security.tls(self.tls, role)
        else:
            path = tokens.find(self.endpoint, self.token)
            if mode == "router":
                proves = {"dictionary_file": str(path.absolute())}
            else:
                proves = {"user": role, "password": tokens.secret(path, role)}
            transport["auth"] = {"usrpwd": proves}
        return zenoh.Config.from_json5(
            json.dumps(
                {
                    "mode": mode,
                    # Explicit endpoints only: by default two sessions on one network find each other. A router's start
                    # would wait half a second for what may answer.
                    "scouting": {"delay": 0, "multicast": quiet, "gossip": quiet},
                    # Shared memory outlives a killed process, and records are far below the size at which it pays.
                    "transport": transport,
                    # No clock enters what is logged.
                    "timestamping": quiet,
                    **edges,
                }
            )
        )


def hand_over(queue: SimpleQueue[Any], kind: str) -> zenoh.handlers.Callback[Any]:
    """Return a handler that puts what arrives into `queue`, as (kind, what); whoever works takes it from there."""
    put = queue.put
    return zenoh.handlers.Callback(lambda what: put((kind, what)), indirect=False)


def segment(text: str, what: str) -> str:
    """Return `text` if it may stand between two slashes of a key expression.

    Raises
    ------
    ConfigError
        It holds what is special in key expressions, or invites it.
    """
    if not _SEGMENT.fullmatch(text):
        raise ConfigError(f"{what} is {text!r}; on the wire it has only a-z, 0-9, _ and -, and at least one of them")
    return text


def system_segment(identifier: str) -> str:
    """Turn a system's id into a segment of a key expression.

    >>> system_segment("mapek/Gridworld-v0")
    'mapek-gridworld-v0'
    """
    return segment(re.sub(r"[^a-z0-9_-]+", "-", identifier.lower()).strip("-"), "the system's name")


def role_of(kind: type[Record]) -> str:
    """Return the role that sends records of `kind`."""
    return ROLES[STAGES.index(kind)]


def versions() -> dict[str, str]:
    """Return the versions that the processes of a run compare."""
    from adapters.versions import versions as of_results

    return {**of_results(), "wire": str(WIRE_VERSION)}


def host() -> str:
    """Return this machine's name, for people."""
    return socket.gethostname()[:255]


_RUNTIME = "(net: (handover: app), acc: (handover: app), app: (worker_threads: 1))"
"""Zenoh hands each message from one pool of threads to the next, and these wake-ups cost more than all else.

What reads and what writes the links keeps its own threads: one that writes much and waits must not keep another from
reading it.
"""


def _open(config: zenoh.Config, otherwise: Callable[[str], BusError]) -> zenoh.Session:
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)  # read once, when the first session of a process is opened
    # Zenoh says nowhere else that it has closed a link.
    zenoh.init_log_from_env_or("error")
    opened: list[zenoh.Session] = []
    failed: list[zenoh.ZError] = []

    def open_it() -> None:
        try:
            opened.append(zenoh.open(config))
        except zenoh.ZError as error:
            failed.append(error)

    # On a thread of its own: over a slow network it takes its time, in which Ctrl-C and SIGTERM are to be heard.
    thread = threading.Thread(target=open_it, name="open", daemon=True)
    thread.start()
    thread.join()
    if failed:
        # Of what Zenoh says, the places in its sources help nobody here.
        raise otherwise(re.split(r"[.]? at /", str(failed[0]))[0]) from failed[0]
    return opened[0]


def never_freed(router: zenoh.Session) -> zenoh.Session:
    """Return a router's session, kept as long as its process lives; once closed, it takes some 20 kB.

    To free one is to wait, with the GIL held, for a task on a thread of Zenoh's. Where that thread itself waits for the
    GIL, to hand over what came for another session, the process stands still for ever; and garbage is freed at any
    moment, by any thread.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(router))
    return router
