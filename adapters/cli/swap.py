"""`mapek swap`: another part for a loop that runs."""

from __future__ import annotations

import argparse
import json
import time
import tomllib
import uuid
from typing import Any

import zenoh
from pydantic import ValidationError

from adapters.buses.hub import SWAPPED_WITHIN
from adapters.buses.messages import Control, Replaced
from adapters.buses.round_trip import RoundTrip
from adapters.buses.wire import Wire
from adapters.cli.common import operator
from adapters.processes.supervise import ask_status
from mape import registry
from mape.config import DetectorSpec, PlannerSpec
from mape.errors import BusError, ConfigError, MapekError
from mape.parts import kind_of, owner
from mape.specs import PartSpec, explain
from mape.tables import refuse_infinity

THERE_WITHIN = 15.0
"""Seconds that a role has to be there: it may just be started again, or its link be about to come back."""

LOOK_EVERY = 0.05
"""Seconds between two looks whether it is."""


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    role, to = owner(chosen.part), _spec(chosen.to)
    _look_at(chosen.part, to)
    control = Control(what="swap", part=chosen.part, to=to, question=uuid.uuid4().hex)
    with operator(chosen) as (session, wire):
        reply = _ask(role, control, session, wire)
    if reply.ok is None:
        raise MapekError(_refusal(reply))
    _print(Replaced.unpack(reply.ok.payload.to_bytes())[0], chosen.to)
    return 0


def _look_at(part: str, to: dict[str, Any]) -> None:
    """Refuse here what no role could take: an unknown short name, or an illegal option of what is built in."""
    kind = kind_of(part)
    models: dict[str, type[PartSpec]] = {"detector": DetectorSpec, "planner": PlannerSpec}
    model = models.get(kind, PartSpec)
    try:
        spec = model.model_validate_json(json.dumps(to))
    except ValidationError as error:
        raise ConfigError(explain(error, f"{part}.", model)) from None
    named = [(kind, part, spec)]
    if isinstance(spec, PlannerSpec):
        named.append(("schedule", f"{part}.schedule", spec.schedule))
    for each, where, one in named:
        # What is not built in has to be found where the role runs, and not here.
        if ":" not in one.name and registry.entry(each, one.name).target.startswith("mape."):
            registry.options_of(each, one, where)


def _ask(role: str, control: Control, session: zenoh.Session, wire: Wire) -> zenoh.Reply:
    """Ask, by way of Knowledge, until the role has answered: with a link that is lost, question and answer are too.

    Only the process that may have heard the question knows it again; another one would make the swap twice.
    """
    deadline = time.monotonic() + SWAPPED_WITHIN
    heard_by = None
    while (left := deadline - time.monotonic()) > 0 and (epoch := _epoch(role, session, wire)) is not None:
        if heard_by not in (None, epoch):
            raise BusError(
                f"{role} was started again while it was asked for another {control.part}; whether it has it, "
                "`mapek log DIR --events` tells"
            )
        heard_by = epoch
        for reply in session.get(wire.ask("swap"), payload=control.pack(), timeout=left):
            if reply.ok is not None or _refusal(reply) != "Timeout":
                return reply
        time.sleep(LOOK_EVERY)  # a role that has just died counts as there for a moment
    raise BusError(
        f"{role} did not answer on {wire.endpoint}. Is it there (`mapek status --connect {wire.endpoint}`), and "
        "does the loop run?"
    )


def _epoch(role: str, session: zenoh.Session, wire: Wire) -> int | None:
    """Wait until a role is there, and tell which of its starts it is; None where it does not come."""
    begun = time.monotonic()
    deadline, patience = begun + THERE_WITHIN, RoundTrip(wire.patience)
    while True:
        asked_at, within = time.monotonic(), patience.within(1.0)
        for status in ask_status(session, wire, within):
            if status.roles[role].alive:
                return status.roles[role].epoch
        now = time.monotonic()
        if now - asked_at >= within:  # nobody has answered: the network may be slow
            patience.in_vain()
            deadline = min(now + 2 * within, begun + max(THERE_WITHIN, wire.patience))
        if now > deadline:
            return None
        time.sleep(LOOK_EVERY)  # Knowledge tells who is there when it is asked


def _refusal(reply: zenoh.Reply) -> str:
    return "" if reply.err is None else reply.err.payload.to_string()


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
