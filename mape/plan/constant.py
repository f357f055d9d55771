"""Constant exploration."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from mape.ports import QuietRule
from mape.specs import PartConfig


class ConstantConfig(PartConfig):
    """Options of `Constant`."""

    epsilon: float = Field(0.1, ge=0, le=1, description="exploration rate of every episode")


def constant(state: list[float], params: tuple[float, ...], episode_return: float) -> float:
    """Return the exploration rate, params = (epsilon,)."""
    return params[0]


class Constant:
    """The same exploration rate for ever."""

    Config = ConstantConfig
    state_format = "none/1"

    def __init__(self, config: ConstantConfig) -> None:
        self.config = config
        self.epsilon = config.epsilon

    @property
    def quiet(self) -> QuietRule:
        """The rule of `advance`, which returns the rate."""
        return QuietRule(constant, [], (self.config.epsilon,))

    def advance(self, episode_return: float) -> None:
        """Do nothing."""

    def reset(self) -> None:
        """Do nothing."""

    def state(self) -> None:
        """Return None: there is no state."""

    def restore(self, state: Any) -> None:
        """Do nothing: there is no state."""
