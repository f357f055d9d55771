"""Conformance checks for parts of your own. They need no pytest; `mapek check` prints what they find.

Each check takes a function that makes a fresh part, puts a number of such parts through a fixed script, and returns
one `Finding` per clause of the contract in `mape.ports`:

>>> from mape.monitor.page_hinkley import PageHinkley, PageHinkleyConfig
>>> for finding in check_detector(lambda: PageHinkley(PageHinkleyConfig())):
...     print(finding)
ok      has the members of the port
ok      gives plain readings: a bool, and a finite statistic or None
ok      is deterministic: two fresh ones agree, step by step
ok      gives its state as plain JSON, and as a copy
ok      takes up where its state was given, fresh or used
ok      forgets on reset the values that it has seen

In a test of your own, ``require(check_detector(make))`` raises on the first broken clause.
"""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

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
    Record,
    RowLayout,
    Symptom,
    from_json,
    to_json,
)
from knowledge.records import Direction
from mape import registry
from mape.compose import Composed, specialise
from mape.config import PartSpec
from mape.errors import PartError
from mape.execute.component import SIGNALS, Execute
from mape.execute.rules import Floats, Ints
from mape.ports import Analyzer, Detector, Episode, Learner, ManagedSystem, Planner, Schedule


class Finding(NamedTuple):
    """What became of one clause; `detail` says what is violated and how to mend it.

    A ``"note"`` breaks no contract, but takes something away, such as the resuming of a run.
    """

    check: str
    verdict: Literal["ok", "note", "failed"]
    detail: str = ""

    def __str__(self) -> str:
        return f"{self.verdict:<7} {self.check}" + (f": {self.detail}" if self.detail else "")


class _Broken(Exception):
    """A clause does not hold; the text says which, and the way out."""


class _Noted(Exception):
    """A clause holds in a lesser way."""


Clause = tuple[str, Callable[[], None]]
Feed = Callable[[Sequence[Any], int], list[Any]]
"""Puts several parts through step i of a script and returns the reading of each."""
Script = Callable[[], Feed]
"""Begins a script anew."""


def require(findings: Iterable[Finding]) -> None:
    """Raise on the findings that failed.

    Raises
    ------
    PartError
        Holds all of them, one a line.
    """
    failed = [str(finding) for finding in findings if finding.verdict == "failed"]
    if failed:
        raise PartError("\n".join(failed))


def _judge(make: Callable[[], Any], members: str, clauses: Sequence[Clause]) -> list[Finding]:
    def has_members() -> None:
        part = make()
        for member in members.split():
            name = member.removesuffix("()")
            if not hasattr(part, name):
                raise _Broken(f"{type(part).__name__} has no {member}; see its contract in mape.ports")
            if member != name and not callable(getattr(part, name)):
                raise _Broken(f"{name} is {getattr(part, name)!r}, not a method; see its contract in mape.ports")

    findings = [_outcome("has the members of the port", has_members)]
    if findings[0].verdict == "failed":
        return findings  # the other clauses would only say so again
    return findings + [_outcome(*clause) for clause in clauses]


def _outcome(check: str, clause: Callable[[], None]) -> Finding:
    try:
        clause()
    except _Broken as broken:
        return Finding(check, "failed", str(broken))
    except _Noted as note:
        return Finding(check, "note", str(note))
    except Exception as error:
        return Finding(check, "failed", f"{type(error).__name__} was raised: {error}")
    return Finding(check, "ok")


def _resumable(make: Callable[[], Any], script: Script, steps: int) -> list[Clause]:
    """Return the clauses that hold for every part with a state."""

    def deterministic() -> None:
        feed, pair = script(), (make(), make())
        for i in range(steps):
            first, second = feed(pair, i)
            if first != second:
                raise _Broken(
                    f"at step {i} two fresh ones give {first} and {second}; seed what is random, share nothing "
                    "between objects, and leave clock, hash order and global state alone"
                )

    def plain() -> None:
        feed, part = script(), make()
        for i in range(steps):
            before = part.state()
            text = _plain_json(before)
            feed((part,), i)
            if _plain_json(before) != text:
                raise _Broken(f"step {i} changed a state that was given before it; state() returns a copy")

    def takes_up() -> None:
        for used, cut in enumerate((0, 1, steps // 3, steps // 2, steps - 2)):
            feed, part, heir = script(), make(), make()
            for i in range(cut):
                feed((part,), i)
            if used % 2:
                past = script()
                for i in range(cut // 2 + 3):
                    past((heir,), i)
            heir.restore(json.loads(_plain_json(part.state())))
            told = "used" if used % 2 else "fresh"
            for i in range(cut, steps):
                given, restored = feed((part, heir), i)
                if given != restored:
                    raise _Broken(
                        f"a {told} one restored before step {cut} gives {restored} at step {i}, the original {given}; "
                        "state() holds all that update, advance or plan write, and restore() sets all of it"
                    )
            if _plain_json(part.state()) != _plain_json(heir.state()):
                raise _Broken(f"a {told} one restored before step {cut} ends in another state than the original")

    return [
        ("is deterministic: two fresh ones agree, step by step", deterministic),
        ("gives its state as plain JSON, and as a copy", plain),
        ("takes up where its state was given, fresh or used", takes_up),
    ]


def _plain_json(state: Any) -> str:
    way_out = "use None, bool, int, float, str, list and dict with text as keys"
    try:
        text = json.dumps(state, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise _Broken(f"state() is no plain JSON: {error}; {way_out}") from error
    if json.loads(text) != state:
        raise _Broken(f"state() comes back from JSON as something else: {state!r}; {way_out}")
    return text


def _walk(make: Callable[[], Any], script: Script, steps: int) -> Callable[[], None]:
    """Return a clause that puts one part through the script, whose feed says what it must not give."""

    def clause() -> None:
        feed, part = script(), make()
        for i in range(steps):
            feed((part,), i)

    return clause


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _travels(record: Record) -> None:
    try:
        again = from_json(to_json(record))
    except (TypeError, ValueError) as error:
        raise _Broken(f"{record} cannot be sent: {error}; use tuples of plain int and float") from error
    if again != record:
        raise _Broken(f"{record} arrives as {again}; use tuples of plain int and float")


def _stream(*stretches: tuple[float, float, int]) -> tuple[float, ...]:
    rng = random.Random(1954)
    return tuple(round(rng.gauss(level, spread), 6) for level, spread, count in stretches for _ in range(count))


STREAM = _stream((50, 5, 150), (-400, 5, 60), (-400, 0, 40), (9000, 200, 240), (-9000, 1, 60))
"""Signal that a detector is checked on: noise, falls, a rise, a stretch without any noise."""


def check_detector(make: Callable[[], Detector], stream: Sequence[float] = STREAM) -> list[Finding]:
    """Check a detector on `stream`; it is reset after each alarm, as Monitor does it."""

    def script() -> Feed:
        def feed(parts: Sequence[Detector], i: int) -> list[Any]:
            return [_reading(part, stream[i]) for part in parts]

        return feed

    def forgets() -> None:
        half = len(stream) // 2
        for count in (1, half):
            # As many values to both: a count of the episodes is no evidence, and may be kept.
            first, second = make(), make()
            for x, y in zip(stream[:count], reversed(stream[-count:]), strict=True):
                _reading(first, x)
                _reading(second, y)
            first.reset()
            second.reset()
            for i, x in enumerate(stream[:half]):
                one, other = _reading(first, x), _reading(second, x)
                if one != other:
                    raise _Broken(
                        f"two that saw {count} different values before their reset give {one} and {other} at value {i} "
                        "after it; reset() sets all that update() writes"
                    )

    return _judge(
        make,
        "direction statistic update() reset() state() restore()",
        [
            ("gives plain readings: a bool, and a finite statistic or None", _walk(make, script, len(stream))),
            *_resumable(make, script, len(stream)),
            ("forgets on reset the values that it has seen", forgets),
        ],
    )


def _reading(detector: Detector, x: float) -> tuple[bool, float | None, str]:
    alarm = detector.update(x)
    if type(alarm) is not bool:
        raise _Broken(f"update({x}) returned {alarm!r}, a {type(alarm).__name__}; return bool(...)")
    statistic, direction = detector.statistic, detector.direction
    if statistic is not None and not _finite(statistic):
        raise _Broken(
            f"statistic is {statistic!r} after update({x}); give a finite number, or None before there is one"
        )
    if direction not in get_args(Direction):
        raise _Broken(f"direction is {direction!r}; it is one of {', '.join(get_args(Direction))}")
    if alarm:
        detector.reset()
    return alarm, statistic, direction


PASSES = 60
"""Passes that analyzers, schedules and planners are put through."""


def check_schedule(make: Callable[[], Schedule]) -> list[Finding]:
    """Check an exploration schedule over episodes and responses."""
    returns = _stream((0, 60, PASSES))

    def script() -> Feed:
        def feed(parts: Sequence[Schedule], i: int) -> list[Any]:
            readings = [_epsilon(part.epsilon) for part in parts]
            for part in parts:
                if i % 17 == 11:
                    part.reset()
                else:
                    part.advance(returns[i])
            return readings

        return feed

    def explores_anew() -> None:
        first, second = make(), make()
        for x in returns:
            first.advance(x)
            second.advance(-abs(x))
        first.reset()
        second.reset()
        for i, x in enumerate(returns):
            one, other = _epsilon(first.epsilon), _epsilon(second.epsilon)
            if one != other:
                raise _Broken(
                    f"two with different returns before a reset explore at {one} and {other}, {i} episodes after it; "
                    "reset() forgets what was counted since the last response"
                )
            first.advance(x)
            second.advance(x)

    return _judge(
        make,
        "epsilon advance() reset() state() restore()",
        [
            ("keeps epsilon in [0, 1]", _walk(make, script, PASSES)),
            *_resumable(make, script, PASSES),
            ("starts anew on reset, whatever the returns before it", explores_anew),
        ],
    )


def _epsilon(epsilon: Any) -> float:
    if not _finite(epsilon) or not 0.0 <= epsilon <= 1.0:
        raise _Broken(f"epsilon is {epsilon!r}; an exploration rate is a number in [0, 1]")
    return float(epsilon)


def check_analyzer(make: Callable[[], Analyzer]) -> list[Finding]:
    """Check an analyzer on quiet passes, alarms of two detectors, and action sets that grow and shrink."""
    returns = _stream((0, 60, PASSES))

    def symptom(i: int) -> Symptom:
        signals = {"return": returns[i], "steps": 10.0 + i}
        readings = tuple(
            Reading(name, value, None if i % 3 else abs(value), i % divisor == 5, direction)
            for (name, value), divisor, direction in zip(signals.items(), (11, 7), get_args(Direction)[:2], strict=True)
        )
        available = (0, 1, 2) if i % 20 < 10 else (1, 4, 0)
        return Symptom(3, i + 1, signals, available, (0, 1, 2) if i % 10 else (0, 2, 9), readings)

    def script() -> Feed:
        return lambda parts, i: [_request(part, symptom(i)) for part in parts]

    return _judge(
        make,
        "analyze() state() restore()",
        [
            ("gives change requests that fit their symptom", _walk(make, script, PASSES)),
            *_resumable(make, script, PASSES),
        ],
    )


def _request(analyzer: Analyzer, symptom: Symptom) -> ChangeRequest:
    request = analyzer.analyze(symptom)
    if not isinstance(request, ChangeRequest):
        raise _Broken(f"analyze() returned {request!r}; return a knowledge.ChangeRequest, also where nothing changed")
    if request[:2] != symptom[:2] or request.signals != symptom.signals:
        raise _Broken(f"{request} does not hand on loop, pass and signals of {symptom}")
    watched = [drift.signal for drift in request.drifts if isinstance(drift, Drift)]
    if (
        len(watched) != len(request.drifts)
        or len(set(watched)) != len(watched)
        or not set(watched) <= {*symptom.signals}
    ):
        raise _Broken(f"drifts are {request.drifts}; name each signal of the run at most once, as knowledge.Drift")
    new, gone = {*symptom.available} - {*symptom.known}, {*symptom.known} - {*symptom.available}
    if not {*request.added} <= new or not {*request.removed} <= gone:
        raise _Broken(
            f"added {request.added} and removed {request.removed} with {symptom.available} available and "
            f"{symptom.known} known; added is available and not known, removed is known and not available"
        )
    _travels(request)
    return request


def check_planner(make: Callable[[], Planner]) -> list[Finding]:
    """Check a planner, with its schedule, over drifts and over actions that come and go."""
    script: Script = _PlannerScript
    return _judge(
        make,
        "start() plan() state() restore()",
        [
            ("gives plans that can be executed, with epsilon in [0, 1]", _walk(make, script, PASSES)),
            *_resumable(make, script, PASSES),
        ],
    )


class _PlannerScript:
    """A run in which the plans of the first planner are followed."""

    def __init__(self) -> None:
        self.available: tuple[int, ...] = (0, 1, 2)
        self.known: tuple[int, ...] = (0, 1, 2)
        self.returns = _stream((0, 60, PASSES))
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
        plans = [self._checked(part.plan(request, self.knowledge), i) for part in parts]
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
            raise _Broken(f"pass {number} got {plan!r}; return a knowledge.ChangePlan")
        if plan[:2] != (3, number):
            raise _Broken(f"the plan of loop 3, pass {number} says loop {plan.loop}, pass {plan.pass_no}; hand them on")
        _epsilon(plan.epsilon)
        _travels(plan)
        if unknown := {*plan.drop} - {*self.known, *plan.add}:
            raise _Broken(f"plan {number} drops {sorted(unknown)}, which have no row; {self.known} have")
        return plan

    def _follow(self, plan: ChangePlan) -> None:
        assert self.knowledge is not None
        try:
            if plan.adopt is not None:
                self.known = self.knowledge.recall(plan.adopt).actions
            ack = self.knowledge.log.append(plan)
        except (LookupError, ValueError) as error:
            raise _Broken(f"plan {plan.pass_no} cannot be executed: {error}") from error
        assert ack is Ack.OK
        self.known += tuple(a for a in plan.add if a not in self.known)
        self.known = tuple(a for a in self.known if a not in plan.drop)
        self.available += tuple(a for a in plan.enable if a not in self.available)
        self.knowledge.plan = plan
        self.knowledge.actions = self.known


# Bound by `mape.compose`.
value: Any = None
step_size: Any = None


def _probe(
    q: Floats, rows: Ints, states: Ints, epsilon: float, td_errors: Floats, rates: Floats, values: Floats, sizes: Floats
) -> int:
    """Call a learner's rules on many inputs: a template, see `mape.compose`."""
    for i in range(len(states)):
        values[i] = value(q, rows, 1 + i % len(rows), int(states[i]), epsilon)
        sizes[i] = step_size(td_errors[i], rates[i])
    return len(states)


def check_learner(make: Callable[[], Learner]) -> list[Finding]:
    """Check a learner's constants and rules, the latter both in plain Python and compiled."""

    def inputs(learner: Learner) -> tuple[Any, ...]:
        rng = np.random.default_rng(1989)
        td_errors = np.concatenate([[0.0, 1.0, -1.0, 100.0, -745.0, 1e6], rng.normal(0.0, 30.0, 194)])
        q, rates = rng.normal(0.0, 50.0, (5, 12)), np.sort(rng.random((200, len(learner.rate_names))))
        states = rng.integers(0, 12, 200)
        return (q, np.array([4, 0, 2, 1]), states, 0.3, td_errors, rates, np.empty(200), np.empty(200))

    def bound(learner: Learner) -> Composed:
        return Composed(_probe, {"value": learner.value, "step_size": learner.step_size})

    def constants() -> None:
        learner = make()
        names = learner.rate_names
        if not isinstance(names, tuple) or not all(isinstance(name, str) for name in names) or not names:
            raise _Broken(f"rate_names is {names!r}; give a tuple of the names of the learning-rate parameters")
        if not _finite(learner.discount) or not 0.0 <= learner.discount <= 1.0:
            raise _Broken(f"discount is {learner.discount!r}; it is a number in [0, 1]")
        if not isinstance(learner.bootstrap_terminal, bool):
            raise _Broken(f"bootstrap_terminal is {learner.bootstrap_terminal!r}; it is True or False")

    def pure() -> None:
        learner = make()
        given, again = inputs(learner), inputs(learner)
        rule = np.errstate(all="ignore")(bound(learner).python())
        rule(*given)
        for name, before, after in zip(("q", "rows", "states"), again, given, strict=False):
            if not np.array_equal(before, after):
                raise _Broken(f"a rule wrote into {name}; rules only read what they are given")
        if not np.array_equal(again[5], given[5]):
            raise _Broken("step_size wrote into rate; rules only read what they are given")
        for name, results in (("value", given[6]), ("step_size", given[7])):
            if not np.isfinite(results).all():
                at = int(np.flatnonzero(~np.isfinite(results))[0])
                raise _Broken(
                    f"{name} gave {results[at]} for TD error {given[4][at]}, rate {given[5][at]}; stay finite"
                )
        rule(*again)
        if not (np.array_equal(given[6], again[6]) and np.array_equal(given[7], again[7])):
            raise _Broken("the same numbers gave two results; rules keep nothing and draw nothing")

    def same_bits() -> None:
        learner = make()
        plain, compiled = inputs(learner), inputs(learner)
        np.errstate(all="ignore")(bound(learner).python())(*plain)
        specialise(bound(learner).compiled(), compiled)(*compiled)
        for name, at in (("value", 6), ("step_size", 7)):
            if (differ := np.flatnonzero(plain[at] != compiled[at])).size:
                i = int(differ[0])
                raise _Broken(
                    f"{name} gives {plain[at][i]} in Python and {compiled[at][i]} compiled; use math, not numpy, "
                    "for functions of numbers, floats where integers would overflow, and no order that may change"
                )

    return _judge(
        make,
        "rate_names discount bootstrap_terminal value() step_size()",
        [
            ("names its learning-rate parameters, a discount and bootstrap_terminal", constants),
            ("has pure rules with finite results", pure),
            ("gives the same bits compiled as in plain Python", same_bits),
        ],
    )


class _Moment(NamedTuple):
    """What a step looks like from outside, all of it comparable bit for bit."""

    action: int
    state: int
    reward: float
    ended: bool
    explorable: tuple[bool, ...]
    signals: tuple[float, ...]


EPISODES = 5
"""Episodes that a managed system is put through, each of at most `LONGEST` steps."""
LONGEST = 200


def check_system(make: Callable[[], ManagedSystem]) -> list[Finding]:
    """Check a managed system by random episodes; one with rules is learnt compiled and by calls, too.

    Whether its environment keeps to Gymnasium's own contract is a question for `gymnasium.utils.env_checker`.
    """
    made: list[Any] = []

    def fresh() -> ManagedSystem:
        made.append(make())
        return made[-1]  # type: ignore[no-any-return]

    def described() -> None:
        system = fresh()
        whole = {"n_states": (system.n_states, 1), "max_steps": (system.max_steps, 1)}
        whole |= {f"draws[{i}]": (draws, 0) for i, draws in enumerate(system.draws)}
        for name, (number, least) in whole.items():
            if type(number) is not int or number < least:
                raise _Broken(f"{name} is {number!r}; give an int of at least {least}")
        names = system.signal_names
        if not isinstance(names, tuple) or len({*names, *SIGNALS}) != len(names) + len(SIGNALS):
            raise _Broken(f"signal_names is {names!r}; give a tuple of distinct names, none of {', '.join(SIGNALS)}")
        if list(system.drifts) != sorted({*system.drifts}):
            raise _Broken(f"drifts is {system.drifts!r}; give increasing episodes")

    def plays() -> None:
        system = fresh()
        for number in range(1, EPISODES + 1):
            _play(system, number)

    def foretells() -> None:
        system = fresh()
        for number in range(1, EPISODES + 1):
            told = system.available(number)
            _, found = system.begin(_episode(system, number))
            if told is not None and {*told} != {*found}:
                raise _Broken(f"available({number}) is {told}, and episode {number} offers {found}; or return None")

    def deterministic() -> None:
        first, second = fresh(), fresh()
        for number in range(1, EPISODES + 1):
            _compare(_play(first, number), _play(second, number), f"episode {number} of two fresh ones")

    def redriven() -> None:
        system, other = fresh(), fresh()
        played = {}
        for number in range(1, EPISODES + 1):
            carried = _carried(system)
            played[number] = (carried, _play(system, number))
        for number in (EPISODES, 1, 3, 3):
            carried, moments = played[number]
            if carried is not None:
                _carried(other, carried)
            try:
                _compare(moments, _play(other, number), f"episode {number}, driven again after others")
            except _Broken as broken:
                if carried is not None:
                    raise _Broken(
                        f"{broken}, although its state was set; get_state() holds all that it carries"
                    ) from None
                raise _Noted(
                    f"not resumable: {broken}. Take all randomness from the episode's seed or uniforms, and the "
                    "episode's number from the reset; or offer get_state() and set_state()"
                ) from None

    def by_rules() -> None:
        system, other = fresh(), fresh()
        if system.rules is None:
            raise _Noted("offers no rules, so that its episodes are called step by step and not compiled")
        for number in range(1, EPISODES + 1):
            _compare(_play(system, number), _play_by_rules(other, number), f"episode {number}, by step() and by rules")

    def compiled() -> None:
        if fresh().rules is None:
            raise _Noted("offers no rules")
        called, ran = (_learn(fresh(), engine) for engine in ("python", "compiled"))
        for number, (one, other) in enumerate(zip(called, ran, strict=True), 1):
            if one != other:
                raise _Broken(
                    f"episode {number} learns {one} by calls and {other} compiled; use math, not numpy, for functions "
                    "of numbers, and floats where integers would overflow"
                )

    findings = _judge(
        fresh,
        "name n_states max_steps signal_names drifts draws rules "
        "available() begin() step() explorable() enable() close()",
        [
            ("describes itself in numbers", described),
            ("stays within its states, with finite rewards and known actions", plays),
            ("says beforehand which actions an episode offers, or nothing", foretells),
            ("is deterministic: two fresh ones play the same episodes", deterministic),
            ("plays an episode the same whatever was played before", redriven),
            ("has rules that equal its steps, bit for bit", by_rules),
            ("learns the same Q-table compiled and called", compiled),
        ],
    )
    for system in made:
        if hasattr(system, "close"):
            system.close()
    return findings


def _episode(system: ManagedSystem, number: int) -> Episode:
    generator = np.random.default_rng((1713, number))
    width = system.draws[0] + system.max_steps * system.draws[1]
    return Episode(number, int(generator.integers(2**32)), generator.random(width))


def _carried(system: ManagedSystem, state: Any = None) -> Any:
    """Return what a system says that it carries between episodes, or set it; None where it says nothing."""
    optional: Any = system
    if not hasattr(system, "get_state"):
        return None
    if state is not None:
        optional.set_state(json.loads(state))
    return _plain_json(optional.get_state())


def _play(system: ManagedSystem, number: int) -> list[_Moment]:
    state, available = system.begin(_episode(system, number))
    if not available or len({*available}) != len(available) or any(type(a) is not int or a < 0 for a in available):
        raise _Broken(f"episode {number} offers {available!r}; give at least one action, distinct ints from 0")
    _in_range(system, state, f"begin() of episode {number}")
    moments = [_Moment(-1, state, 0.0, False, tuple(bool(system.explorable(a)) for a in available), ())]
    rng = random.Random(number)
    context = np.zeros(len(system.signal_names))
    for step in range(1, min(system.max_steps, LONGEST) + 1):
        action = rng.choice(available)
        context[:] = 0.0
        state, reward, terminated, truncated = system.step(action, context)
        where = f"step({action}) in episode {number}"
        _in_range(system, state, where)
        if not _finite(reward):
            raise _Broken(f"{where} gave reward {reward!r}; rewards are finite numbers")
        if type(terminated) is not bool or type(truncated) is not bool:
            raise _Broken(f"{where} gave terminated {terminated!r}, truncated {truncated!r}; give bools")
        if not np.isfinite(context).all():
            raise _Broken(f"{where} gave signals {dict(zip(system.signal_names, context.tolist(), strict=True))}")
        ended = terminated or truncated or step == system.max_steps
        marks = () if ended else tuple(bool(system.explorable(a)) for a in available)
        moments.append(_Moment(action, state, float(reward), ended, marks, tuple(context.tolist())))
        if ended:
            break
    return moments


def _in_range(system: ManagedSystem, state: Any, where: str) -> None:
    if type(state) is not int or not 0 <= state < system.n_states:
        raise _Broken(f"{where} went to state {state!r}; states are ints from 0 to {system.n_states - 1}")


def _play_by_rules(system: ManagedSystem, number: int) -> list[_Moment]:
    rules, draws = system.rules, _episode(system, number).uniforms
    assert rules is not None
    if (rules.reset_draws, rules.step_draws) != system.draws:
        raise _Broken(f"rules take {(rules.reset_draws, rules.step_draws)} uniforms, draws says {system.draws}")
    windows = rules.windows.tolist()
    available = tuple(action for action, (first, last) in enumerate(windows) if first <= number <= last)
    phase = rules.phase(rules.params, number)
    state = rules.reset(rules.params, phase, draws, 0)

    def marks() -> tuple[bool, ...]:
        return tuple(bool(rules.explorable(rules.params, phase, state, action)) for action in available)

    moments = [_Moment(-1, state, 0.0, False, marks(), ())]
    rng = random.Random(number)
    context = np.zeros(len(system.signal_names))
    for step in range(min(system.max_steps, LONGEST)):
        action = rng.choice(available)
        context[:] = 0.0
        at = rules.reset_draws + step * rules.step_draws
        state, reward, terminated = rules.step(rules.params, phase, state, action, draws, at, context)
        ended = bool(terminated) or step + 1 == system.max_steps
        moments.append(_Moment(action, state, float(reward), ended, () if ended else marks(), tuple(context.tolist())))
        if ended:
            break
    return moments


def _compare(one: list[_Moment], other: list[_Moment], where: str) -> None:
    for step, (first, second) in enumerate(zip(one, other, strict=False)):
        if first != second:
            raise _Broken(f"{where} differs at step {step}: {first} and {second}")
    if len(one) != len(other):
        raise _Broken(f"{where} has {len(one) - 1} and {len(other) - 1} steps")


def _learn(system: ManagedSystem, engine: str) -> list[Any]:
    """Return the observations of a few episodes and, last, the hash of the Q-table."""
    learnt: list[Any] = []
    knowledge = Knowledge(Log(RowLayout(SIGNALS + system.signal_names, 0, 3, 4096)))
    learner = registry.build("learner", PartSpec(name="q_learning"))
    execute = Execute(system, learner, knowledge, learnt.append, engine=engine, max_actions=4096)
    execute.adopt(ChangePlan(0, 0, 0.5, (0.1, 0.9, 5.0), (), (), (), False, None))
    for _ in range(EPISODES):
        execute.drive()
    return [*learnt, execute.q_table.sha256()]


CHECKS: dict[str, Callable[[Callable[[], Any]], list[Finding]]] = {
    "detector": check_detector,
    "analyzer": check_analyzer,
    "schedule": check_schedule,
    "planner": check_planner,
    "learner": check_learner,
    "system": check_system,
}
"""The check of each kind of part, under the kind's name in `mape.registry`."""
