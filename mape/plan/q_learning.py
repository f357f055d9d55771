"""Plain Q-learning as a planner: a fixed learning rate, no response to any change.

The action set still follows the system's: an action that appears gets a row, one that vanishes loses it.
"""

from __future__ import annotations

from typing import Any

from pydantic import Field

from knowledge import ChangePlan, ChangeRequest, Knowledge
from mape.ports import QuietRule, Schedule
from mape.specs import PartConfig
from mape.states import joint_format
from mape.stretch.quiet import quiet_by


class QLearningPlannerConfig(PartConfig):
    """Options of `QLearningPlanner`."""

    alpha: float = Field(0.1, gt=0, le=1, description="learning rate")


class QLearningPlanner:
    """The baseline: follows its schedule and learns at a fixed rate, whatever happens."""

    Config = QLearningPlannerConfig

    def __init__(self, config: QLearningPlannerConfig, schedule: Schedule) -> None:
        self.config = config
        self.schedule = schedule
        # alpha_max = alpha makes the TD-error-driven step size exactly alpha.
        self._rate = (config.alpha, config.alpha, 0.0)

    @property
    def state_format(self) -> str | None:
        """Name of what `state` gives, which holds the schedule's."""
        return joint_format("q_learning/1", self.schedule)

    @property
    def quiet(self) -> QuietRule | None:
        """Nothing changed: the schedule goes on."""
        return quiet_by(self.schedule)

    def start(self, loop: int) -> ChangePlan:
        """Return plan 0."""
        return ChangePlan(loop, 0, self.schedule.epsilon, self._rate, (), (), (), False, None)

    def plan(self, request: ChangeRequest, knowledge: Knowledge) -> ChangePlan:
        """Return the plan of the next episode."""
        loop, number, _, add, drop, signals = request
        self.schedule.advance(signals["return"])
        return tuple.__new__(ChangePlan, (loop, number, self.schedule.epsilon, self._rate, add, drop, (), False, None))

    def state(self) -> Any:
        """Return the schedule's state."""
        return {"schedule": self.schedule.state()}

    def restore(self, state: Any) -> None:
        """Take up where `state` was given."""
        self.schedule.restore(state["schedule"])
