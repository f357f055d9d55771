"""The contract of a learner."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mape.compose import Composed, specialise
from mape.execute.rules import Floats, Ints, greedy
from mape.ports import Learner
from mape.testing.clauses import (
    Broken,
    Finding,
    finite,
    judge,
)

# Bound by `mape.compose`.
value: Any = None
step_size: Any = None


def probe(
    q: Floats, rows: Ints, states: Ints, epsilon: float, td_errors: Floats, rates: Floats, values: Floats, sizes: Floats
) -> int:
    """Call a learner's rules on many inputs: a template, see `mape.compose`."""
    for i in range(len(states)):
        count, state = 1 + i % len(rows), int(states[i])
        # Every other time the greedy row is of all rows, as under a mask that limits exploration alone.
        best = greedy(q, rows, count if i % 2 else len(rows), state)
        values[i] = value(q, rows, count, state, best, epsilon)
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
        return Composed(probe, {"value": learner.value, "step_size": learner.step_size})

    def constants() -> None:
        learner = make()
        names = learner.rate_names
        if not isinstance(names, tuple) or not all(isinstance(name, str) for name in names) or not names:
            raise Broken(f"rate_names is {names!r}; give a tuple of the names of the learning-rate parameters")
        if not finite(learner.discount) or not 0.0 <= learner.discount <= 1.0:
            raise Broken(f"discount is {learner.discount!r}; it is a number in [0, 1]")
        if not isinstance(learner.bootstrap_terminal, bool):
            raise Broken(f"bootstrap_terminal is {learner.bootstrap_terminal!r}; it is True or False")

    def pure() -> None:
        learner = make()
        given, again = inputs(learner), inputs(learner)
        rule = np.errstate(all="ignore")(bound(learner).python())
        rule(*given)
        for name, before, after in zip(("q", "rows", "states"), again, given, strict=False):
            if not np.array_equal(before, after):
                raise Broken(f"a rule wrote into {name}; rules only read what they are given")
        if not np.array_equal(again[5], given[5]):
            raise Broken("step_size wrote into rate; rules only read what they are given")
        for name, results in (("value", given[6]), ("step_size", given[7])):
            if not np.isfinite(results).all():
                at = int(np.flatnonzero(~np.isfinite(results))[0])
                raise Broken(f"{name} gave {results[at]} for TD error {given[4][at]}, rate {given[5][at]}; stay finite")
        rule(*again)
        if not (np.array_equal(given[6], again[6]) and np.array_equal(given[7], again[7])):
            raise Broken("the same numbers gave two results; rules keep nothing and draw nothing")

    def says_what_it_looks_at() -> None:
        learner = make()
        on_policy = getattr(learner, "on_policy", True)
        if type(on_policy) is not bool:
            raise Broken(f"on_policy is {on_policy!r}; it is True or False, or left out, which stands for True")
        if on_policy:
            return
        q, rows, states, epsilon, *_ = inputs(learner)
        plain = np.errstate(all="ignore")(learner.value)
        for state in states.tolist():
            best = greedy(q, rows, len(rows), state)
            given = {plain(q, rows[first:], len(rows) - first, state, best, epsilon) for first in range(len(rows))}
            if len(given) > 1:
                raise Broken(
                    f"on_policy is False, and value gives {sorted(given)} for one state and greedy row over other "
                    "rows: it looks at them. Say on_policy = True, which makes them those that exploration chooses from"
                )

    def within_its_rows() -> None:
        learner = make()
        rule = np.errstate(all="ignore")(bound(learner).python())
        given = inputs(learner)
        rule(*given)
        rows = given[1]
        for count in range(1, len(rows) + 1):
            other = inputs(learner)
            others = [row for row in range(len(other[0])) if row not in rows[:count]]
            other[0][others] += 1e3
            rule(*other)
            turns = np.arange(len(given[6]))
            asked = (turns % len(rows) + 1 == count) & (turns % 2 == 1)  # else the greedy row may be one of the others
            if (differ := np.flatnonzero(asked & (given[6] != other[6]))).size:
                i = int(differ[0])
                raise Broken(
                    f"value gives {given[6][i]}, and {other[6][i]} where actions that are not offered are worth more; "
                    f"of q it reads the rows rows[:count], here {rows[:count].tolist()}"
                )

    def same_bits() -> None:
        learner = make()
        plain, compiled = inputs(learner), inputs(learner)
        np.errstate(all="ignore")(bound(learner).python())(*plain)
        specialise(bound(learner).compiled(), compiled, "the rules of this learner")(*compiled)
        for name, at in (("value", 6), ("step_size", 7)):
            if (differ := np.flatnonzero(plain[at] != compiled[at])).size:
                i = int(differ[0])
                raise Broken(
                    f"{name} gives {plain[at][i]} in Python and {compiled[at][i]} compiled; use math, not numpy, "
                    "for functions of numbers, floats where integers would overflow, and no order that may change"
                )

    return judge(
        make,
        "rate_names discount bootstrap_terminal value() step_size()",
        [
            ("names its learning-rate parameters, a discount and bootstrap_terminal", constants),
            ("has pure rules with finite results", pure),
            ("says whether its value looks at what exploration chooses from", says_what_it_looks_at),
            ("reads the rows of the actions on offer alone", within_its_rows),
            ("gives the same bits compiled as in plain Python", same_bits),
        ],
    )
