"""MORPHIN's planner (arXiv 2601.20714, Algorithm 1).

On a drift, and in the same way on a new action, exploration starts anew; new actions get a row of zeros in the
Q-table, whose other rows are kept. The learning rate is driven by the TD error, through the learner's

    alpha* = alpha + (alpha_max - alpha) / (1 + exp(-(|TD error| - k)))

of which the plan carries the three parameters. With alpha_max = alpha the learning rate is fixed.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from knowledge import ChangePlan, ChangeRequest, Knowledge
from mape.ports import QuietRule, Schedule
from mape.specs import PartConfig
from mape.states import joint_format
from mape.stretch.quiet import quiet_by

_new = tuple.__new__


class MorphinConfig(PartConfig):
    """Options of `Morphin`."""

    alpha: float = Field(0.1, gt=0, le=1, description="learning rate at a TD error far below k")
    alpha_max: float = Field(0.99, gt=0, le=1, description="learning rate at a TD error far above k")
    k: float = Field(
        5.0, ge=0, le=700, description="absolute TD error at which the rate is half-way, in units of reward"
    )
    respond_to: tuple[Literal["drift", "added", "removed"], ...] = ("drift", "added")
    enable_on_drift: tuple[int, ...] = ()

    @model_validator(mode="after")
    def _in_order(self) -> MorphinConfig:
        if self.alpha_max < self.alpha:
            raise ValueError(f"alpha_max = {self.alpha_max} is below alpha = {self.alpha}; equal values fix the rate")
        if len(set(self.enable_on_drift)) != len(self.enable_on_drift) or min(self.enable_on_drift, default=0) < 0:
            raise ValueError(f"enable_on_drift = {list(self.enable_on_drift)} must be distinct action ids, from 0")
        return self


class Morphin:
    """Resets exploration on drifts and new actions, enables reserve actions on the first drift.

    Parameters
    ----------
    config
        Options. `respond_to` names the changes that reset exploration; an empty tuple gives plain Q-learning, whose
        action set still follows the system's.
    schedule
        Exploration over the episodes since the last response.
    """

    Config = MorphinConfig

    def __init__(self, config: MorphinConfig, schedule: Schedule) -> None:
        self.config = config
        self.schedule = schedule
        self._rate = (config.alpha, config.alpha_max, config.k)
        self._to_enable = config.enable_on_drift
        self._drift = "drift" in config.respond_to
        self._added = "added" in config.respond_to
        self._removed = "removed" in config.respond_to

    @property
    def state_format(self) -> str | None:
        """Name of what `state` gives, which holds the schedule's."""
        return joint_format("morphin/1", self.schedule)

    @property
    def quiet(self) -> QuietRule | None:
        """Nothing changed: the schedule goes on."""
        return quiet_by(self.schedule)

    def start(self, loop: int) -> ChangePlan:
        """Return plan 0."""
        return ChangePlan(loop, 0, self.schedule.epsilon, self._rate, (), (), (), False, None)

    def plan(self, request: ChangeRequest, knowledge: Knowledge) -> ChangePlan:
        """Return the plan of the next episode."""
        loop, number, drifts, add, drop, signals = request
        enable: tuple[int, ...] = ()
        reset = False
        if drifts or add or drop:
            if drifts and self._to_enable:
                enable, self._to_enable = self._to_enable, ()
                add += tuple(a for a in enable if a not in add)
            # A new action changes what returns are possible: the test's past is no longer the null hypothesis.
            reset = bool((request.added and self._added) or (drop and self._removed))
            if reset or (drifts and self._drift):
                self.schedule.reset()
            else:
                self.schedule.advance(signals["return"])
        else:
            self.schedule.advance(signals["return"])
        return _new(ChangePlan, (loop, number, self.schedule.epsilon, self._rate, add, drop, enable, reset, None))

    def state(self) -> Any:
        """Return the schedule's state and the actions that are still to be enabled."""
        return {"schedule": self.schedule.state(), "to_enable": list(self._to_enable)}

    def restore(self, state: Any) -> None:
        """Take up where `state` was given."""
        self.schedule.restore(state["schedule"])
        self._to_enable = tuple(state["to_enable"])
