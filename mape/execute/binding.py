"""Binds the episode to a system and a learner: compiled from the system's rules, or through its calls."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from mape.compose import Bindings, Composed, Rule, Uncompilable, specialise
from mape.errors import PartError
from mape.execute import drive, episode
from mape.execute import rules as own
from mape.ports import Learner, StepRules
from mape.states import faults, told
from mape.values import number, shown

Driver = Callable[..., tuple[int, int, float, float, float]]
"""`episode.episode` with its free names bound."""


def by_rules(rules: StepRules, learner: Learner, arguments: tuple[Any, ...]) -> Driver:
    """Return the episode as one compiled call, for the types of `arguments`.

    Raises
    ------
    Uncompilable
        A rule cannot be compiled; it is said whose.
    """
    try:
        return specialise(_compiled(composed(rules, learner)), arguments, "the episode of this system and learner")
    except Uncompilable as error:
        raise _named(error, learner) from error


def _named(error: Uncompilable, learner: Learner) -> Uncompilable:
    """Say whether it is the learner's rules that cannot be compiled, which are tried alone, or the system's."""
    from mape.testing.learners import probe  # what it needs is not needed by a run

    numbers, rows, rate = np.zeros(1), np.zeros(1, dtype=np.int64), np.zeros((1, len(learner.rate_names)))
    arguments = (np.zeros((2, 2)), rows, rows, 0.5, numbers, rate, numbers, numbers)
    alone = Composed(probe, {"value": learner.value, "step_size": learner.step_size})
    try:
        specialise(alone.compiled(), arguments, "the rules of this learner")
    except Uncompilable as told:
        return Uncompilable(f"learner {type(learner).__name__}: {told}")
    return Uncompilable(f"the system's rules: {error}")


def composed(rules: StepRules, learner: Learner) -> Composed:
    """Return the episode with its names bound to the rules of a system and a learner; equal ones are one object."""
    legal = getattr(rules, "legal", None)
    return _composed(rules.phase, rules.reset, rules.step, legal, rules.explorable, learner.value, learner.step_size)


@functools.cache
def _compiled(bound: Composed) -> Any:
    # Once per process: reading the sources for their hash costs as much as hundreds of episodes.
    return bound.compiled()


@functools.cache
def _composed(
    phase: Rule, reset: Rule, step: Rule, legal: Rule | None, explorable: Rule, value: Rule, step_size: Rule
) -> Composed:
    begin = Composed(drive.begin_by_rules, {"phase_rule": phase, "reset_rule": reset})
    act = Composed(drive.act_by_rules, {"step_rule": step})
    narrow: Any = drive.all_are_legal
    if legal is not None:
        narrow = Composed(drive.narrow_by_rules, {"legal_rule": legal})
    bound: Bindings = {
        "begin": begin,
        "narrow": narrow,
        "act": act,
        "credit": drive.credit_as_chosen,
        "explorable": explorable,
        "value": value,
        "step_size": step_size,
    }
    return Composed(episode.episode, bound, apart=True)


def _told_apart(learner: Learner, name: str) -> Rule:
    """Return a learner's rule so that what it raises, or gives in the place of a number, is told as the learner's."""
    rule: Any = getattr(learner, name)
    if rule.__module__ == own.__name__:
        return rule  # type: ignore[no-any-return]

    def looked_at(*arguments: Any) -> Any:
        try:
            given = rule(*arguments)
        except faults() as error:
            raise PartError(f"{name} of learner {type(learner).__name__} raised {told(error)}") from error
        if isinstance(given, float):
            return given
        if (as_float := number(given)) is None:
            raise PartError(f"{name} of learner {type(learner).__name__} gave {shown(given)}; it gives one real number")
        return as_float

    return looked_at


def by_calls(learner: Learner) -> Driver:
    """Return the episode as plain Python that calls the system's `step`."""
    bound: Bindings = {
        "begin": drive.begin_by_calls,
        "narrow": drive.narrow_by_calls,
        "act": drive.act_by_calls,
        "credit": drive.credit_by_calls,
        "explorable": drive.explorable_by_calls,
    }
    return _plain(bound, learner)


def by_rules_in_python(rules: StepRules, learner: Learner) -> Driver:
    """Return the episode of `by_rules` as plain Python, in which whose rule raised can be told."""
    return _plain(composed(rules, learner).bindings, learner)


def _plain(bound: Bindings, learner: Learner) -> Driver:
    told_apart = {name: _told_apart(learner, name) for name in ("value", "step_size")}
    plain = Composed(episode.episode, {**bound, **told_apart}).python()

    def quiet(*arguments: Any) -> Any:
        # What overflows is refused by the episode itself, with the number in the message.
        with np.errstate(all="ignore"):
            return plain(*arguments)

    return quiet
