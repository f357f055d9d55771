"""The rules of learning: pure functions of numbers, in plain Python that Numba can compile.

`q` is a Q-table's values, shape (rows, states); ``rows[:count]`` are rows of it, in its order: those among which a rule
chooses, or, for a learner's `value`, those among which exploration does.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from mape.specs import PartConfig

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


def greedy(q: Floats, rows: Ints, count: int, state: int) -> int:
    """Return the row of the largest value of `state`; of equal ones, the first."""
    best: int = rows[0]
    most: float = q[best, state]
    for i in range(1, count):
        worth = q[rows[i], state]
        if worth > most:
            best = rows[i]
            most = worth
    return best


def max_value(q: Floats, rows: Ints, count: int, state: int, best: int, epsilon: float) -> float:
    """Return the largest value of `state`, that of its row `best`: Q-learning bootstraps from it (Watkins 1989)."""
    value: float = q[best, state]
    return value


def expected_value(q: Floats, rows: Ints, count: int, state: int, best: int, epsilon: float) -> float:
    """Return the mean value of `state` under the epsilon-greedy policy: Expected Sarsa (van Seijen et al. 2009).

    With probability 1 - epsilon that policy takes `best`, and else one of ``rows[:count]``, among which `best` need not
    be: a mask may bar from exploration what the greedy choice is free to take.
    """
    total = 0.0
    for i in range(count):
        total += q[rows[i], state]
    return (1.0 - epsilon) * max_value(q, rows, count, state, best, epsilon) + epsilon * total / count


def alpha_star(td_error: float, rate: Floats) -> float:
    """Return MORPHIN's learning rate, from rate = (alpha, alpha_max, k) (arXiv 2601.20714).

    alpha* = alpha + (alpha_max - alpha) / (1 + exp(-(|TD error| - k)))

    >>> round(alpha_star(-1.0, (0.1, 0.99, 5.0)), 12)
    0.116007726866
    """
    alpha: float = rate[0]
    if rate[1] != alpha:  # else the same would come out; the exponential takes a third of a step
        alpha += (rate[1] - rate[0]) / (1.0 + math.exp(-(abs(td_error) - rate[2])))
    return alpha


class LearnerConfig(PartConfig):
    """Options of a learner."""

    discount: float = Field(0.9, ge=0, le=1, description="gamma")
    bootstrap_terminal: bool = Field(
        False, description="bootstrap from a terminal state too, as the published code of MORPHIN does"
    )


class QLearning:
    """Q-learning: TD error = r + gamma * max_a Q(s', a) - Q(s, a); Q(s, a) += alpha* * TD error."""

    Config = LearnerConfig
    rate_names = ("alpha", "alpha_max", "k")
    value = staticmethod(max_value)
    step_size = staticmethod(alpha_star)

    def __init__(self, config: LearnerConfig) -> None:
        self.config = config
        self.discount = config.discount
        self.bootstrap_terminal = config.bootstrap_terminal

    @property
    def on_policy(self) -> bool:
        """Whether `value` may look at the rows that exploration chooses from, as all but the maximum may."""
        return self.value is not max_value


class ExpectedSarsa(QLearning):
    """Expected Sarsa: as Q-learning, but bootstraps from the epsilon-greedy policy's mean value."""

    value = staticmethod(expected_value)


def rate_array(rate: tuple[float, ...]) -> Any:
    """Return a plan's learning rate as the array that the compiled episode takes."""
    return np.array(rate, dtype=np.float64)
