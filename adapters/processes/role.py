"""A component of the loop in a process of its own: restored after a crash, and done when the run is.

    restore the newest state -> do again what came after it -> go on

What is done again is sent again, and Knowledge answers ``duplicate``: that it is the same, byte for byte, shows that
nothing was lost, and nothing done twice.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from adapters.buses.member import Asked, Member
from adapters.buses.messages import Layout, State, Swap, Swapped, Table
from adapters.processes.remote import RemoteKnowledge
from adapters.stores.ledger import layout_from
from knowledge import ChangePlan, MalformedRecord, Observation, QTable, Record
from mape.analyze import Analyze
from mape.config import Config
from mape.errors import BusError, ConfigError, MapekError, PartError
from mape.execute import Execute
from mape.execute.adoption import fitting
from mape.loop import build_analyze, build_execute, build_monitor, build_plan, layout_of
from mape.monitor import Monitor
from mape.plan import Plan
from mape.specs import PartSpec
from mape.swap import owner, replace_part, vet, with_part

logger = logging.getLogger(__name__)

IDLE = 0.5
"""Seconds that a role waits for a record before it looks whether it is to end."""


_HANDLERS: dict[str, Callable[[Any, Any], None]] = {
    "monitor": Monitor.on_observation,
    "analyze": Analyze.on_symptom,
    "plan": Plan.on_request,
}


_HELD = {"monitor": "detectors", "analyze": "analyzer", "plan": "planner"}
"""Role -> where its component holds its part."""


class _Due(NamedTuple):
    pass_no: int
    part: str
    spec: PartSpec
    planned: bool


class _Live:
    """A replacement that was asked for while the loop runs."""

    def __init__(self, asked: Asked, part: str, spec: PartSpec, units: int) -> None:
        self.asked = asked
        self.part = part
        self.spec = spec
        self.passes: dict[int, int] = {}
        self.units = units
        self.handed_over = True


class _Unit:
    """One loop's component."""

    def __init__(self, loop: int, config: Config, swaps: list[_Due]) -> None:
        self.loop = loop
        self.config = config  # with the replacements so far
        self.component: Any = None
        self.knowledge: RemoteKnowledge | None = None
        self.outbox: deque[Record] = deque()
        self.sent = -1  # pass of the last record that was sent
        self.due = deque(swaps)
        self.live: _Live | None = None
        self.dropped: tuple[int, int] | None = None  # episodes of a free-running loop that are not to be logged
        self.keeps_state = True
        self.done = False


class Role:
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
        self.name = name
        self.config = config
        self.member = member
        self.units: list[_Unit] = []
        self._vetted: deque[tuple[_Live, list[str]]] = deque()
        self._lives: list[_Live] = []
        self.stopping = threading.Event()

    def run(self) -> None:
        """Join, restore, and work until all loops are done, or `stopping` is set.

        Raises
        ------
        MapekError
            A part or the system raised, or Knowledge refuses this role.
        """
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
            if not self.stopping.is_set():
                self.member.settle()

    def begin(self) -> None:
        """Make each loop's component, and restore it."""
        joined = self.member.joined
        recorded: dict[int, list[_Due]] = {}
        for swap in joined.swaps:
            recorded.setdefault(swap.loop, []).append(_Due(swap.pass_no, swap.part, _spec(swap.to), planned=False))
        planned = [_Due(swap.pass_no, swap.part, swap.to, planned=True) for swap in self.config.swap]
        for loop in range(joined.units):
            swaps = [s for s in [*planned, *recorded.get(loop, [])] if owner(s.part) == self.name]
            unit = _Unit(loop, self.config, sorted(swaps, key=lambda s: s.pass_no))
            self.units.append(unit)
            self.make(unit)
            self._restore(unit)

    def make(self, unit: _Unit) -> None:
        """Give a loop its component."""
        send = unit.outbox.append
        if self.name == "monitor":
            unit.component = build_monitor(self.config, send)
        elif self.name == "analyze":
            unit.component = build_analyze(self.config, send)
        else:
            unit.knowledge = self._knowledge(unit)
            unit.component = build_plan(self.config, unit.knowledge, send)

    def _knowledge(self, unit: _Unit) -> RemoteKnowledge:
        assert self.member.joined.layout is not None
        return RemoteKnowledge(self.member, layout_from(self.member.joined.layout.model_dump()), unit.loop)

    def _restore(self, unit: _Unit) -> None:
        found = self.member.snapshot(unit.loop)
        if found is None:
            self.start(unit)
            self.member.watch(unit.loop, self.first)
            return
        state, table = found
        self._swap(unit, state.pass_no)  # the state is that of the parts that served then
        self.take_up(unit, state, table)
        unit.sent = state.pass_no

    def start(self, unit: _Unit) -> None:
        """Begin a loop that has no state yet."""
        if self.name == "plan":
            unit.component.start(unit.loop)
            self._flush(unit)

    def take_up(self, unit: _Unit, state: State, table: QTable | None) -> None:
        """Restore a loop's component."""
        unit.component.restore(state.state)
        if state.pass_no >= self.config.episodes:
            unit.done = True
        else:
            self.member.watch(unit.loop, state.pass_no + 1)

    # A record.

    def _take(self, unit: _Unit, record: Record) -> None:
        if unit.done:
            return
        if unit.knowledge is not None:
            unit.knowledge.at(record.pass_no)
        self._swap(unit, record.pass_no)
        if unit.live is not None:
            self._try(unit, record)
        else:
            self._handle(unit, record)
        self._flush(unit)
        if record.pass_no >= self.config.episodes:
            unit.done = True
            self.member.unwatch(unit.loop)

    def _handle(self, unit: _Unit, record: Record) -> None:
        _HANDLERS[self.name](unit.component, record)

    def _flush(self, unit: _Unit) -> None:
        while unit.outbox:
            record = unit.outbox.popleft()
            self.send(unit, record)
            self.member.passes += record.pass_no - max(unit.sent, 0)
            unit.sent = record.pass_no
            if unit.sent and unit.sent % self.member.joined.snapshot_every == 0:
                self.keep(unit)

    def send(self, unit: _Unit, record: Record) -> None:
        """Send a record."""
        self.member.send(record)

    def keep(self, unit: _Unit) -> None:
        """Have a loop's state kept at Knowledge."""
        state = self._state(unit)
        if state is not None:
            self.member.keep(State(loop=unit.loop, pass_no=unit.sent, state=state[0]))

    def _state(self, unit: _Unit) -> tuple[Any] | None:
        """Return the component's state, or None where its part does not give it."""
        if not unit.keeps_state:
            return None
        try:
            return (unit.component.state(),)
        except PartError as error:
            # A part that does not give its state is restored by doing all again from the first pass.
            unit.keeps_state = False
            logger.warning("%s keeps no state: %s", self.name, error)
            return None

    # Replacing a part.

    def _swap(self, unit: _Unit, number: int) -> None:
        """Replace the parts that are due at pass `number`."""
        while unit.due and unit.due[0].pass_no <= number:
            due = unit.due.popleft()
            handed_over = self._replace(unit, due.part, due.spec)
            if due.planned:
                self._record(unit, due, handed_over)

    def _record(self, unit: _Unit, due: _Due, handed_over: bool) -> None:
        number, part, spec, planned = due
        to = spec.model_dump(mode="json")
        self.member.swapped(
            Swapped(loop=unit.loop, pass_no=number, part=part, to=to, handed_over=handed_over, planned=planned)
        )

    def _replace(self, unit: _Unit, part: str, spec: PartSpec) -> bool:
        assert self.member.joined.layout is not None
        signals = self.member.joined.layout.signals
        handed_over = replace_part(unit.component, part, spec, unit.config, signals=signals)
        unit.config = with_part(unit.config, part, spec)
        return handed_over

    def _asked(self, asked: Asked) -> None:
        control = asked.control
        try:
            if control.what == "q_table":
                self.hand_out(asked)
            elif control.part is None or control.to is None:
                raise MalformedRecord("a swap names the part, and what it is to be")
            elif owner(control.part) != self.name:
                raise ConfigError(f"{control.part} is a part of {owner(control.part)}, not of {self.name}")
            else:
                live = _Live(asked, control.part, _spec(control.to), len(self.units))
                # Its checks take their time, in which the loop goes on.
                threading.Thread(target=self._vet, args=(live,), daemon=True).start()
        except (MapekError, ValueError) as error:
            self.member.refuse(asked.query, str(error))

    def hand_out(self, asked: Asked) -> None:
        """Hand out the Q-table; only Execute has one."""
        raise BusError(f"{self.name} has no Q-table; Execute has")

    def _vet(self, live: _Live) -> None:
        try:
            faults = vet(live.part, live.spec, self.units[0].config)
        except Exception as error:  # whatever a part of the user's does, the loop goes on
            faults = [str(error) or type(error).__name__]
        self._vetted.append((live, faults))

    def _let_in(self) -> None:
        live, faults = self._vetted.popleft()
        running = [unit for unit in self.units if not unit.done]
        if not faults and not running:
            faults = ["the run is over"]
        if not faults and any(unit.live is not None for unit in running):
            faults = ["another part is just being replaced; ask again"]
        if faults:
            self._refuse(live, "; ".join(faults))
            return
        live.units = len(running)
        for unit in running:
            unit.live = live

    def _refuse(self, live: _Live, why: str) -> None:
        sentence = f"{live.part} stays as it is, {live.spec.name!r} was refused: {why}"
        for unit in self.units:
            if unit.live is live:
                unit.live = None
        if live.passes:
            taken = ", ".join(f"{loop} from pass {number} on" for loop, number in sorted(live.passes.items()))
            sentence += f" In another loop it had served its first pass by then, and stays: loop {taken}."
        logger.warning("%s", sentence)
        self.member.note("swap refused", sentence[:2000])
        self.member.refuse(live.asked.query, sentence)

    def _try(self, unit: _Unit, record: Record) -> None:
        """Make this pass with the new part; if it fails, with the old one."""
        live, unit.live = unit.live, None
        assert live is not None
        before = self._state(unit)
        put_back = self._undo(unit)
        try:
            handed_over = self._replace(unit, live.part, live.spec)
            self._handle(unit, record)
        except MapekError as error:
            unit.outbox.clear()
            put_back()
            if before is not None:
                unit.component.restore(before[0])
            self._refuse(live, str(error))
            self._handle(unit, record)
            return
        self._took(unit, live, record.pass_no, handed_over)

    def _undo(self, unit: _Unit) -> Callable[[], None]:
        """Return what puts the parts back that a component has now."""
        component, config = unit.component, unit.config
        name = _HELD[self.name]
        held = getattr(component, name)
        schedule = getattr(held, "schedule", None)

        def put_back() -> None:
            unit.config = config
            setattr(component, name, held)
            if schedule is not None:
                held.schedule = schedule

        return put_back

    def _took(self, unit: _Unit, live: _Live, number: int, handed_over: bool) -> None:
        # Kept before the first record that the new part has made: whoever does this pass again does it with the part.
        self._record(unit, _Due(number, live.part, live.spec, planned=False), handed_over)
        live.passes[unit.loop] = number
        live.handed_over = live.handed_over and handed_over
        if len(live.passes) == live.units:
            passes = tuple(live.passes[loop] for loop in sorted(live.passes))
            answer = Swap(part=live.part, passes=passes, handed_over=live.handed_over)
            self.member.answer(live.asked, answer.pack())


class ExecuteRole(Role):
    """Execute of all loops, with their managed systems; in lockstep it waits for each plan."""

    first = 0

    def __init__(self, name: str, config: Config, member: Member, systems: list[Any]) -> None:
        super().__init__(name, config, member)
        self.systems = systems
        self.free = config.execute.mode == "free"

    def begin(self) -> None:
        """Make each loop's component, and restore it."""
        from adapters.systems import make_system

        while len(self.systems) < self.member.joined.units:
            self.systems.append(make_system(self.config.system))
        super().begin()

    def make(self, unit: _Unit) -> None:
        """Give a loop its component."""
        unit.knowledge = self._knowledge(unit)
        trial, loop = divmod(unit.loop, self.config.loops)
        unit.component = build_execute(
            self.config, self.systems[unit.loop], unit.knowledge, unit.outbox.append, trial, loop
        )

    def start(self, unit: _Unit) -> None:
        """Do nothing: plan 0 begins the loop."""

    def take_up(self, unit: _Unit, state: State, table: QTable | None) -> None:
        """Restore a loop's component, and note an episode that was broken off and cannot be driven again."""
        if table is None:
            raise BusError(f"the state of execute at pass {state.pass_no} has no Q-table")
        unit.component.restore(state.state, table)
        if state.final:
            unit.done = True
            return
        begun = self.member.joined.begun[unit.loop]
        if begun > state.pass_no and not self.systems[unit.loop].redrivable:
            self.member.note(
                "aborted",
                f"episode {begun} was broken off with its process, and the system cannot be driven through it again; "
                "it was begun anew",
                unit.loop,
                begun,
            )
        self.member.watch(unit.loop, state.pass_no)

    def _handle(self, unit: _Unit, record: Record) -> None:
        assert isinstance(record, ChangePlan)
        execute: Execute = unit.component
        execute.adopt(record)
        if record.pass_no < self.config.episodes:
            self.drive(unit)

    def _take(self, unit: _Unit, record: Record) -> None:
        # A swap at pass n is made before episode n, which is driven under plan n - 1.
        if unit.done:
            return
        if unit.live is not None and record.pass_no < self.config.episodes:
            self._try(unit, record)
        else:
            self._handle(unit, record)
        self._flush(unit)
        if record.pass_no >= self.config.episodes:
            self.finish(unit)

    def drive(self, unit: _Unit) -> None:
        """Drive the next episode."""
        number = unit.component.passes + 1
        self._swap(unit, number)
        if not self.systems[unit.loop].redrivable:
            self.member.note("begun", "", unit.loop, number, surely=not self.free)
        unit.component.drive()

    def finish(self, unit: _Unit) -> None:
        """Have the Q-table at the end kept."""
        if unit.live is not None:
            self._refuse(unit.live, "the run is over")
        state, table = unit.component.state()
        self.member.unwatch(unit.loop)
        self.member.settle()
        self.member.keep_surely(State(loop=unit.loop, pass_no=unit.component.passes, state=state, final=True), table)
        unit.done = True

    def send(self, unit: _Unit, record: Record) -> None:
        """Send an Observation; of a system that cannot be driven again with the state behind it."""
        if self.systems[unit.loop].redrivable:
            self.member.send(record)
            return
        state, table = unit.component.state()
        packed = State(loop=unit.loop, pass_no=record.pass_no, state=state).pack(table)
        self.member.send(record, packed)

    def keep(self, unit: _Unit) -> None:
        """Have a loop's state and Q-table kept at Knowledge."""
        if self.systems[unit.loop].redrivable:
            state, table = unit.component.state()
            self.member.keep(State(loop=unit.loop, pass_no=unit.sent, state=state), table)

    def _try(self, unit: _Unit, record: Record) -> None:
        live, unit.live = unit.live, None
        assert live is not None
        assert isinstance(record, ChangePlan)
        unit.component.adopt(record)
        self._drive_with(unit, live)

    def _drive_with(self, unit: _Unit, live: _Live) -> None:
        """Drive the next episode with the new learner; if it fails, with the old one."""
        execute: Execute = unit.component
        old, config, number = execute.learner, unit.config, execute.passes + 1
        try:
            handed_over = self._replace(unit, live.part, live.spec)
            self.drive(unit)
        except MapekError as error:
            unit.outbox.clear()
            execute.replace(old)
            unit.config = config
            self._refuse(live, str(error))
            self.drive(unit)
            return
        self._took(unit, live, number, handed_over)

    def hand_out(self, asked: Asked) -> None:
        """Hand out the Q-table at the end of the episode that is asked for, which is the last one in lockstep."""
        control = asked.control
        if not 0 <= (control.loop or 0) < len(self.units):
            raise BusError(f"loop {control.loop}; this run has loops 0 to {len(self.units) - 1}")
        unit = self.units[control.loop or 0]
        if not self.free and unit.component.passes != control.pass_no:
            raise BusError(f"Execute is at pass {unit.component.passes}, not at the end of {control.pass_no}")
        table = unit.component.q_table.copy()
        self.member.answer(asked, Table(loop=unit.loop, pass_no=control.pass_no).pack(table))


class FreeExecuteRole(ExecuteRole):
    """Execute whose managed systems are paced by their own rate and never wait.

    Each episode is driven under the newest plan that has come; all that came are put in force, in order. What cannot be
    sent fast enough is held back, at most `execute.backlog` Observations of each loop; what is beyond that is dropped,
    and said in one record when Knowledge takes records again.
    """

    def run(self) -> None:
        """Join, restore, and drive at the system's rate until all loops are done, or `stopping` is set."""
        rate = self.config.execute.rate
        assert rate is not None
        with self.member:
            self.begin()
            for unit in self.units:
                self._catch_up(unit)
            due = time.monotonic()
            while not self.stopping.is_set() and not all(unit.done for unit in self.units):
                left = due - time.monotonic()
                came = self.member.receive(max(0.0, min(left, IDLE)))
                while came is not None:
                    if isinstance(came, Asked):
                        self._asked(came)
                    else:
                        self._adopt(self.units[came.loop], came)
                    came = self.member.receive(0.0) if time.monotonic() < due + 1.0 / rate else None
                if self._vetted:
                    self._let_in()
                if time.monotonic() < due:
                    continue
                # Behind by more than a second, it is not caught up: the rate is the system's own.
                due = max(due + 1.0 / rate, time.monotonic() - 1.0)
                for unit in self.units:
                    self._tick(unit)
            if not self.stopping.is_set():
                self.member.settle()

    def _catch_up(self, unit: _Unit) -> None:
        """Drive again what is in the log after the restored state, each episode under the plan that it names.

        What dropped episodes taught is lost. What is driven again after them may differ, and is not sent again.
        """
        last = self.member.joined.last[unit.loop][0]
        same, plans = True, dict[int, ChangePlan]()
        while unit.component.passes < last:
            found = self.member.history(unit.loop, {0: unit.component.passes + 1})
            seen = [record for record in found if isinstance(record, Observation)]
            if not seen:
                unit.component.passes = last  # the last ones were dropped
            for record in seen:
                same = same and record.pass_no == unit.component.passes + 1
                unit.component.passes = record.pass_no - 1
                self.member.beat()
                self._adopt_up_to(unit, record.plan, plans)
                self.drive(unit)
                if same:
                    self._flush(unit)
                unit.outbox.clear()
        unit.sent = max(unit.sent, unit.component.passes)

    def _adopt_up_to(self, unit: _Unit, number: int, plans: dict[int, ChangePlan]) -> None:
        execute: Execute = unit.component
        at = -1 if execute.plan is None else execute.plan.pass_no
        while at < number:
            if at + 1 not in plans:
                found = self.member.history(unit.loop, {3: at + 1})
                plans.update({plan.pass_no: plan for plan in found if isinstance(plan, ChangePlan)})
            at += 1
            execute.adopt(fitting(plans.pop(at), execute.q_table.actions))

    def _adopt(self, unit: _Unit, record: Record) -> None:
        assert isinstance(record, ChangePlan)
        plan = unit.component.plan
        if plan is None or record.pass_no > plan.pass_no:
            unit.component.adopt(fitting(record, unit.component.q_table.actions))
        if record.pass_no >= self.config.episodes:
            self.finish(unit)

    def _tick(self, unit: _Unit) -> None:
        if unit.done or unit.component.plan is None or unit.component.passes >= self.config.episodes:
            return
        live, unit.live = unit.live, None
        if live is not None:
            self._drive_with(unit, live)
        else:
            self.drive(unit)
        self._flush(unit)

    def send(self, unit: _Unit, record: Record) -> None:
        """Send an Observation if the backlog has room; else drop it, and say so when it has again."""
        full = self.member.unacknowledged(unit.loop) >= self.config.execute.backlog
        if full and record.pass_no < self.config.episodes:  # the last one ends the run, and can wait
            unit.dropped = (record.pass_no if unit.dropped is None else unit.dropped[0], record.pass_no)
            return
        dropped, unit.dropped = unit.dropped, None
        if dropped is not None:
            self.member.drop(unit.loop, *dropped)
        super().send(unit, record)
        if dropped is not None:  # what the dropped episodes taught is in no record
            state, table = unit.component.state()
            self.member.keep(State(loop=unit.loop, pass_no=record.pass_no, state=state), table)


def make_role(name: str, config: Config, member_of: Callable[[Layout | None], Member]) -> Role:
    """Make a role, with a link to Knowledge that `member_of` makes of the layout that Execute has to tell.

    Raises
    ------
    ConfigError
        The system or a part cannot be made.
    """
    if name != "execute":
        return Role(name, config, member_of(None))
    # Gymnasium takes its time to import, and the other roles have no use for it.
    from adapters.systems import make_system

    system = make_system(config.system)
    layout = layout_of(config, system)
    told = Layout(
        signals=layout.signals, detectors=layout.detectors, rates=layout.rates, max_actions=layout.max_actions
    )
    kind = FreeExecuteRole if config.execute.mode == "free" else ExecuteRole
    return kind(name, config, member_of(told), [system])


def _spec(to: dict[str, Any]) -> PartSpec:
    try:
        return PartSpec.model_validate(to)
    except ValueError as error:
        raise ConfigError(f"{to!r} is no part: it has a name, and options") from error
