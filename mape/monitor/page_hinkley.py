"""Page-Hinkley test for a fall of the mean.

    n    <- n + 1
    mean <- mean + (x - mean) / n
    c    <- c + mean - x - delta
    m    <- min(m, c)                      (m starts at 0)
    alarm iff c - m > threshold

One-sided: it sees falls only. Equal, alarm for alarm, to River's ``PageHinkley(mode="down", alpha=1.0,
min_instances=1)``. Source: E. S. Page, Continuous inspection schemes, Biometrika 41 (1954); used on the episode return
by MORPHIN (arXiv 2601.20714).
"""

from __future__ import annotations

import math
from typing import Any

from pydantic import Field

from knowledge.records import Direction
from knowledge.rows import DOWN
from mape.ports import QuietRule
from mape.specs import PartConfig

_NUMBERS = ("n", "mean", "total", "minimum")


class PageHinkleyConfig(PartConfig):
    """Options of `PageHinkley`."""

    delta: float = Field(0.5, ge=0, description="fall of the mean that is tolerated, in units of the signal")
    threshold: float = Field(300.0, gt=0, description="alarm above this statistic (H)")


def page_hinkley(
    x: float, n: float, mean: float, total: float, minimum: float, delta: float
) -> tuple[float, float, float, float]:
    """Take one step of the test; return the new (n, mean, total, minimum). The statistic is total - minimum."""
    n += 1.0
    mean += (x - mean) / n
    total += mean - x - delta
    return n, mean, total, total if total < minimum else minimum


def page_hinkley_alarm(state: list[float], params: tuple[float, ...], x: float) -> tuple[bool, float, int]:
    """Take one step on state = (n, mean, total, minimum), with params = (delta, threshold)."""
    n, mean, total, minimum = page_hinkley(x, state[0], state[1], state[2], state[3], params[0])
    state[0] = n
    state[1] = mean
    state[2] = total
    state[3] = minimum
    statistic = total - minimum
    return statistic > params[1], statistic, DOWN


class PageHinkley:
    """Page-Hinkley test on one signal.

    Examples
    --------
    >>> test = PageHinkley(PageHinkleyConfig(delta=0.5, threshold=12))
    >>> [(test.update(x), test.statistic) for x in (10, 10, 10, 0, 0)]
    [(False, 0.0), (False, 0.0), (False, 0.0), (False, 7.0), (True, 12.5)]
    """

    Config = PageHinkleyConfig
    direction: Direction = "down"
    state_format = "page_hinkley/1"

    def __init__(self, config: PageHinkleyConfig) -> None:
        self.config = config
        self._state = [0.0] * 4
        self._params = (config.delta, config.threshold)

    @property
    def quiet(self) -> QuietRule:
        """The rule of `update`, over this one's numbers."""
        return QuietRule(page_hinkley_alarm, self._state, self._params)

    @property
    def statistic(self) -> float:
        """How far the cumulative sum stands above its minimum."""
        return self._state[2] - self._state[3]

    @property
    def threshold(self) -> float:
        """What the statistic is held against."""
        return self.config.threshold

    def update(self, x: float) -> bool:
        """Take one value; say whether the test alarms."""
        return page_hinkley_alarm(self._state, self._params, x)[0]

    def reset(self) -> None:
        """Forget everything."""
        self._state[:] = (0.0,) * 4

    def state(self) -> dict[str, float]:
        """Return the four numbers of the test."""
        return dict(zip(_NUMBERS, self._state, strict=True))

    def restore(self, state: Any) -> None:
        """Take up where `state` was given."""
        numbers = [float(state[key]) for key in _NUMBERS]
        if not all(math.isfinite(number) for number in numbers):
            raise ValueError(f"state {state} of a Page-Hinkley test must be finite")
        self._state[:] = numbers
