"""The contracts of what decides: analyzer, schedule, planner."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, get_args

from knowledge import (
    Ack,
    ChangePlan,
    ChangeRequest,
    Drift,
    Knowledge,
    Log,
    Observation,
    QTable,
    Reading,
    RowLayout,
    Symptom,
)
from knowledge.records import Direction
from mape.execute.component import SIGNALS
from mape.ports import Analyzer, Planner, Schedule
from mape.testing.clauses import (
    Broken,
    Feed,
    Finding,
    Script,
    finite,
    judge,
    resumable,
    stream_of,
    travels,
    walk,
)
from mape.testing.quiet import by_rule

PASSES = 60
"""Passes that analyzers, schedules and planners are put through."""


def check_schedule(make: Callable[[], Schedule]) -> list[Finding]:
    """Check an exploration schedule over episodes and responses."""
    returns = stream_of((0, 60, PASSES))

    def script() -> Feed:
        def feed(parts: Sequence[Schedule], i: int) -> list[Any]:
            readings = [_epsilon(part.epsilon) for part in parts]
            for part, reading in zip(parts, readings, strict=True):
                if (again := _epsilon(part.epsilon)) != reading:
                    raise Broken(f"epsilon is {reading}, and {again} when it is read again; advance() alone changes it")
            for part in parts:
                if i % 17 == 11:
                    part.reset()
                else:
                    part.advance(returns[i])
            return readings

        return feed

    def explores_anew() -> None:
        for past in ([-abs(x) for x in returns], returns[: PASSES // 7], returns[:0]):
            first, second = make(), make()
            for x in returns:
                first.advance(x)
            for x in past:
                second.advance(x)
            first.reset()
            second.reset()
            for i, x in enumerate(returns):
                one, other = _epsilon(first.epsilon), _epsilon(second.epsilon)
                if one != other:
                    raise Broken(
                        f"two with other episodes before a reset, {len(returns)} and {len(past)}, explore at {one} and "
                        f"{other}, {i} episodes after it; reset() forgets what was counted since the last response"
                    )
                first.advance(x)
                second.advance(x)

    return judge(
        make,
        "epsilon advance() reset() state() restore()",
        [
            ("keeps epsilon in [0, 1]", walk(make, script, PASSES)),
            *resumable(make, script, PASSES),
            ("starts anew on reset, whatever the returns before it", explores_anew),
            by_rule("schedule", make, script, PASSES),
        ],
    )


def _epsilon(epsilon: Any) -> float:
    if not finite(epsilon) or not 0.0 <= epsilon <= 1.0:
        raise Broken(f"epsilon is {epsilon!r}; an exploration rate is a number in [0, 1]")
    return float(epsilon)


def check_analyzer(make: Callable[[], Analyzer]) -> list[Finding]:
    """Check an analyzer on quiet passes, alarms of two detectors, and action sets that grow and shrink."""
    returns = stream_of((0, 60, PASSES))

    def symptom(i: int) -> Symptom:
        signals = dict.fromkeys(SIGNALS, 1.0) | {"return": returns[i], "steps": 10.0 + i}
        readings = tuple(
            Reading(name, signals[name], None if i % 3 else abs(signals[name]), i % divisor == 5, direction)
            for name, divisor, direction in zip(SIGNALS[:2], (11, 7), get_args(Direction)[:2], strict=True)
        )
        if i % 13 == 8:
            readings = ()  # a run without a detector
        available = (0, 1, 2) if i % 20 < 10 else (1, 4, 0)
        return Symptom(3, i + 1, signals, available, (0, 1, 2) if i % 10 else (0, 2, 9), readings)

    def script() -> Feed:
        return lambda parts, i: [_request(part, symptom(i)) for part in parts]

    return judge(
        make,
        "analyze() state() restore()",
        [
            ("gives change requests that fit their symptom", walk(make, script, PASSES)),
            *resumable(make, script, PASSES),
            by_rule("analyzer", make, script, PASSES),
        ],
    )


def _request(analyzer: Analyzer, symptom: Symptom) -> ChangeRequest:
    seen = dict(symptom.signals)
    request = analyzer.analyze(symptom)
    _unwritten("analyze", symptom.signals, seen)
    if not isinstance(request, ChangeRequest):
        raise Broken(f"analyze() returned {request!r}; return a knowledge.ChangeRequest, also where nothing changed")
    if request[:2] != symptom[:2] or request.signals != symptom.signals:
        raise Broken(f"{request} does not hand on loop, pass and signals of {symptom}")
    watched = [drift.signal for drift in request.drifts if isinstance(drift, Drift)]
    if (
        len(watched) != len(request.drifts)
        or len(set(watched)) != len(watched)
        or not set(watched) <= {*symptom.signals}
    ):
        raise Broken(f"drifts are {request.drifts}; name each signal of the run at most once, as knowledge.Drift")
    new, gone = {*symptom.available} - {*symptom.known}, {*symptom.known} - {*symptom.available}
    if not {*request.added} <= new or not {*request.removed} <= gone:
        raise Broken(
            f"added {request.added} and removed {request.removed} with {symptom.available} available and "
            f"{symptom.known} known; added is available and not known, removed is known and not available"
        )
    travels(request)
    return request


def _unwritten(method: str, signals: dict[str, float], before: dict[str, float]) -> None:
    """See that a part left the signals as they were, which all records of a pass share, and the log."""
    if signals != before:
        raise Broken(f"{method}() wrote {signals} over the signals {before}, which the log keeps; write into a copy")


def check_planner(make: Callable[[], Planner]) -> list[Finding]:
    """Check a planner, with its schedule, over drifts and over actions that come and go."""
    script: Script = _PlannerScript
    return judge(
        make,
        "start() plan() state() restore()",
        [
            ("gives plans that can be executed, with epsilon in [0, 1]", walk(make, script, PASSES)),
            *resumable(make, script, PASSES),
            by_rule("planner", make, script, PASSES),
        ],
    )


class _PlannerScript:
    """A run in which the plans of the first planner are followed."""

    def __init__(self) -> None:
        self.available: tuple[int, ...] = (0, 1, 2)
        self.known: tuple[int, ...] = (0, 1, 2)
        self.returns = stream_of((0, 60, PASSES))
        self.knowledge: Knowledge | None = None

    def __call__(self, parts: Sequence[Planner], i: int) -> list[ChangePlan]:
        if self.knowledge is None or i == 0:
            plans = [part.start(3) for part in parts]
            self._begin(plans[0])
        assert self.knowledge is not None
        if i == 0:
            return [self._checked(plan, 0) for plan in plans]
        self.available = tuple(a for a in self.available if a != {20: 2, 33: 0}.get(i))
        self.available += {14: (7,), 33: (9, 8)}.get(i, ())
        signals = dict.fromkeys(SIGNALS, 1.0) | {"return": self.returns[i]}
        drifts = (Drift("return", "down"),) if i in (6, 25, 33, 47) else ()
        added = tuple(a for a in self.available if a not in self.known)
        removed = tuple(a for a in self.known if a not in self.available)
        request = ChangeRequest(3, i, drifts, added, removed, signals)
        before = self.knowledge.plan
        assert before is not None
        reading = Reading("return", signals["return"], None, bool(drifts), "down")
        for record in (
            Observation(3, i, i - 1, before.epsilon, before.reset_detector, 10, self.available, self.known, signals),
            Symptom(3, i, signals, self.available, self.known, (reading,)),
            request,
        ):
            self.knowledge.log.append(record)
        plans = []
        for part in parts:
            seen, known, plan = dict(signals), self.knowledge.actions, self.knowledge.plan
            plans.append(self._checked(part.plan(request, self.knowledge), i))
            _unwritten("plan", signals, seen)
            if (self.knowledge.actions, self.knowledge.plan) != (known, plan) or self.knowledge.plan is not plan:
                raise Broken("plan() wrote its own plan, or actions, into the knowledge; a planner returns its plan")
        self._follow(plans[0])
        return plans

    def _begin(self, plan: ChangePlan) -> None:
        self._checked(plan, 0)
        layout = RowLayout(SIGNALS, 1, len(plan.learning_rate), 4096)
        self.knowledge = Knowledge(Log(layout, loop=3))
        self.knowledge.serve_q_table(lambda: QTable(self.known, 4))
        self._follow(plan)

    def _checked(self, plan: Any, number: int) -> ChangePlan:
        if not isinstance(plan, ChangePlan):
            raise Broken(f"pass {number} got {plan!r}; return a knowledge.ChangePlan")
        if plan[:2] != (3, number):
            raise Broken(f"the plan of loop 3, pass {number} says loop {plan.loop}, pass {plan.pass_no}; hand them on")
        _epsilon(plan.epsilon)
        travels(plan)
        for name, actions in (("add", plan.add), ("drop", plan.drop), ("enable", plan.enable)):
            if any(type(action) is not int or action < 0 for action in actions) or len({*actions}) != len(actions):
                raise Broken(
                    f"plan {number} cannot be executed: it has {name} = {actions!r}; name each action once, ints from 0"
                )
        if not all(map(finite, plan.learning_rate)):
            raise Broken(f"plan {number} has the learning rate {plan.learning_rate!r}; give finite numbers")
        if unknown := {*plan.drop} - {*self.known, *plan.add}:
            raise Broken(f"plan {number} drops {sorted(unknown)}, which have no row; {self.known} have")
        return plan

    def _follow(self, plan: ChangePlan) -> None:
        assert self.knowledge is not None
        try:
            if plan.adopt is not None:
                self.known = self.knowledge.recall(plan.adopt).actions
            ack = self.knowledge.log.append(plan)
        except (LookupError, ValueError) as error:
            raise Broken(f"plan {plan.pass_no} cannot be executed: {error}") from error
        assert ack is Ack.OK
        self.known += tuple(a for a in plan.add if a not in self.known)
        self.known = tuple(a for a in self.known if a not in plan.drop)
        if not {*self.known} & {*self.available, *plan.enable}:
            raise Broken(
                f"plan {plan.pass_no} leaves a Q-table of the actions {self.known}; {self.available} are available, of "
                "which at least one must stay"
            )
        self.available += tuple(a for a in plan.enable if a not in self.available)
        self.knowledge.plan = plan
        self.knowledge.actions = self.known
