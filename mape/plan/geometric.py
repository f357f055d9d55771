"""Geometric exploration schedule: epsilon <- max(eps_min, factor * epsilon) after each episode, 1 after a response."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from mape.ports import QuietRule
from mape.specs import PartConfig


class GeometricConfig(PartConfig):
    """Options of `Geometric`."""

    eps_min: float = Field(0.01, ge=0, le=1, description="exploration rate that is never gone below")
    factor: float = Field(0.999, gt=0, le=1, description="factor per episode")


def geometric(epsilon: float, eps_min: float, factor: float) -> float:
    """Return the exploration rate of the next episode.

    >>> geometric(1.0, 0.01, 0.999)
    0.999
    """
    return max(eps_min, factor * epsilon)


def geometric_next(state: list[float], params: tuple[float, ...], episode_return: float) -> float:
    """Take the step on state = (epsilon,), and return it; params = (eps_min, factor)."""
    state[0] = geometric(state[0], params[0], params[1])
    return state[0]


class Geometric:
    """Geometric schedule."""

    Config = GeometricConfig
    state_format = "epsilon/1"

    def __init__(self, config: GeometricConfig) -> None:
        self.config = config
        self._state = [1.0]
        self._params = (config.eps_min, config.factor)

    @property
    def quiet(self) -> QuietRule:
        """The rule of `advance`, over this one's numbers."""
        return QuietRule(geometric_next, self._state, self._params)

    @property
    def epsilon(self) -> float:
        """Exploration rate of the next episode."""
        return self._state[0]

    def advance(self, episode_return: float) -> None:
        """Count one episode without a response."""
        geometric_next(self._state, self._params, episode_return)

    def reset(self) -> None:
        """Explore anew."""
        self._state[0] = 1.0

    def state(self) -> Any:
        """Return the exploration rate."""
        return {"epsilon": self._state[0]}

    def restore(self, state: Any) -> None:
        """Take up where `state` was given."""
        self._state[0] = float(state["epsilon"])
