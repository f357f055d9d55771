"""The clause that a part's rule of quiet passes (`mape.ports.QuietRule`) does what its methods do."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from knowledge import ChangePlan, ChangeRequest, Knowledge, Symptom
from knowledge.records import Direction
from knowledge.rows import SIDES
from mape.compose import Composed, specialise
from mape.errors import ConfigError
from mape.ports import Json, QuietRule
from mape.stretch.faults import misshapen
from mape.stretch.quiet import obstacle, quiet_of
from mape.testing.clauses import Broken, Clause, Noted, Script, plain_json

# Bound by `mape.compose`.
rule: Any = None


def probe_one(state: Any, params: Any, given: Any, told: Any) -> None:
    """Write what a rule answers into `told`: a template, see `mape.compose`."""
    told[0] = rule(state, params, given)


def probe_three(state: Any, params: Any, given: Any, told: Any) -> None:
    """Write what a rule of a detector answers into `told`: a template, see `mape.compose`."""
    alarm, statistic, direction = rule(state, params, given)
    told[0] = alarm
    told[1] = statistic
    told[2] = direction


def by_rule(kind: str, make: Callable[[], Any], script: Script, steps: int) -> Clause:
    """Return the clause for parts of a kind: one that follows its rule is put through the script beside another one."""

    def clause() -> None:
        declared = _declared(kind, make())
        for engine in ("in Python", "compiled"):
            feed, part = script(), make()
            other = _STAND_INS[kind](make(), _asking(kind, declared, compiled=engine == "compiled"))
            for i in range(steps):
                given, ruled = feed((part, other), i)
                if _text(given) != _text(ruled):
                    raise Broken(
                        f"at step {i} its methods give {given}, its rule {engine} {ruled}; {_WAY_OUT}"
                        + (_BITS if engine == "compiled" else "")
                    )
                for k, numbers in enumerate(zip(_declared(kind, part).state, other.rule().state, strict=True)):
                    if _text(numbers[0]) != _text(numbers[1]):
                        raise Broken(
                            f"after step {i} its methods have quiet.state[{k}] at {numbers[0]}, its rule {engine} at "
                            f"{numbers[1]}; {_WAY_OUT}"
                        )
            if plain_json(part.state()) != plain_json(other.state()):
                raise Broken(
                    f"driven by its rule {engine} it ends in another state than by its methods; quiet.state is the "
                    "very list that the methods work on, and holds all that they carry from pass to pass"
                )

    return "has a rule that does what its methods do, in Python and compiled", clause


_WAY_OUT = "let the methods call quiet.function on the list that is quiet.state, or do to it what the function does"
_BITS = ". Use math, not numpy, for functions of numbers, and floats where integers would overflow"


def _declared(kind: str, part: Any) -> QuietRule:
    if (found := quiet_of(part)) is None:
        inherited = getattr(part, "quiet", None)
        if inherited is not None and not isinstance(inherited, QuietRule):
            raise Broken(f"quiet is {inherited!r}; it is a mape.ports.QuietRule, or None")
        why = obstacle(kind, part)
        if inherited is not None and "quiet" not in vars(type(part)):
            why = f"{why} of its own (where that of its base holds for it, say quiet = Base.quiet)"
        raise Noted(f"{why}, so that its passes are made in Python")
    if type(found.state) is not list:
        raise Broken(f"quiet.state is a {type(found.state).__name__}; it is the list on which the methods work")
    if (fault := misshapen(found)) is not None:
        raise Broken(f"quiet.{fault}")
    for name, numbers in (("state", found.state), ("params", found.params)):
        if odd := [number for number in numbers if not isinstance(number, (int, float))]:
            raise Broken(f"quiet.{name} holds {odd[0]!r}; it holds numbers alone")
    return found


Ask = Callable[[QuietRule, Any], tuple[list[float], list[float]]]
"""Asks a rule: (rule, what its pass brings) -> the numbers of the part after it, and the answer."""


def _asking(kind: str, declared: QuietRule, *, compiled: bool) -> Ask:
    size = 3 if kind == "detector" else 1
    probe = Composed(probe_three if size == 3 else probe_one, {"rule": declared.function})
    length = len(declared.state)

    def arguments(found: QuietRule, given: Any) -> tuple[Any, ...]:
        if len(found.state) != length:
            raise Broken(
                f"quiet.state has {len(found.state)} numbers, and had {length}; their number is fixed. Let a window be "
                "a ring in a list of its full length"
            )
        return np.array(found.state, dtype=float), np.array(found.params, dtype=float), given, np.empty(size)

    def in_python(found: QuietRule, given: Any) -> tuple[list[float], list[float]]:
        arguments(found, given)
        after, told = list(found.state), [math.nan] * size
        plain(after, found.params, given, told)
        if odd := [number for number in (*after, *told) if not isinstance(number, (bool, int, float, np.bool_))]:
            raise Broken(f"its rule gives {odd[0]!r}; it gives numbers alone, and NaN for no statistic")
        return [float(number) for number in after], [float(number) for number in told]

    def in_machine_code(found: QuietRule, given: Any) -> tuple[list[float], list[float]]:
        passed = arguments(found, given)
        try:
            machine_code = specialise(dispatcher, passed, f"the rule of this {kind}")
        except ConfigError as error:
            raise Broken(f"{error} A rule makes no list, array or text; it keeps to numbers and math") from None
        machine_code(*passed)
        return passed[0].tolist(), passed[-1].tolist()

    if compiled:
        dispatcher = probe.compiled()
        return in_machine_code
    plain = np.errstate(all="ignore")(probe.python())
    return in_python


class _StandIn:
    """A part whose quiet passes are made by its rule, as in a compiled stretch, and the others by its methods."""

    def __init__(self, part: Any, ask: Ask) -> None:
        self.part = part
        self._ask = ask

    def rule(self) -> QuietRule:
        """Return the part's rule, over its numbers as they are now."""
        found = quiet_of(self.part)
        if found is None:
            raise Broken("it declares a rule at first, and later none; whether it has one is fixed")
        return found

    def answer(self, given: Any, is_quiet: Callable[[list[float]], bool]) -> list[float] | None:
        """Return the rule's answer, and let the part go on from its numbers; None where the pass is not quiet."""
        found = self.rule()
        after, told = self._ask(found, given)
        if not is_quiet(told):
            return None
        found.state[:] = after
        return told

    def state(self) -> Json:
        """Return the part's."""
        return self.part.state()

    def reset(self) -> None:
        """Reset the part."""
        self.part.reset()


class _Detector(_StandIn):
    statistic: float | None
    direction: Direction

    def update(self, x: float) -> bool:
        told = self.answer(x, lambda told: not told[0] and not math.isinf(told[1]))
        if told is None:
            alarm: bool = self.part.update(x)
            if not alarm:
                raise Broken(f"its rule alarms at {x}, or gives an infinite statistic, and update({x}) does not alarm")
            self.statistic, self.direction = self.part.statistic, self.part.direction
            return alarm
        if told[2] not in SIDES:
            raise Broken(f"its rule names the side {told[2]:g}; give a code of knowledge.rows.DIRECTIONS")
        self.statistic = None if math.isnan(told[1]) else told[1]
        self.direction = SIDES[int(told[2])]
        return False


class _Schedule(_StandIn):
    def __init__(self, part: Any, ask: Ask) -> None:
        super().__init__(part, ask)
        self._told: list[float] | None = None

    @property
    def epsilon(self) -> Any:
        return self.part.epsilon if self._told is None else self._told[0]

    def advance(self, episode_return: float) -> None:
        self._told = self.answer(episode_return, lambda told: True)

    def reset(self) -> None:
        super().reset()
        self._told = None


class _Planner(_StandIn):
    _plan: ChangePlan

    def start(self, loop: int) -> ChangePlan:
        self._plan = self.part.start(loop)
        return self._plan

    def plan(self, request: ChangeRequest, knowledge: Knowledge) -> ChangePlan:
        loop, number, drifts, added, removed, signals = request
        told = None
        if not drifts and not added and not removed:
            told = self.answer(_array(signals), lambda told: 0.0 <= told[0] <= 1.0)
        if told is None:
            self._plan = self.part.plan(request, knowledge)
        else:
            self._plan = ChangePlan(loop, number, told[0], self._plan.learning_rate, (), (), (), False, None)
        return self._plan


class _Analyzer(_StandIn):
    def analyze(self, symptom: Symptom) -> ChangeRequest:
        loop, number, signals, available, known, readings = symptom
        told = None
        if not any(reading.alarm for reading in readings) and set(available) == set(known):
            told = self.answer(_array(signals), lambda told: not told[0])
        if told is None:
            request: ChangeRequest = self.part.analyze(symptom)
            return request
        return ChangeRequest(loop, number, (), (), (), signals)


_STAND_INS: dict[str, type[_StandIn]] = {
    "detector": _Detector,
    "analyzer": _Analyzer,
    "schedule": _Schedule,
    "planner": _Planner,
}


def _array(signals: dict[str, float]) -> Any:
    return np.array([*signals.values()], dtype=float)


def _text(reading: Any) -> str:
    """Return a text that is the same for the same numbers, bit for bit, whatever their types."""
    if isinstance(reading, tuple):
        return f"({', '.join(map(_text, reading))})"
    number = isinstance(reading, (int, float)) and not isinstance(reading, bool)
    return repr(float(reading)) if number else repr(reading)
