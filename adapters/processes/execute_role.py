"""Execute in a process of its own: in lockstep with the plans, or at the managed system's own rate."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, cast

from adapters.buses.member import Asked, Member
from adapters.buses.messages import State, Table
from adapters.buses.pieces import Given
from adapters.processes.detached import Brought, Detached
from adapters.processes.pulse import Pulse
from adapters.processes.replacing import Unit, Wanted, reason
from adapters.processes.role import IDLE, Role, plain
from adapters.stores.begun import BROKEN_OFF
from knowledge import ChangePlan, Observation, Record
from mape.config import Config
from mape.errors import BusError, ManagedSystemError
from mape.execute import Execute
from mape.execute.adoption import fitting
from mape.execute.attempts import Attempts
from mape.execute.checkpoint import SHARED, carried_by, take_up
from mape.loop import build_execute
from mape.states import faults

logger = logging.getLogger(__name__)

SETTLES_WITHIN = 1.0
"""Seconds that an Execute of a plant, which is to stop, takes for its last Observation to be acknowledged."""

HEARD_AT_LEAST = 0.002
"""Seconds between two episodes in which plans are put in force, even if the next one is due."""


class ExecuteRole(Role):
    """Execute of all loops; in lockstep it waits for each plan.

    Parameters
    ----------
    name, config, member
        As `Role` takes them.
    systems
        Managed systems that are there already; those that other loops need are made. `run` closes all of them.
    hang_after
        Seconds without a step after which an episode is given up, and this process with it; None for ever.
    """

    first = 0

    def __init__(
        self, name: str, config: Config, member: Member, systems: list[Any], hang_after: float | None = None
    ) -> None:
        super().__init__(name, config, member)
        self._pulse = Pulse(lambda: self.member, self._driven, hang_after)
        self.systems = systems
        self.free = config.execute.mode == "free"
        self._given = Given()

    def run(self) -> None:
        """Join, restore, and work until all loops are done, or `stopping` is set; then close the systems.

        Raises
        ------
        MapekError
            A part or the system raised, or Knowledge refuses this role.
        """
        with self._closing(), self._pulse:
            super().run()

    def _driven(self) -> dict[int, Execute]:
        return {unit.loop: unit.component for unit in [*self.units] if unit.component is not None}

    @contextmanager
    def _closing(self) -> Iterator[None]:
        try:
            yield
        finally:
            with ExitStack() as closed:  # all of them, even if one raises
                for system in self.systems:
                    closed.callback(system.close)

    def leave(self) -> None:
        """Wait until all is acknowledged; of a plant for a while even if this role is to stop, for it has no other."""
        if self.stopping.is_set() and self._cannot_drive_again():
            with suppress(BusError):
                self.member.settle(SETTLES_WITHIN)
        super().leave()

    def _cannot_drive_again(self) -> bool:
        return not all(system.redrivable for system in self.systems)

    def begin(self) -> None:
        """Make each loop's component, and restore it."""
        from adapters.systems import make_system

        while len(self.systems) < self.member.joined.units:
            self.systems.append(make_system(self.config.system))
            self.member.beat()
        super().begin()

    def make(self, unit: Unit) -> None:
        """Give a loop what its component reads; the component itself is made with its state, by `_restore`."""
        unit.knowledge = self._knowledge(unit)

    def _restore(self, unit: Unit) -> None:
        found = self.member.snapshot(unit.loop)
        checkpoint = None
        if found is not None:
            state, table = found
            if table is None:
                raise BusError(f"the state of execute at pass {state.pass_no} has no Q-table")
            checkpoint = state.state, table
        assert unit.knowledge is not None
        trial, loop = divmod(unit.loop, self.config.loops)
        # Made with its state: one that is given it later would have reset a plant for episode 1 by then.
        unit.component = build_execute(
            self.config, self.systems[unit.loop], unit.knowledge, unit.outbox.append, trial, loop, checkpoint
        )
        if found is not None and not found[0].final and (names := unit.component.carries()):
            self._from_the_first(unit, found[0].pass_no, names)
            found = None
        if found is not None:
            self._swap(unit, state.pass_no)  # the learner that served then
            unit.sent, unit.done = state.pass_no, state.final
        if not unit.done:
            # In lockstep that of the state's own pass; who runs freely may be further behind with its plans.
            in_force = unit.component.plan
            self.member.watch(unit.loop, 0 if in_force is None else in_force.pass_no + 1)
        self._count_attempts(unit)

    def _from_the_first(self, unit: Unit, number: int, names: list[str]) -> None:
        """Leave a state aside that does not tell all that the system carried, and begin with the first episode.

        Raises
        ------
        ManagedSystemError
            Some of it is held by a class or a module.
        """
        from adapters.systems import make_system

        told = (
            f"{self.config.system.id} carries {', '.join(names)} from one reset to the next, which the state kept at "
            f"pass {number} does not tell"
        )
        ways_out = "get_state() and set_state(), or takes it from the reset's seed and options['episode']"
        if any(name.startswith(SHARED) for name in names):
            raise ManagedSystemError(
                f"{told}. What a class or a module holds, no fresh environment of this process begins without, so that "
                f"not even all episodes driven again lead there. Have an environment that offers {ways_out}, and begin "
                "the run anew; or, where no episode can be had again, say redrivable = false."
            )
        told += f": all episodes are driven again, from the first. An environment that has {ways_out}, is spared that"
        logger.warning("execute: %s", told)
        self.member.note("carried", told, unit.loop, number)
        self.systems[unit.loop].close()
        self.systems[unit.loop] = make_system(self.config.system)
        assert unit.knowledge is not None
        trial, loop = divmod(unit.loop, self.config.loops)
        unit.component = build_execute(
            self.config, self.systems[unit.loop], unit.knowledge, unit.outbox.append, trial, loop
        )

    def _count_attempts(self, unit: Unit) -> None:
        """Have each attempt at an episode told, and that which was broken off with the process before this one.

        Raises
        ------
        ManagedSystemError
            It was the last attempt that is allowed.
        """
        attempts: Attempts = unit.component.attempts
        system, number = self.systems[unit.loop], unit.component.passes + 1

        def begins(number: int) -> None:
            if not system.redrivable:
                self.member.note("begun", "", unit.loop, number, surely=not self.free)

        def breaks_off(number: int, why: str) -> None:
            self.member.note("aborted", why[:2000], unit.loop, number)

        attempts.on_begin, attempts.on_abort = begins, breaks_off
        if unit.done:
            return
        last = self.member.joined.last[unit.loop][0]
        attempts.go_on_after(last + 1, self.member.joined.failed[unit.loop])
        if not system.redrivable and (begun := self.member.joined.begun[unit.loop]) >= number:
            for later in range(begun, number, -1):  # of one that runs freely, driven and not heard of
                breaks_off(later, BROKEN_OFF.format(later))
            attempts.broken_off(number, ManagedSystemError(f"{system.name}: {BROKEN_OFF.format(number)}."))

    def _handle(self, unit: Unit, record: Record) -> None:
        assert isinstance(record, ChangePlan)
        execute: Execute = unit.component
        execute.adopt(record)
        if record.pass_no < self.config.episodes:
            self.drive(unit)

    def _take(self, unit: Unit, record: Record) -> None:
        # A swap at pass n is made before episode n, which is driven under plan n - 1.
        if unit.done:
            return
        if record.pass_no < self.config.episodes and self.may_replace(unit, record.pass_no + 1):
            self._try(unit, record)
        else:
            self._handle(unit, record)
        self._flush(unit)
        if record.pass_no >= self.config.episodes:
            self.finish(unit)

    def drive(self, unit: Unit) -> None:
        """Drive the next episode."""
        number = unit.component.passes + 1
        self._swap(unit, number)
        if self.systems[unit.loop].redrivable and number % self.member.joined.snapshot_every == 0:
            unit.component.look_at(number)  # the state that is kept after it tells what was seen
        unit.component.drive()

    def finish(self, unit: Unit) -> None:
        """Have the Q-table at the end kept."""
        if unit.wanted is not None:
            self._refuse(unit.wanted, "the run is over")
        state, table = unit.component.state()
        self.member.unwatch(unit.loop)
        if not self.free:  # who runs freely says one after the other, and waits at the end
            self.member.settle()
        final = State(loop=unit.loop, pass_no=unit.component.passes, state=plain(state), final=True)
        self.member.keep_surely(final, table)
        unit.done = True

    def send(self, unit: Unit, record: Record) -> None:
        """Send an Observation; of a system that cannot be driven again with the state behind it."""
        if self.systems[unit.loop].redrivable:
            self.member.send(record)
            return
        state, table = unit.component.state()
        self.member.send(record, State(loop=unit.loop, pass_no=record.pass_no, state=plain(state)), table)

    def keep(self, unit: Unit) -> None:
        """Have a loop's state and Q-table kept at Knowledge."""
        if self.systems[unit.loop].redrivable:
            state, table = unit.component.state()
            self.member.keep(State(loop=unit.loop, pass_no=unit.sent, state=plain(state)), table)

    def _try(self, unit: Unit, record: Record) -> None:
        wanted, unit.wanted = unit.wanted, None
        assert wanted is not None
        assert isinstance(record, ChangePlan)
        unit.component.adopt(record)
        self._drive_with(unit, wanted)

    def _drive_with(self, unit: Unit, wanted: Wanted) -> None:
        """Drive the next episode with the new learner; if it fails, with the old one, from where the system was."""
        execute: Execute = unit.component
        system = self.systems[unit.loop]
        number = execute.passes + 1
        self._swap(unit, number)  # what the config plans comes first, whoever drives this episode
        old, config = execute.learner, unit.config
        carried = carried_by(system)
        execute.look_at(number)  # should it be begun again, with the old learner
        try:
            handed_over = self._replace(unit, wanted.part, wanted.spec)
            self.drive(unit)
        except faults() as error:  # whatever a learner of the user's does, the old one goes on
            unit.outbox.clear()
            execute.replace(old)
            unit.config = config
            if carried is not None:
                take_up(system, carried, ())
            self._refuse(wanted, reason(error))
            self.drive(unit)
            return
        self._took(unit, wanted, number, handed_over)

    def hand_out(self, asked: Asked) -> None:
        """Hand out the Q-table at the end of the episode that is asked for, which is the last one in lockstep."""
        control = asked.control
        if control.whole is not None and (further := self._given.further(control.whole, control.at or 0)) is not None:
            self.member.answer(asked, further)
            return
        if not 0 <= (control.loop or 0) < len(self.units):
            raise BusError(f"loop {control.loop}; this run has loops 0 to {len(self.units) - 1}")
        unit = self.units[control.loop or 0]
        passes, asked_for = unit.component.passes, control.pass_no or 0
        if asked_for > passes or (asked_for < passes and not self.free):
            raise BusError(f"Execute is at pass {unit.component.passes}, not at the end of {control.pass_no}")
        table = unit.component.q_table.copy()
        self.member.answer(asked, self._given.answer(Table(loop=unit.loop, pass_no=control.pass_no).pack(table)))


class FreeExecuteRole(ExecuteRole):
    """Execute whose managed systems are paced by their own rate and never wait.

    Each episode is driven under the newest plan that has come; all that came are put in force, in order. What cannot be
    sent fast enough is held back, at most `execute.backlog` Observations of each loop; what is beyond that is dropped,
    and said in one record when Knowledge takes records again. While they are driven, the link is another thread's: they
    do not stand still for a network either.
    """

    def run(self) -> None:
        """Join, restore, and drive at the system's rate until all loops are done, or `stopping` is set.

        Raises
        ------
        MapekError
            A part or the system raised, or Knowledge refuses this role.
        """
        rate = self.config.execute.rate
        assert rate is not None
        with self._closing(), self._pulse, self.member:
            self.begin()
            for unit in self.units:
                self._catch_up(unit)
            with Detached(self.member) as link:
                self.member = cast(Member, link)  # all of it that is used from here on
                self._drive_all(rate, link)

    def _drive_all(self, rate: float, link: Detached) -> None:
        due = time.monotonic()
        while not self.stopping.is_set() and not all(unit.done for unit in self.units):
            self._hear(due, 0.5 / rate)
            if self._vetted:
                self._let_in()
            if time.monotonic() < due:
                continue
            # Behind by more than a second, it is not caught up: the rate is the system's own.
            due = max(due + 1.0 / rate, time.monotonic() - 1.0)
            for unit in self.units:
                self._tick(unit)
        self._refuse_all()
        if not self.stopping.is_set():
            link.settle()
        elif self._cannot_drive_again():
            link.settle(SETTLES_WITHIN)

    def _hear(self, due: float, most: float) -> None:
        """Put in force what comes until the next episode is due; of what has come, for a while even if it is."""
        came: Record | Asked | Brought | None = self.member.receive(max(0.0, min(due - time.monotonic(), IDLE)))
        until = max(due, time.monotonic() + max(most, HEARD_AT_LEAST))
        while came is not None:
            if isinstance(came, Asked):
                self._asked(came)
            elif isinstance(came, Brought):
                unit = self.units[came.plan.loop]
                assert unit.knowledge is not None
                unit.knowledge.bring(came.table)
                self._adopt(unit, came.plan)
            else:
                self._adopt(self.units[came.loop], came)
            came = self.member.receive(0.0) if time.monotonic() < until else None

    def _catch_up(self, unit: Unit) -> None:
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
                if self.member.unacknowledged(unit.loop) >= self.config.execute.backlog:
                    self.member.settle()  # it is in the log, and is not to be dropped
                if same:
                    self._flush(unit)
                unit.outbox.clear()
        unit.sent = max(unit.sent, unit.component.passes)

    def _adopt_up_to(self, unit: Unit, number: int, plans: dict[int, ChangePlan]) -> None:
        execute: Execute = unit.component
        at = -1 if execute.plan is None else execute.plan.pass_no
        while at < number:
            if not plans:
                # Episodes that were dropped have no plans: the next one there is follows.
                found = self.member.history(unit.loop, {3: at + 1})
                plans.update({plan.pass_no: plan for plan in found if isinstance(plan, ChangePlan)})
            at = min(plans, default=number + 1)
            if at <= number:
                execute.adopt(fitting(plans.pop(at), _known(unit)))

    def _adopt(self, unit: Unit, record: Record) -> None:
        assert isinstance(record, ChangePlan)
        plan = unit.component.plan
        if plan is None or record.pass_no > plan.pass_no:
            unit.component.adopt(fitting(record, _known(unit)))
        if record.pass_no >= self.config.episodes:
            self.finish(unit)

    def _tick(self, unit: Unit) -> None:
        if unit.done or unit.component.plan is None or unit.component.passes >= self.config.episodes:
            return
        if self.may_replace(unit, unit.component.passes + 1):
            wanted, unit.wanted = unit.wanted, None
            assert wanted is not None
            self._drive_with(unit, wanted)
        else:
            self.drive(unit)
        self._flush(unit)

    def send(self, unit: Unit, record: Record) -> None:
        """Send an Observation if the backlog has room; else drop it, and say so when it has again."""
        # Once full, it is to be half empty before it takes again: each gap costs a state that is kept.
        most = self.config.execute.backlog if unit.dropped is None else self.config.execute.backlog // 2
        full = self.member.unacknowledged(unit.loop) > max(0, most - 1)
        if full and record.pass_no < self.config.episodes:  # the last one ends the run, and can wait
            unit.dropped = (record.pass_no if unit.dropped is None else unit.dropped[0], record.pass_no)
            return
        dropped, unit.dropped = unit.dropped, None
        if dropped is not None:
            self.member.drop(unit.loop, *dropped)
        super().send(unit, record)
        if dropped is not None:  # what the dropped episodes taught is in no record
            state, table = unit.component.state()
            self.member.keep(State(loop=unit.loop, pass_no=record.pass_no, state=plain(state)), table)


def _known(unit: Unit) -> tuple[int, ...]:
    """Return the actions that have a row in the Q-table; none before there is a table."""
    assert unit.knowledge is not None
    return unit.knowledge.actions
