"""What both ends of the wire agree on: names, places in the log, and how a session is opened.

    mape/<system>/<loop>/<stage>                   every record of that stage, published once it is in the log
    mape/<system>/<loop>/knowledge/append          query: take this record
    mape/<system>/<loop>/knowledge/since           query: what is in the log from a place on
    mape/<system>/<loop>/alive/<name>/<session>    liveliness token, declared last

A stage is named after the component that sends its records: execute (Observation), monitor (Symptom), analyze
(ChangeRequest), plan (ChangePlan).
"""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass
from typing import Any

import zenoh

from knowledge import STAGES, ChangePlan, ChangeRequest, Observation, Record, Symptom
from mape.errors import BusError, ConfigError

STAGE_NAMES: dict[type[Record], str] = {
    Observation: "execute",
    Symptom: "monitor",
    ChangeRequest: "analyze",
    ChangePlan: "plan",
}
"""Record type -> the component that sends it."""

ORDERED: dict[str, Any] = {"congestion_control": zenoh.CongestionControl.BLOCK, "priority": zenoh.Priority.DATA}
"""Put and query options. Zenoh keeps order within one priority only, and drops by default when a link is busy."""

LARGEST_MESSAGE = 1 << 20
"""Bytes of the largest record that is taken from the wire; the largest that a run can send is some tens of kB."""

LEASE_MS = 2_000
"""After that long a process that is frozen, or cut off, is taken for gone; one that died is seen at once."""

_SEGMENT = re.compile(r"[a-z0-9_-]+")
_UNIX = "unixsock-stream/"
_TCP = re.compile(r"tcp/(127\.0\.0\.1|localhost|\[::1\]):(\d{1,5})")


@dataclass(frozen=True)
class Wire:
    """Where one loop's records travel.

    Parameters
    ----------
    endpoint
        ``unixsock-stream/PATH``, or ``tcp/127.0.0.1:PORT``. Plain TCP authenticates nobody, so it stays on this host.
    system
        Name of the managed system; part of every key expression.
    loop
        Number of the loop.

    Raises
    ------
    ConfigError
        A name or an endpoint that is not legal.

    Examples
    --------
    >>> wire = Wire("tcp/127.0.0.1:7447", "gridworld", 0)
    >>> wire.stream(Observation), wire.append
    ('mape/gridworld/0/execute', 'mape/gridworld/0/knowledge/append')
    """

    endpoint: str
    system: str
    loop: int = 0

    def __post_init__(self) -> None:
        segment(self.system, "the system's name")
        if self.loop < 0:
            raise ConfigError(f"loop {self.loop}: loops are numbered from 0")
        _check_endpoint(self.endpoint)

    @property
    def prefix(self) -> str:
        """Beginning of all key expressions of the loop."""
        return f"mape/{self.system}/{self.loop}"

    @property
    def append(self) -> str:
        """Key that takes a record to Knowledge."""
        return f"{self.prefix}/knowledge/append"

    @property
    def since(self) -> str:
        """Key that asks Knowledge for records from a place on."""
        return f"{self.prefix}/knowledge/since"

    def stream(self, kind: type[Record]) -> str:
        """Key on which the appended records of `kind` are published."""
        return f"{self.prefix}/{STAGE_NAMES[kind]}"

    def alive(self, name: str, session: zenoh.Session) -> str:
        """Key of the liveliness token of `name`; each session has its own, so a restart is not taken for a return."""
        return f"{self.prefix}/alive/{segment(name, 'a component')}/{session.zid()}"

    def listen(self) -> zenoh.Session:
        """Open the meeting point: a router on the endpoint.

        Raises
        ------
        BusError
            The endpoint is taken, or cannot be made.
        """
        config = _config("router", listen={"endpoints": [self.endpoint]})
        return _open(config, f"cannot listen on {self.endpoint}; is another Knowledge running there?")

    def join(self, patience: float) -> zenoh.Session:
        """Open a client's session, waiting up to `patience` seconds for the meeting point.

        Raises
        ------
        BusError
            Nobody listens on the endpoint.
        """
        connect = {
            "endpoints": [self.endpoint],
            "timeout_ms": max(1, round(patience * 1000)),
            "exit_on_failure": True,
            "retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
        }
        return _open(_config("client", connect=connect), f"no Knowledge answers on {self.endpoint}; start it first")


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


def place(record: Record) -> int:
    """Return the place of a record in the log: 0 for plan 0, then the four records of pass 1, of pass 2, ...

    >>> place(ChangePlan(0, 0, 1.0, (), (), (), (), False, None))
    0
    >>> place(ChangePlan(0, 2, 1.0, (), (), (), (), False, None))
    8
    """
    return len(STAGES) * (record.pass_no - 1) + STAGES.index(type(record)) + 1


def at_place(number: int) -> tuple[int, int]:
    """Return the pass and the stage of place `number`: the inverse of `place`.

    >>> at_place(0), at_place(1), at_place(8)
    ((0, 3), (1, 0), (2, 3))
    """
    before, stage = divmod(number - 1, len(STAGES))
    return before + 1, stage


def _check_endpoint(endpoint: str) -> None:
    if endpoint.startswith(_UNIX):
        path = endpoint.removeprefix(_UNIX)
        if not path or re.search(r"[?#;]", path):
            raise ConfigError(f"endpoint {endpoint!r} needs a path without ?, # and ; after {_UNIX}")
        if (size := len(os.fsencode(path))) >= 108:
            raise ConfigError(f"the socket's path {path!r} has {size} bytes; the kernel takes fewer than 108")
        return
    found = _TCP.fullmatch(endpoint)
    if found is None or not 1 <= int(found[2]) <= 65_535:
        raise ConfigError(
            f"endpoint {endpoint!r} is neither {_UNIX}PATH nor tcp/127.0.0.1:PORT with a port from 1 to 65535; plain "
            "TCP authenticates nobody, so it is kept to this host"
        )


def _config(mode: str, **edges: Any) -> zenoh.Config:
    quiet = {"enabled": False}
    return zenoh.Config.from_json5(
        json.dumps(
            {
                "mode": mode,
                # Explicit endpoints only: by default two sessions on one network find each other. A router's start
                # would wait half a second for what may answer.
                "scouting": {"delay": 0, "multicast": quiet, "gossip": quiet},
                # Shared memory outlives a killed process, and records are far below the size at which it pays.
                "transport": {"shared_memory": quiet, "link": {"tx": {"lease": LEASE_MS}}},
                # No clock enters what is logged.
                "timestamping": quiet,
                **edges,
            }
        )
    )


def _open(config: zenoh.Config, otherwise: str) -> zenoh.Session:
    # Zenoh says nowhere else that it has closed a link.
    zenoh.init_log_from_env_or("error")
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise BusError(f"{otherwise} ({error})") from error
