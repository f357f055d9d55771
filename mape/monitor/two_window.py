"""Two-window test of the mean: whether the newest values are far from the ones before them.

    z = (mean(recent) - mean(reference)) / sqrt(var(reference) / reference_size + var(recent) / recent_size)
    alarm iff |z| > threshold

Two-sided: it also sees a rise of the signal, which Page-Hinkley on the return cannot. Source: the classical
two-sample z-test over sliding windows (Kifer, Ben-David & Gehrke, VLDB 2004).
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

from pydantic import Field

from knowledge.records import Direction
from mape.specs import PartConfig


class TwoWindowConfig(PartConfig):
    """Options of `TwoWindow`."""

    reference: int = Field(200, ge=2, description="values in the older window")
    recent: int = Field(30, ge=2, description="values in the newer window")
    threshold: float = Field(7.0, gt=0, description="alarm above this |z|")


def two_window_z(
    count_old: float, sum_old: float, squares_old: float, count_new: float, sum_new: float, squares_new: float
) -> float:
    """Return z of the two windows, from their counts, sums and sums of squares; 0 where neither varies."""
    mean_old, mean_new = sum_old / count_old, sum_new / count_new
    var_old = max(squares_old - count_old * mean_old * mean_old, 0.0) / (count_old - 1.0)
    var_new = max(squares_new - count_new * mean_new * mean_new, 0.0) / (count_new - 1.0)
    spread = math.sqrt(var_old / count_old + var_new / count_new)
    if spread <= 1e-12 * max(abs(mean_old), abs(mean_new), 1.0):
        return 0.0 if mean_old == mean_new else math.copysign(1e9, mean_new - mean_old)
    return (mean_new - mean_old) / spread


class TwoWindow:
    """Two adjacent sliding windows over one signal.

    Examples
    --------
    >>> test = TwoWindow(TwoWindowConfig(reference=4, recent=2, threshold=3))
    >>> [test.update(x) for x in (0.0, 1.0, 0.0, 1.0, 9.0, 9.0)]
    [False, False, False, False, False, True]
    """

    Config = TwoWindowConfig
    state_format = "two_window/1"

    def __init__(self, config: TwoWindowConfig) -> None:
        self.config = config
        self._z: float | None = None
        self.reset()

    @property
    def direction(self) -> Direction:
        """Side to which the mean moved, by the last z."""
        return "unknown" if not self._z else "up" if self._z > 0 else "down"

    @property
    def statistic(self) -> float | None:
        """The last |z|, or None before the windows are full."""
        return None if self._z is None else abs(self._z)

    def update(self, x: float) -> bool:
        """Take one value; say whether the test alarms."""
        self._values.append(x)
        if len(self._values) < self.config.reference + self.config.recent:
            return False
        values = list(self._values)
        # Sums are taken relative to one value of the window: squares of large offsets would cancel.
        old = [v - values[0] for v in values[: self.config.reference]]
        new = [v - values[0] for v in values[self.config.reference :]]
        self._z = two_window_z(len(old), sum(old), sum(v * v for v in old), len(new), sum(new), sum(v * v for v in new))
        return abs(self._z) > self.config.threshold

    def reset(self) -> None:
        """Forget everything."""
        self._values: deque[float] = deque(maxlen=self.config.reference + self.config.recent)
        self._z = None

    def state(self) -> dict[str, Any]:
        """Return the values in the windows and the last z."""
        return {"values": list(self._values), "z": self._z}

    def restore(self, state: Any) -> None:
        """Take up where `state` was given."""
        self.reset()
        self._values.extend(float(v) for v in state["values"])
        self._z = state["z"]
