"""Geometric exploration schedule: epsilon <- max(eps_min, factor * epsilon) after each episode, 1 after a response."""

from __future__ import annotations

from typing import Any

from pydantic import Field

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


class Geometric:
    """Geometric schedule."""

    Config = GeometricConfig
    state_format = "epsilon/1"

    def __init__(self, config: GeometricConfig) -> None:
        self.config = config
        self._eps_min = config.eps_min
        self._factor = config.factor
        self._epsilon = 1.0

    @property
    def epsilon(self) -> float:
        """Exploration rate of the next episode."""
        return self._epsilon

    def advance(self, episode_return: float) -> None:
        """Count one episode without a response."""
        self._epsilon = geometric(self._epsilon, self._eps_min, self._factor)

    def reset(self) -> None:
        """Explore anew."""
        self._epsilon = 1.0

    def state(self) -> Any:
        """Return the exploration rate."""
        return {"epsilon": self._epsilon}

    def restore(self, state: Any) -> None:
        """Take up where `state` was given."""
        self._epsilon = float(state["epsilon"])
