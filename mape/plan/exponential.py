"""Exponential exploration schedule (arXiv 2601.20714, Eq. for epsilon).

    epsilon(e) = eps_min + (1 - eps_min) * exp(-decay * e)

`e` counts the episodes since the last response.
"""

from __future__ import annotations

import math
from typing import Any

from pydantic import Field

from mape.ports import QuietRule
from mape.specs import PartConfig


class ExponentialConfig(PartConfig):
    """Options of `Exponential`."""

    eps_min: float = Field(0.1, ge=0, le=1, description="exploration rate that is approached")
    decay: float = Field(0.05, ge=0, description="decay per episode")


def exponential(counter: float, eps_min: float, decay: float) -> float:
    """Return the exploration rate, `counter` episodes after the last response.

    >>> [round(exponential(e, 0.1, 0.05), 6) for e in (0, 1, 10, 15, 60, 100)]
    [1.0, 0.956106, 0.645878, 0.52513, 0.144808, 0.106064]
    """
    return eps_min + (1.0 - eps_min) * math.exp(-decay * counter)


def exponential_next(state: list[float], params: tuple[float, ...], episode_return: float) -> float:
    """Count one episode on state = (counter,), and return the exploration rate; params = (eps_min, decay)."""
    state[0] += 1.0
    return exponential(state[0], params[0], params[1])


class Exponential:
    """Exponential schedule over a counter of episodes."""

    Config: type[ExponentialConfig] = ExponentialConfig
    state_format = "counter/1"

    def __init__(self, config: ExponentialConfig) -> None:
        self.config = config
        self._state = [0.0]
        self._params: tuple[float, ...] = (config.eps_min, config.decay)

    @property
    def quiet(self) -> QuietRule:
        """The rule of `advance`, over this one's numbers."""
        return QuietRule(exponential_next, self._state, self._params)

    @property
    def epsilon(self) -> float:
        """Exploration rate of the next episode."""
        return exponential(self._state[0], self.config.eps_min, self.config.decay)

    def advance(self, episode_return: float) -> None:
        """Count one episode without a response."""
        exponential_next(self._state, self._params, episode_return)

    def reset(self) -> None:
        """Explore anew."""
        self._state[0] = 0.0

    def state(self) -> Any:
        """Return the counter."""
        return {"counter": self._state[0]}

    def restore(self, state: Any) -> None:
        """Take up where `state` was given."""
        self._state[0] = float(state["counter"])
