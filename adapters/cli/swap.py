"""`mapek swap`: another part for a loop that runs."""

from __future__ import annotations

import argparse
import time
import tomllib
from typing import Any

import zenoh

from adapters.buses.messages import Control, Replaced
from adapters.buses.wire import Wire
from adapters.cli.common import operator
from adapters.processes.replacing import CHECKED_WITHIN
from adapters.processes.supervise import ask_status
from mape.errors import BusError, ConfigError, MapekError
from mape.parts import owner
from mape.tables import refuse_infinity

ANSWERED_WITHIN = CHECKED_WITHIN + 15.0
"""Seconds that a role has to check the part and to reach the end of its pass."""

THERE_WITHIN = 5.0
"""Seconds that a role has to be there: it may just be started again, or its link be about to come back."""


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    role = owner(chosen.part)
    control = Control(what="swap", part=chosen.part, to=_spec(chosen.to)).pack()
    with operator(chosen) as (session, wire):
        # A question that nobody hears ends at once, and one that was heard must not be asked twice.
        deadline = time.monotonic() + THERE_WITHIN
        while not _is_there(role, session, wire) and time.monotonic() < deadline:
            time.sleep(0.05)  # Knowledge tells who is there when it is asked
        said = None
        for reply in session.get(wire.control(role), payload=control, timeout=ANSWERED_WITHIN):
            if reply.ok is not None:
                _print(Replaced.unpack(reply.ok.payload.to_bytes())[0], chosen.to)
                return 0
            said = None if reply.err is None else reply.err.payload.to_string()
    if said is None or said == "Timeout":
        raise BusError(
            f"{role} did not answer on {wire.endpoint}. Is it there (`mapek status --connect {wire.endpoint}`), and "
            "does the loop run?"
        )
    raise MapekError(said)


def _is_there(role: str, session: zenoh.Session, wire: Wire) -> bool:
    return any(status.roles[role].alive for status in ask_status(session, wire, 1.0))


def _spec(text: str) -> dict[str, Any]:
    if not text.strip():
        raise ConfigError('the new part has no name; give one of `mapek list`, or "module:Class"')
    if not text.lstrip().startswith("{"):
        return {"name": text}
    try:
        table = tomllib.loads(f"to = {text}")["to"]
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f'{text!r} is no inline table such as {{name = "morphin", alpha = 0.2}}: {error}') from None
    if not (isinstance(name := table.get("name"), str) and name.strip()):
        raise ConfigError(f'{text!r} names no part; give {{name = "..."}} and its options')
    refuse_infinity(table, f"{text!r}: ")
    return dict(table)


def _print(swap: Replaced, to: str) -> None:
    first, last = min(swap.passes), max(swap.passes)
    when = f"pass {first}" if first == last else f"passes {first} to {last} of {len(swap.passes)} loops"
    kept = "with the state of the one before" if swap.handed_over else "from a fresh start"
    if swap.part == "learner":  # it has no state
        kept = "and the Q-table goes on"
    print(f"from {when} on, {swap.part} is {to}, {kept}")
