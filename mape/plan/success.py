"""Success rule on the exponential schedule: explore fully until the goal is found once, then stop at once.

Once there has been a response (to a drift or, in the same way, to a new action), at the end of every later episode

    e <- (e + 1) * 15    if the return is positive
    e <- (e + 1) * 0.6   otherwise

and e <- 0 on a response. Algorithm 1 of arXiv 2601.20714 does not print it; the authors' published code has it, and
Table 1 needs it. It fits systems whose return is positive exactly when the goal was reached.
"""

from __future__ import annotations

from typing import Any

from pydantic import Field

from mape.plan.exponential import Exponential, ExponentialConfig, exponential
from mape.ports import QuietRule


class SuccessConfig(ExponentialConfig):
    """Options of `Success`."""

    on_success: float = Field(15.0, gt=0, description="factor of the counter after a positive return")
    on_failure: float = Field(0.6, ge=0, description="factor of the counter after any other return")


COUNTER_CAP = 1e6
"""The counter stops here, where the exponential is 0 for every decay that matters; it would overflow otherwise."""


def success_counter(
    counter: float, episode_return: float, responded: bool, on_success: float, on_failure: float
) -> float:
    """Return the counter after an episode without a response; before the first response it just counts."""
    if not responded:
        return counter + 1.0
    factor = on_success if episode_return > 0.0 else on_failure
    return min((counter + 1.0) * factor, COUNTER_CAP)


def success_next(state: list[float], params: tuple[float, ...], episode_return: float) -> float:
    """Take the step on state = (counter, 1 after a response), and return the exploration rate.

    params = (eps_min, decay, on_success, on_failure)
    """
    state[0] = success_counter(state[0], episode_return, state[1] > 0.0, params[2], params[3])
    return exponential(state[0], params[0], params[1])


class Success(Exponential):
    """Exponential schedule whose counter follows the success rule after the first response."""

    Config = SuccessConfig
    state_format = "success/1"

    def __init__(self, config: SuccessConfig) -> None:
        super().__init__(config)
        self._state = [0.0, 0.0]
        self._params = (*self._params, config.on_success, config.on_failure)

    @property
    def quiet(self) -> QuietRule:
        """The rule of `advance`, over this one's numbers."""
        return QuietRule(success_next, self._state, self._params)

    def advance(self, episode_return: float) -> None:
        """Count one episode without a response, by the success rule."""
        success_next(self._state, self._params, episode_return)

    def reset(self) -> None:
        """Explore anew; from the first response on the success rule holds."""
        super().reset()
        self._state[1] = 1.0

    def state(self) -> Any:
        """Return the counter and whether there has been a response."""
        return {"counter": self._state[0], "responded": self._state[1] > 0.0}

    def restore(self, state: Any) -> None:
        """Take up where `state` was given."""
        super().restore(state)
        self._state[1] = float(bool(state["responded"]))
