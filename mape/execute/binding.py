"""Binds the episode to a system and a learner: compiled from the system's rules, or through its calls."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mape.compose import Composed, specialise
from mape.execute import drive, episode
from mape.ports import Learner, StepRules

Driver = Callable[..., tuple[int, int, float, float, float]]
"""`episode.episode` with its free names bound."""


def by_rules(rules: StepRules, learner: Learner, arguments: tuple[Any, ...]) -> Driver:
    """Return the episode as one compiled call, for the types of `arguments`."""
    begin = Composed(drive.begin_by_rules, {"phase_rule": rules.phase, "reset_rule": rules.reset})
    act = Composed(drive.act_by_rules, {"step_rule": rules.step})
    bound: dict[str, Any] = {"begin": begin, "act": act, "explorable": rules.explorable}
    return specialise(Composed(episode.episode, bound | _of(learner)).compiled(), arguments)


def by_calls(learner: Learner) -> Driver:
    """Return the episode as plain Python that calls the system's `step`."""
    bound = {
        "begin": drive.begin_by_calls,
        "act": drive.act_by_calls,
        "explorable": drive.explorable_by_calls,
    }
    plain = Composed(episode.episode, bound | _of(learner)).python()

    def quiet(*arguments: Any) -> Any:
        # What overflows is refused by the episode itself, with the number in the message.
        with np.errstate(all="ignore"):
            return plain(*arguments)

    return quiet


def _of(learner: Learner) -> dict[str, Any]:
    return {"value": learner.value, "step_size": learner.step_size}
