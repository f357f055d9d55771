"""A component of the loop in a process of its own: restored after a crash, and done when the run is.

    restore the newest state -> do again what came after it -> go on

What is done again is sent again, and Knowledge answers ``duplicate``: that it is the same, byte for byte, shows that
nothing was lost, and nothing done twice.
"""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable
from typing import Any

from adapters.buses.member import Asked, Member
from adapters.buses.messages import State
from adapters.processes.remote import RemoteKnowledge
from adapters.processes.replacing import Due, Replacing, Unit, spec_of
from adapters.stores.ledger import layout_from
from knowledge import ChangePlan, Record
from mape.allowed import check_part
from mape.analyze import Analyze
from mape.config import Config
from mape.errors import PartError
from mape.loop import build_analyze, build_monitor, build_plan
from mape.monitor import Monitor
from mape.parts import owner
from mape.plan import Plan

logger = logging.getLogger(__name__)

IDLE = 0.5
"""Seconds that a role waits for a record before it looks whether it is to end."""

_REMEMBERING = "Remembering/1"

_HANDLERS: dict[str, Callable[[Any, Any], None]] = {
    "monitor": Monitor.on_observation,
    "analyze": Analyze.on_symptom,
    "plan": Plan.on_request,
}


class Role(Replacing):
    """Monitor, Analyze or Plan of all loops of a run; `ExecuteRole` is the fourth.

    Parameters
    ----------
    name
        Which one.
    config
        What runs.
    member
        The link to Knowledge, not connected yet.
    """

    first = 1
    """Pass of the first record that is waited for."""

    def __init__(self, name: str, config: Config, member: Member) -> None:
        super().__init__()
        self.name = name
        self.config = config
        self.member = member
        self.units: list[Unit] = []
        self.stopping = threading.Event()
        self.released = threading.Event()  # until then it is made, and does not join
        self.released.set()

    def run(self) -> None:
        """Join, restore, and work until all loops are done, or `stopping` is set.

        Raises
        ------
        MapekError
            A part or the system raised, or Knowledge refuses this role.
        """
        self.released.wait()
        with self.member:
            self.begin()
            while not self.stopping.is_set() and not all(unit.done for unit in self.units):
                came = self.member.receive(IDLE)
                if came is None:
                    pass
                elif isinstance(came, Asked):
                    self._asked(came)
                else:
                    self._take(self.units[came.loop], came)
                if self._vetted:
                    self._let_in()
            self._refuse_all()
            self.leave()

    def leave(self) -> None:
        """Wait until all that was sent is acknowledged, unless this role is to stop: then it is sent again."""
        if not self.stopping.is_set():
            self.member.settle()

    def begin(self) -> None:
        """Make each loop's component, and restore it."""
        joined = self.member.joined
        recorded: dict[int, list[Due]] = {}
        for swap in joined.swaps:
            spec = spec_of(swap.to)
            check_part(self.config, swap.part, spec)
            recorded.setdefault(swap.loop, []).append(Due(swap.pass_no, swap.part, spec, planned=False))
        planned = [Due(swap.pass_no, swap.part, swap.to, planned=True) for swap in self.config.swap]
        for loop in range(joined.units):
            swaps = [s for s in [*planned, *recorded.get(loop, [])] if owner(s.part) == self.name]
            unit = Unit(loop, self.config, sorted(swaps, key=lambda s: s.pass_no))
            self.units.append(unit)
            self.member.beat()  # of many loops it takes longer than a hung role is silent
            self.make(unit)
            self._restore(unit)

    def make(self, unit: Unit) -> None:
        """Give a loop its component."""
        send = unit.outbox.append
        if self.name == "monitor":
            unit.component = build_monitor(self.config, send)
        elif self.name == "analyze":
            unit.component = build_analyze(self.config, send)
        else:
            unit.knowledge = self._knowledge(unit)
            unit.component = build_plan(self.config, unit.knowledge, send)

    def _knowledge(self, unit: Unit) -> RemoteKnowledge:
        assert self.member.joined.layout is not None
        return RemoteKnowledge(self.member, layout_from(self.member.joined.layout.model_dump()), unit.loop)

    def _restore(self, unit: Unit) -> None:
        found = self.member.snapshot(unit.loop)
        if found is None:
            self.start(unit)
            self.member.watch(unit.loop, self.first)
            return
        state, _ = found
        self._swap(unit, state.pass_no)  # the state is that of the parts that served then
        self.take_up(unit, state)
        unit.sent = state.pass_no

    def start(self, unit: Unit) -> None:
        """Begin a loop that has no state yet."""
        if self.name == "plan":
            unit.component.start(unit.loop)
            self._flush(unit)

    def take_up(self, unit: Unit, state: State) -> None:
        """Restore a loop's component."""
        if unit.knowledge is None:
            unit.component.restore(state.state)
        else:
            unit.component.restore(_without_tables(state.state, unit.knowledge))
            (plan,) = self.member.history(unit.loop, {3: state.pass_no})[:1]
            assert isinstance(plan, ChangePlan)
            unit.knowledge.plan = plan
        if state.pass_no >= self.config.episodes:
            unit.done = True
        else:
            self.member.watch(unit.loop, state.pass_no + 1)

    # A record.

    def _take(self, unit: Unit, record: Record) -> None:
        if unit.done:
            return
        self._swap(unit, record.pass_no)
        if self.may_replace(unit, record.pass_no):
            self._try(unit, record)
        else:
            self._handle(unit, record)
        self._flush(unit)
        if record.pass_no >= self.config.episodes:
            unit.done = True
            self.member.unwatch(unit.loop)

    def _handle(self, unit: Unit, record: Record) -> None:
        knowledge = unit.knowledge
        if knowledge is not None:
            knowledge.at(record.pass_no)
        _HANDLERS[self.name](unit.component, record)
        if knowledge is not None and knowledge.plan is not None:
            knowledge.adopted(knowledge.plan)

    def _flush(self, unit: Unit) -> None:
        while unit.outbox:
            record = unit.outbox.popleft()
            self.send(unit, record)
            self.member.passes += record.pass_no - max(unit.sent, 0)
            unit.sent = record.pass_no
            if unit.sent and unit.sent % self.member.joined.snapshot_every == 0:
                self.keep(unit)

    def send(self, unit: Unit, record: Record) -> None:
        """Send a record."""
        self.member.send(record)

    def keep(self, unit: Unit) -> None:
        """Have a loop's state kept at Knowledge."""
        found = self._state(unit)
        if found is not None:
            state = found[0] if unit.knowledge is None else _with_tables(found[0], unit.knowledge)
            self.member.keep(State(loop=unit.loop, pass_no=unit.sent, state=state))

    def _state(self, unit: Unit) -> tuple[Any] | None:
        """Return the component's state, or None where its part does not give it."""
        if not unit.keeps_state:
            return None
        try:
            return (plain(unit.component.state()),)
        except PartError as error:
            # A part that does not give its state is restored by doing all again from the first pass.
            unit.keeps_state = False
            logger.warning("%s keeps no state: %s", self.name, error)
            return None


def _with_tables(state: Any, knowledge: RemoteKnowledge) -> Any:
    """Return Plan's state with the Q-tables that can be recalled; where there are none, as it is."""
    if not knowledge.remembered:
        return state
    return {"schema": _REMEMBERING, "state": state, "remembered": knowledge.remembered}


def _without_tables(state: Any, knowledge: RemoteKnowledge) -> Any:
    """Let `knowledge` remember the Q-tables of such a state, and return Plan's own."""
    if not isinstance(state, dict) or state.get("schema") != _REMEMBERING:
        return state
    knowledge.restore(state["remembered"])
    return state["state"]


def plain(state: Any) -> Any:
    """Return a state if JSON gives it back as it is.

    Raises
    ------
    PartError
        It holds what JSON has no form for, such as infinity, or what comes back as something else, such as a tuple's
        place in a key.
    """
    try:
        same = json.loads(json.dumps(state, allow_nan=False, ensure_ascii=False).encode())
    except (TypeError, ValueError) as error:
        raise PartError(f"the state {state!r} is not plain JSON: {error}") from error
    if not _alike(state, same):
        raise PartError(f"the state {state!r} is not plain JSON: it comes back as {same!r}")
    return state


def _alike(state: Any, same: Any) -> bool:
    if isinstance(state, dict) and isinstance(same, dict):
        return state.keys() == same.keys() and all(_alike(state[key], same[key]) for key in same)
    if isinstance(state, list | tuple) and isinstance(same, list):
        return len(state) == len(same) and all(map(_alike, state, same))
    return bool(state == same)
