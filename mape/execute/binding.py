"""Binds the episode to a system and a learner: compiled from the system's rules, or through its calls."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from mape.compose import Bindings, Composed, Rule, Uncompilable, specialise
from mape.execute import drive, episode
from mape.ports import Learner, StepRules

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
    return _composed(rules.phase, rules.reset, rules.step, rules.explorable, learner.value, learner.step_size)


@functools.cache
def _compiled(bound: Composed) -> Any:
    # Once per process: reading the sources for their hash costs as much as hundreds of episodes.
    return bound.compiled()


@functools.cache
def _composed(phase: Rule, reset: Rule, step: Rule, explorable: Rule, value: Rule, step_size: Rule) -> Composed:
    begin = Composed(drive.begin_by_rules, {"phase_rule": phase, "reset_rule": reset})
    act = Composed(drive.act_by_rules, {"step_rule": step})
    bound: Bindings = {
        "begin": begin,
        "act": act,
        "explorable": explorable,
        "value": value,
        "step_size": step_size,
    }
    return Composed(episode.episode, bound, apart=True)


def by_calls(learner: Learner) -> Driver:
    """Return the episode as plain Python that calls the system's `step`."""
    bound: Bindings = {
        "begin": drive.begin_by_calls,
        "act": drive.act_by_calls,
        "explorable": drive.explorable_by_calls,
        "value": learner.value,
        "step_size": learner.step_size,
    }
    plain = Composed(episode.episode, bound).python()

    def quiet(*arguments: Any) -> Any:
        # What overflows is refused by the episode itself, with the number in the message.
        with np.errstate(all="ignore"):
            return plain(*arguments)

    return quiet
