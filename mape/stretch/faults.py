"""What is wrong with a rule that a part declares, and whose it is."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np

from mape import states
from mape.compose import Composed, Uncompilable, specialise
from mape.errors import PartError
from mape.ports import QuietRule
from mape.stretch.quiet import by_schedule

FIRST_DETECTOR = 2
"""Place of the first detector among the parts that declare rules; before it stand the planner and the analyzer."""


def check_shape(k: int, part: Any, rule: QuietRule) -> None:
    """Look at what a rule consists of; at its numbers `floats` looks.

    Raises
    ------
    PartError
        Its function, state or params are of another kind than `mape.ports.QuietRule` says.
    """
    if (fault := misshapen(rule)) is not None:
        raise _refused(k, part, rule, fault)


def misshapen(rule: QuietRule) -> str | None:
    """Say which of a rule's fields is of another kind than `mape.ports.QuietRule` says; None where none is."""
    function, state, params = rule
    if not isinstance(function, Composed) and not callable(function):
        return f"function is {function!r}; it is a module-level function"
    if not isinstance(state, (list, np.ndarray)):
        return f"state is {state!r}; it is the list of numbers on which the methods work"
    if not isinstance(params, (tuple, list, np.ndarray)):
        return f"params is {params!r}; it is a tuple of numbers"
    return None


def floats(parts: Sequence[Any], rules: Sequence[QuietRule]) -> tuple[array[float], array[float]]:
    """Return the state of all parts, one after the other, and their params.

    Raises
    ------
    PartError
        Something among them is no number, or too large for a float.
    """
    try:
        # Not by NumPy, which reads numbers out of texts.
        return (
            array("d", [number for rule in rules for number in rule.state]),
            array("d", [number for rule in rules for number in rule.params]),
        )
    except (TypeError, ValueError, OverflowError):
        for k, (part, rule) in enumerate(zip(parts, rules, strict=True)):
            for name, numbers in (("state", rule.state), ("params", rule.params)):
                for number in numbers:
                    if (fault := _no_float(number)) is not None:
                        raise _refused(k, part, rule, f"{name} holds {fault}") from None
        raise


def check_reach(parts: Sequence[Any], rules: Sequence[QuietRule], n_signals: int) -> None:
    """Call each rule in plain Python, once in a process: compiled code looks at no bounds, and writes beyond them.

    What a rule does only for other signals, or from other numbers, is left to `mapek check`; so is a negative index.

    Raises
    ------
    PartError
        A rule reaches beyond its state or its params, whatever it is told.
    """
    for k, (part, rule) in enumerate(zip(parts, rules, strict=True)):
        form = (rule.function, len(rule.state), len(rule.params))
        if form in _called:
            continue
        bound = rule.function if isinstance(rule.function, Composed) else Composed(rule.function, {})
        if not bound.compiled_by_others:
            plain = bound.python() if bound is rule.function else rule.function
            told = (0.0, 1.0) if k >= FIRST_DETECTOR else ([0.0] * n_signals, [1.0] * n_signals)
            if all(_reaches_beyond(plain, rule, each) for each in told):
                raise _refused(
                    k,
                    part,
                    rule,
                    f"function reaches beyond its numbers: it has {len(rule.state)} in state and {len(rule.params)} in "
                    "params",
                )
        _called.add(form)


_called: set[tuple[Any, int, int]] = set()


def _reaches_beyond(plain: Any, rule: QuietRule, told: Any) -> bool:
    try:
        with np.errstate(all="ignore"):
            plain([float(number) for number in rule.state], tuple(float(number) for number in rule.params), told)
    except IndexError:
        return True
    except states.faults():
        return False  # the user's rule, on signals that are not the run's: what it raises on its own, the run tells
    return False


def named(error: Uncompilable, parts: Sequence[Any], rules: Sequence[QuietRule], n_signals: int) -> Uncompilable:
    """Say whose rule it is that cannot be compiled: each is tried alone. If none fails alone, return `error`."""
    from mape.testing.quiet import probe_one, probe_three  # what it needs is not needed by a run

    for k, (part, rule) in enumerate(zip(parts, rules, strict=True)):
        whose, function = _whose(k, part, rule)
        of_detector = k >= FIRST_DETECTOR
        alone = Composed(probe_three if of_detector else probe_one, {"rule": rule.function})
        given: Any = 0.0 if of_detector else np.zeros(n_signals)
        numbers = (np.zeros(len(rule.state)), np.zeros(len(rule.params)))
        try:
            specialise(
                alone.compiled(),
                (*numbers, given, np.zeros(3 if of_detector else 1)),
                f"rule {getattr(function, '__name__', function)}",
            )
        except Uncompilable as reason:
            return Uncompilable(f"{whose}: {reason} See its contract in mape.ports.QuietRule.")
    return error


def _whose(k: int, part: Any, rule: QuietRule) -> tuple[str, Any]:
    """Return who declares rule number `k`, and its function; a planner's may be that of its schedule."""
    function = rule.function
    if isinstance(function, Composed):
        if function.template is by_schedule:
            schedule = getattr(part, "schedule", part)
            return f"schedule {type(schedule).__name__}", function.bindings["schedule_rule"]
        function = function.template
    kind = f"detector monitor.{k - FIRST_DETECTOR}" if k >= FIRST_DETECTOR else ("planner", "analyzer")[k]
    return f"{kind} {type(part).__name__}", function


def _refused(k: int, part: Any, rule: QuietRule, fault: str) -> PartError:
    whose, _ = _whose(k, part, rule)
    return PartError(
        f"{whose} declares a rule (quiet) whose {fault}. Mend it, and run `mapek check` on it; or choose the engine "
        "'python', which asks for none."
    )


def _no_float(number: Any) -> str | None:
    """Say why compiled code cannot take `number` for a float; None where it can."""
    try:
        array("d", [number])
    except OverflowError:
        return "a number that is too large for a float"
    except (TypeError, ValueError):
        return f"{number!r}; it holds numbers alone, and NaN for none"
    return None
