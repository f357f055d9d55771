"""Two-window test of the mean: whether the newest values are far from the ones before them.

    z = (mean(recent) - mean(reference)) / sqrt(var(reference) / reference_size + var(recent) / recent_size)
    alarm iff |z| > threshold

Two-sided: it also sees a rise of the signal, which Page-Hinkley on the return cannot. Source: the classical
two-sample z-test over sliding windows (Kifer, Ben-David & Gehrke, VLDB 2004).
"""

from __future__ import annotations

import math
from typing import Any

from pydantic import Field

from knowledge.records import Direction
from knowledge.rows import DOWN, SIDES, UNKNOWN, UP
from mape.ports import QuietRule
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


def two_window_alarm(state: list[float], params: tuple[float, ...], x: float) -> tuple[bool, float, int]:
    """Take one value; params = (reference, recent, threshold).

    state = (z, number of values taken, the newest of them): the values stand in a ring, number k in place k modulo its
    length. z is NaN before the windows are full.
    """
    reference = int(params[0])
    recent = int(params[1])
    length = reference + recent
    taken = int(state[1])
    state[2 + taken % length] = x
    taken += 1
    state[1] = taken
    if taken < length:
        state[0] = math.nan  # what shorter windows gave, whose values these are, is no reading of this test
        return False, math.nan, UNKNOWN
    # Sums are taken relative to the oldest value: squares of large offsets would cancel.
    origin = state[2 + taken % length]
    sum_old = squares_old = sum_new = squares_new = 0.0
    for k in range(taken, taken + reference):
        value = state[2 + k % length] - origin
        sum_old += value
        squares_old += value * value
    for k in range(taken + reference, taken + length):
        value = state[2 + k % length] - origin
        sum_new += value
        squares_new += value * value
    z = two_window_z(float(reference), sum_old, squares_old, float(recent), sum_new, squares_new)
    state[0] = z
    return abs(z) > params[2], abs(z), side(z)


def side(z: float) -> int:
    """Return the code of the side to which the mean moved."""
    if z > 0.0:
        return UP
    return DOWN if z < 0.0 else UNKNOWN


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
        self._length = config.reference + config.recent
        self._state = [0.0] * (2 + self._length)
        self._params = (float(config.reference), float(config.recent), config.threshold)
        self.reset()

    @property
    def quiet(self) -> QuietRule:
        """The rule of `update`, over this one's numbers."""
        return QuietRule(two_window_alarm, self._state, self._params)

    @property
    def direction(self) -> Direction:
        """Side to which the mean moved, by the last z."""
        return SIDES[side(self._state[0])]

    @property
    def statistic(self) -> float | None:
        """The last |z|, or None before the windows are full."""
        z = self._state[0]
        return None if math.isnan(z) else abs(z)

    @property
    def threshold(self) -> float:
        """What the statistic is held against."""
        return self.config.threshold

    def update(self, x: float) -> bool:
        """Take one value; say whether the test alarms."""
        return two_window_alarm(self._state, self._params, x)[0]

    def reset(self) -> None:
        """Forget everything."""
        self._state[:2] = (math.nan, 0.0)

    def state(self) -> dict[str, Any]:
        """Return the values in the windows, oldest first, and the last z."""
        taken = int(self._state[1])
        first = max(0, taken - self._length)
        values = [self._state[2 + k % self._length] for k in range(first, taken)]
        z = self._state[0]
        return {"values": values, "z": None if math.isnan(z) else z}

    def restore(self, state: Any) -> None:
        """Take up where `state` was given."""
        values = [float(v) for v in state["values"]][-self._length :]
        z = math.nan if state["z"] is None else float(state["z"])
        self._state[: 2 + len(values)] = [z, float(len(values)), *values]
