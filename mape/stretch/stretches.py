"""Makes the quiet passes of a loop in compiled stretches, between passes that the components make."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from knowledge import ChangePlan, ChangeRequest, Knowledge, Observation, QTable, Reading, Symptom
from knowledge.log import Pass
from knowledge.rows import NEXT_EPSILON, SIDES, SIGNALS, UNKNOWN
from mape import states
from mape.analyze import Analyze
from mape.compose import Composed, Rule, Uncompilable, specialise
from mape.execute import Execute
from mape.execute.binding import composed
from mape.monitor import Monitor
from mape.plan import Plan
from mape.ports import Detector, QuietRule
from mape.stretch import faults, passes
from mape.stretch.quiet import obstacle, quiet_of


def obstacles(execute: Execute, monitor: Monitor, analyze: Analyze, plan: Plan) -> list[str]:
    """Return what keeps these parts from quiet passes that are compiled, a clause for each; nothing where they can."""
    found = [] if execute.compiled else [f"system {execute.system.name} offers no rules"]
    watching = [(f"detector monitor.{k}", detector) for k, (_, detector) in enumerate(monitor.detectors)]
    for kind, part in (*watching, ("analyzer", analyze.analyzer), ("planner", plan.planner)):
        if (clause := obstacle(kind, part)) is not None:
            found.append(clause)
    return found


class Stretches:
    """The quiet passes of one loop.

    Parameters
    ----------
    execute, monitor, analyze, plan
        The components, whose parts all have a `QuietRule` (see `obstacles`).
    knowledge
        What they share.

    Raises
    ------
    ConfigError
        A rule cannot be compiled.
    PartError
        What a part declares is no rule over numbers, or one that reaches beyond its own.
    """

    def __init__(self, execute: Execute, monitor: Monitor, analyze: Analyze, plan: Plan, knowledge: Knowledge) -> None:
        self._execute = execute
        self._monitor = monitor
        self._analyze = analyze
        self._plan = plan
        self._log = knowledge.log
        self._watched = tuple(name for name, _ in monitor.detectors)
        self._parts = self._present()
        rules = self._rules()
        self._forms = _forms(rules)
        names = self._log.layout.signals
        columns = [names.index(name) for name in self._watched]
        self._bounds = _bounds(rules, columns)
        self._state = np.zeros(max(1, int(self._bounds[-1, 1])))
        self._before = np.zeros_like(self._state)
        self._params = np.zeros(max(1, int(self._bounds[-1, 3])))
        self._told = np.zeros(2, dtype=np.int64)
        values = execute.uniforms.values
        assert isinstance(values, np.ndarray)  # there are rules
        most = len(values) // execute.uniforms.width
        self._heads = np.zeros((most + 1, self._log.layout.head))
        self._integers = self._heads.view(np.int64)
        self._directions = np.zeros((most, len(self._watched)), dtype=np.int64)
        assert execute.rules is not None
        faults.floats(self._declaring(), rules)  # looked at before anything is compiled
        faults.check_reach(self._declaring(), rules, len(names))
        try:
            self._bound = _compiled(composed(execute.rules, execute.learner), *(rule.function for rule in rules))
            self._take(execute.q_table)
        except Uncompilable as error:
            raise faults.named(error, self._declaring(), rules, len(names)) from error

    @property
    def fit(self) -> bool:
        """Whether the parts, and the rules that they declare, are still those for which these passes were compiled."""
        same = all(now is then for now, then in zip(self._present(), self._parts, strict=True))
        return same and _forms(self._rules()) == self._forms

    def run(self, until: int, between: Callable[[], object]) -> bool:
        """Make passes up to number `until`, as long as they are quiet; call `between` before each compiled call.

        Returns
        -------
        Whether pass `until` is made, or the Observation of the next pass is sent, which is not quiet; else the next
        pass is to be driven.
        """
        execute = self._execute
        if not self._plan.answered:
            return False  # what a planner repeats in a quiet pass, it has said at least once
        if self._log.passes != execute.passes:
            return False  # a part failed at the newest pass: the log says what is missing
        if execute.q_table is not self._table:
            self._take(execute.q_table)
        while execute.passes < until:
            between()
            room = self._log.room()  # asked first: a listener that hears of rows then may want traces
            count = execute.quiet_until(until) - execute.passes
            if count < 1:
                return False
            at = execute.uniforms.find(execute.passes)
            blocks = self._blocks(at)
            status = self._make(min(count, blocks, room), at)
            if status == passes.BROKEN:
                return False
            if status == passes.HANDED_OVER:
                names = self._log.layout.signals
                signals = self._heads[int(self._told[passes.FINISHED]), SIGNALS : SIGNALS + len(names)].tolist()
                execute.observe(int(signals[1]), dict(zip(names, signals, strict=True)))
                return True
        return True

    def _blocks(self, at: int) -> int:
        """Return how many blocks of uniforms are held from `at` on."""
        values = self._execute.uniforms.values
        assert isinstance(values, np.ndarray)
        return (len(values) - at) // self._execute.uniforms.width

    def _take(self, table: QTable) -> None:
        self._table = table  # one of a single row has another type in compiled code than one of several
        self._passes = specialise(self._bound, self._arguments(1, 1, 0.5, 0), "stretches of passes with these parts")

    def _make(self, count: int, at: int) -> int:
        """Make at most `count` passes, and log those that are finished; return what ended them.

        What is raised meanwhile by nobody's rule, such as a KeyboardInterrupt, is raised when that is done.
        """
        execute, first = self._execute, self._execute.passes + 1
        plan = execute.plan
        assert plan is not None
        rules = self._rules()
        if _forms(rules) != self._forms:
            return passes.BROKEN  # a part put another rule, or more or fewer numbers, in the place of its own
        state, params = faults.floats(self._declaring(), rules)
        self._state[: len(state)] = state
        self._params[: len(params)] = params
        for k, (_, detector) in enumerate(self._monitor.detectors, -len(self._watched)):
            self._heads[-1, k] = math.nan if _has_none(detector) else 0.0
        raised: BaseException | None = None
        self._told[:] = (passes.DONE, 0)  # what holds if not even the first one is begun
        try:
            self._passes(*self._arguments(first, count, plan.epsilon, at))
        except BaseException as error:
            raised = error
        status, finished = self._told.tolist()
        if status == passes.BROKEN:
            self._state[:] = self._before
            if isinstance(raised, Exception):
                raised = None  # a rule's: the components make this pass again, and say which
        if status == passes.BROKEN or (status == passes.HANDED_OVER and raised is not None):
            execute.roll_back()
        numbers = self._state.tolist()
        for rule, (begin, end) in zip(rules, self._bounds[:, :2].tolist(), strict=True):
            rule.state[:] = numbers[begin:end]
        if finished:
            self._keep(first, finished, plan.learning_rate)
        if raised is not None:
            raise raised
        return int(status)

    def _keep(self, first: int, count: int, rate: tuple[float, ...]) -> None:
        execute, layout = self._execute, self._log.layout
        newest = _quiet_plan(self._log.loop, first + count - 1, float(self._heads[count - 1, NEXT_EPSILON]), rate)
        execute.follow(newest)
        self._plan.follow(newest)
        quiet = functools.partial(
            _quiet_pass, self._log.loop, layout.signals, self._watched, execute.available, execute.q_table.actions, rate
        )
        rows = layout.of_heads(quiet(first), self._heads[:count], self._directions[:count])
        self._log.extend(rows, lambda row: quiet(*_of_row(row)))

    def _present(self) -> tuple[Any, ...]:
        planner, detectors = self._plan.planner, self._monitor.detectors
        schedule = getattr(planner, "schedule", None)
        return (planner, self._analyze.analyzer, *detectors, schedule, self._execute.learner)

    def _declaring(self) -> tuple[Any, ...]:
        detectors = [detector for _, detector in self._monitor.detectors]
        return (self._plan.planner, self._analyze.analyzer, *detectors)

    def _rules(self) -> list[QuietRule]:
        # Asked anew: a part may have put another list in the place of its numbers.
        found = []
        for k, part in enumerate(self._declaring()):
            if (rule := quiet_of(part)) is not None:
                faults.check_shape(k, part, rule)
                found.append(rule)
        return found

    def _arguments(self, first: int, count: int, epsilon: float, at: int) -> tuple[Any, ...]:
        return (
            first,
            count,
            epsilon,
            at,
            self._execute.uniforms.width,
            self._told,
            self._heads,
            self._integers,
            self._directions,
            self._state,
            self._before,
            self._params,
            self._bounds,
            *self._execute.arguments,
        )


@functools.cache
def _compiled(drive: Composed, explore: Rule, changed: Rule, *detectors: Rule) -> Any:
    # Once per process: reading the sources for their hash costs as much as a trial.
    sense: Any = passes.sense_none
    for detector in reversed(detectors):
        sense = Composed(passes.sense_each, {"detector": detector, "others": sense})
    bound = {"drive": drive, "sense": sense, "changed": changed, "explore": explore}
    return Composed(passes.passes, bound).compiled()


def _forms(rules: Sequence[QuietRule]) -> list[tuple[Rule, int, int]]:
    """Return what is fixed of rules: which they are, and how many numbers they have."""
    return [(rule.function, len(rule.state), len(rule.params)) for rule in rules]


def _has_none(detector: Detector) -> bool:
    """Whether a detector has no statistic; one that cannot say so before its first value may have one."""
    try:
        return detector.statistic is None
    except states.faults():  # it is read after each value, and what it raises then is told
        return False


def _bounds(rules: Sequence[QuietRule], columns: Sequence[int]) -> npt.NDArray[np.int64]:
    """Say where each part's numbers stand; see `passes.passes`."""
    bounds, state, params = [], 0, 0
    for rule, column in zip(rules, (0, 0, *columns), strict=True):
        bounds.append((state, state + len(rule.state), params, params + len(rule.params), column))
        state, params = bounds[-1][1], bounds[-1][3]
    return np.array(bounds, dtype=np.int64)


def _quiet_plan(loop: int, number: int, epsilon: float, rate: tuple[float, ...]) -> ChangePlan:
    """Return the plan that answers a request in which nothing changed."""
    return ChangePlan(loop, number, epsilon, rate, (), (), (), False, None)


def _quiet_pass(
    loop: int,
    names: tuple[str, ...],
    watched: tuple[str, ...],
    available: tuple[int, ...],
    known: tuple[int, ...],
    rate: tuple[float, ...],
    number: int,
    steps: int = 0,
    epsilons: tuple[float, float] = (0.0, 0.0),
    values: Sequence[float] = (),
    statistics: Sequence[float] = (),
    directions: Sequence[int] = (),
) -> Pass:
    """Return the four records of a quiet pass."""
    signals = dict(zip(names, values or (0.0,) * len(names), strict=True))
    readings = tuple(
        Reading(name, signals[name], None if math.isnan(statistic) else statistic, False, SIDES[side])
        for name, statistic, side in zip(
            watched, statistics or (0.0,) * len(watched), directions or (UNKNOWN,) * len(watched), strict=True
        )
    )
    return Pass(
        Observation(loop, number, number - 1, epsilons[0], False, steps, available, known, signals),
        Symptom(loop, number, signals, available, known, readings),
        ChangeRequest(loop, number, (), (), (), signals),
        _quiet_plan(loop, number, epsilons[1], rate),
    )


def _of_row(row: Any) -> tuple[Any, ...]:
    """Return what a row of the log says of its own quiet pass."""
    columns = ("signals", "statistic", "direction")
    epsilons = (float(row["epsilon"]), float(row["next_epsilon"]))
    return (int(row["pass"]), int(row["steps"]), epsilons, *(row[column].tolist() for column in columns))
