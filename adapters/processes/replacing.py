"""How a role's parts are replaced: those that the config plans, and those that are asked for while the loop runs.

A part that is asked for is held against its contract while the loop goes on. At the next pass that has no record yet it
takes the old one's place; where it fails there, or makes what Knowledge would refuse, the old one makes that pass.
Knowledge keeps from which pass on it serves before it takes the first record of it, so that whoever does this pass
again does it with the same part.
"""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from adapters.buses.member import Asked, Member
from adapters.buses.messages import Replaced, Swapped
from adapters.processes.remote import RemoteKnowledge
from adapters.roles import STAGE_OF
from adapters.stores.ledger import Fit, layout_from
from knowledge import ChangePlan, MalformedRecord, Observation, Record, from_json, to_json
from mape.allowed import check_part
from mape.config import Config
from mape.errors import BusError, ConfigError, MapekError, PartError
from mape.execute.adoption import check_actions, fitting
from mape.parts import owner, with_part
from mape.specs import PartSpec
from mape.states import faults, told
from mape.swap import replace_part, vet

logger = logging.getLogger(__name__)

_HELD = {"monitor": "detectors", "analyze": "analyzer", "plan": "planner"}
"""Role -> where its component holds its part."""

CHECKED_WITHIN = 45.0
"""Seconds that the check of a part may take, its compilation among it; who asks for the part waits some longer."""


class Due(NamedTuple):
    """A part that is to be replaced at a pass; `planned` by the config, else by somebody while the loop ran."""

    pass_no: int
    part: str
    spec: PartSpec
    planned: bool


class Wanted:
    """A part that somebody asks for while the loop runs."""

    def __init__(self, asked: Asked, part: str, spec: PartSpec) -> None:
        self.asked = asked
        self.part = part
        self.spec = spec
        self.units = 0  # loops that are to have it
        self.passes: dict[int, int] = {}  # loop -> first pass that it served
        self.handed_over = True
        self.said: bytes | str | None = None  # the answer, or why it was refused


class Unit:
    """One loop's component."""

    def __init__(self, loop: int, config: Config, swaps: list[Due]) -> None:
        self.loop = loop
        self.config = config  # with the replacements so far
        self.component: Any = None
        self.knowledge: RemoteKnowledge | None = None
        self.outbox: deque[Record] = deque()
        self.sent = -1  # pass of the last record that was sent
        self.due = deque(swaps)
        self.wanted: Wanted | None = None
        self.dropped: tuple[int, int] | None = None  # episodes of a free-running loop that are not to be logged
        self.keeps_state = True
        self.done = False


class Replacing(ABC):
    """What all roles do to replace their parts."""

    name: str
    member: Member
    units: list[Unit]

    def __init__(self) -> None:
        self._vetted: deque[tuple[Wanted, list[str]]] = deque()
        self._unanswered: list[Wanted] = []
        self._heard: dict[str, Wanted] = {}  # by `Control.question`

    @abstractmethod
    def _handle(self, unit: Unit, record: Record) -> None:
        """Have the component answer a record."""

    @abstractmethod
    def _state(self, unit: Unit) -> tuple[Any] | None:
        """Return the component's state, or None where its part does not give it."""

    def may_replace(self, unit: Unit, number: int) -> bool:
        """Whether a part that is wanted may serve pass `number`, of which the log must not hold this role's record."""
        return unit.wanted is not None and number > self.member.joined.last[unit.loop][STAGE_OF[self.name]]

    def _swap(self, unit: Unit, number: int) -> None:
        """Replace the parts that are due at pass `number`."""
        while unit.due and unit.due[0].pass_no <= number:
            due = unit.due.popleft()
            handed_over = self._replace(unit, due.part, due.spec)
            if due.planned:
                self._record(unit, due, handed_over)

    def _record(self, unit: Unit, due: Due, handed_over: bool, question: str | None = None) -> None:
        number, part, spec, planned = due
        swapped = Swapped(
            loop=unit.loop, pass_no=number, part=part, to=spec.model_dump(mode="json"), handed_over=handed_over,
            planned=planned, question=question,
        )  # fmt: skip
        self.member.swapped(swapped)

    def _replace(self, unit: Unit, part: str, spec: PartSpec) -> bool:
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
            elif control.question in self._heard:
                again = self._heard[control.question]
                again.asked = asked
                if again.said is not None:
                    self._say(again, again.said)
            else:
                wanted = Wanted(asked, control.part, spec_of(control.to))
                self._unanswered.append(wanted)
                if control.question is not None:
                    self._heard[control.question] = wanted
                # Its checks take their time, in which the loop goes on.
                threading.Thread(target=self._vet_in_time, args=(wanted,), daemon=True).start()
        except (MapekError, ValueError) as error:
            self.member.refuse(asked.query, str(error))

    def hand_out(self, asked: Asked) -> None:
        """Hand out the Q-table; only Execute has one."""
        raise BusError(f"{self.name} has no Q-table; Execute has")

    def _vet_in_time(self, wanted: Wanted) -> None:
        found: list[list[str]] = []
        checks = threading.Thread(target=lambda: found.append(self._vet(wanted)), daemon=True)
        checks.start()
        checks.join(CHECKED_WITHIN)  # a thread cannot be ended: what takes longer is no more listened to
        late = f"its check has not ended within {CHECKED_WITHIN:g} s; `mapek check` shows by clauses how far it comes"
        self._vetted.append((wanted, found[0] if found else [late]))

    def _vet(self, wanted: Wanted) -> list[str]:
        config = self.units[0].config
        try:
            check_part(config, wanted.part, wanted.spec)
            return vet(wanted.part, wanted.spec, config)
        except BaseException as error:  # a Ctrl-C is heard in the main thread: what comes here is the part's
            return [reason(error)]

    def _let_in(self) -> None:
        wanted, faults = self._vetted.popleft()
        running = [unit for unit in self.units if not unit.done]
        if not faults and not running:
            faults = ["the run is over"]
        if not faults and any(unit.wanted is not None for unit in running):
            faults = ["another part is just being replaced; ask again"]
        if faults:
            self._refuse(wanted, faults[0] + (f" ({len(faults) - 1} more)" if len(faults) > 1 else ""))
            return
        wanted.units = len(running)
        for unit in running:
            unit.wanted = wanted

    def _refuse(self, wanted: Wanted, why: str) -> None:
        sentence = f"{wanted.part} stays as it is, {wanted.spec.name!r} was refused: {why}"
        for unit in self.units:
            if unit.wanted is wanted:
                unit.wanted = None
        if wanted.passes:
            taken = ", ".join(f"{loop} from pass {number} on" for loop, number in sorted(wanted.passes.items()))
            sentence += f" In another loop it had served its first pass by then, and stays: loop {taken}."
        logger.warning("%s", sentence)
        self.member.note("swap refused", sentence[:2000])
        self._answer(wanted, sentence)

    def _refuse_all(self) -> None:
        """Say to all who still wait for an answer that the run is over."""
        for wanted in [*self._unanswered]:
            self._refuse(wanted, "the run is over")

    def _try(self, unit: Unit, record: Record) -> None:
        """Make this pass with the new part; if it fails, with the old one."""
        wanted, unit.wanted = unit.wanted, None
        assert wanted is not None
        before = self._state(unit)
        put_back = self._undo(unit)
        try:
            handed_over = self._replace(unit, wanted.part, wanted.spec)
            self._handle(unit, record)
            self._check(unit, record)
        except faults() as error:  # whatever a part of the user's does, the old one goes on
            unit.outbox.clear()
            put_back()
            if before is not None:
                unit.component.restore(before[0])
            self._refuse(wanted, reason(error))
            self._handle(unit, record)
            return
        self._took(unit, wanted, record.pass_no, handed_over)

    def _check(self, unit: Unit, given: Record) -> None:
        """Look at what a new part has made of a record as others will, for which it is too late once it is sent.

        Raises
        ------
        PartError
            It cannot be written, does not fit the run, does not hand on what it was given, or cannot be executed.
        """
        layout = self.member.joined.layout
        assert layout is not None
        fit = Fit(layout_from(layout.model_dump()))
        for made in unit.outbox:
            try:
                fit.check(from_json(to_json(made)))
            except ValueError as error:
                raise PartError(str(error)) from error
            for name in made._fields:
                if name in given._fields and (says := getattr(made, name)) != (was := getattr(given, name)):
                    raise PartError(
                        f"its {type(made).__name__} says {name} = {says}, and was given {was}; a part hands that on"
                    )
            if isinstance(made, ChangePlan):
                self._check_plan(unit, made)

    def _check_plan(self, unit: Unit, plan: ChangePlan) -> None:
        assert unit.knowledge is not None
        seen = unit.knowledge.log.find(Observation, plan.pass_no)
        assert isinstance(seen, Observation)
        if unit.config.execute.mode == "free":
            plan = fitting(plan, seen.known)
        check_actions(plan, seen.known, seen.available, unit.knowledge)

    def _undo(self, unit: Unit) -> Callable[[], None]:
        """Return what puts the parts back that a component has now."""
        component, config, knowledge = unit.component, unit.config, unit.knowledge
        plan = None if knowledge is None else knowledge.plan
        name = _HELD[self.name]
        held = getattr(component, name)
        schedule = getattr(held, "schedule", None)
        schedule_spec = getattr(component, "schedule_spec", None)

        def put_back() -> None:
            unit.config = config
            setattr(component, name, held)
            if self.name == "plan":
                component.schedule_spec = schedule_spec
            if knowledge is not None:
                knowledge.plan = plan
            if schedule is not None:
                held.schedule = schedule

        return put_back

    def _took(self, unit: Unit, wanted: Wanted, number: int, handed_over: bool) -> None:
        # Kept before the first record that the new part has made: whoever does this pass again does it with the part.
        due = Due(number, wanted.part, wanted.spec, planned=False)
        self._record(unit, due, handed_over, wanted.asked.control.question)
        wanted.passes[unit.loop] = number
        wanted.handed_over = wanted.handed_over and handed_over
        if len(wanted.passes) == wanted.units:
            passes = tuple(wanted.passes[loop] for loop in sorted(wanted.passes))
            answer = Replaced(part=wanted.part, passes=passes, handed_over=wanted.handed_over)
            self._answer(wanted, answer.pack())

    def _answer(self, wanted: Wanted, said: bytes | str) -> None:
        wanted.said = said
        self._unanswered.remove(wanted)
        self._say(wanted, said)

    def _say(self, wanted: Wanted, said: bytes | str) -> None:
        if isinstance(said, bytes):
            self.member.answer(wanted.asked, said)
        else:
            self.member.refuse(wanted.asked.query, said)


def reason(error: BaseException) -> str:
    """Return what an error says; of one that is not the loop's own, its kind too.

    >>> reason(ZeroDivisionError("no budget")), reason(MapekError("epsilon is 2"))
    ('ZeroDivisionError: no budget', 'epsilon is 2')
    """
    return str(error) if isinstance(error, MapekError) else told(error)


def spec_of(to: dict[str, Any]) -> PartSpec:
    """Return name and options of a part as a spec.

    Raises
    ------
    ConfigError
        It has no name.
    """
    try:
        return PartSpec.model_validate(to)
    except ValueError as error:
        raise ConfigError(f"{to!r} is no part: it has a name, and options") from error
