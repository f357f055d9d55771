"""Observations as table indices: discrete spaces as they are, boxes through a grid of bins.

What is not in the space has no index: it is refused, and taken for nothing that is.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces

from mape.config import BoxGrid
from mape.errors import ConfigError, ManagedSystemError
from mape.values import shown

LARGEST = 50_000_000

Index = Callable[[Any], int]


class _Outside(Exception):
    """An observation, or a part of one, is not in its space."""


def state_index(space: spaces.Space[Any], grid: BoxGrid | None, name: str) -> tuple[int, Index]:
    """Return the number of states of `space` and the function from observation to index.

    The function raises a ManagedSystemError for an observation that is not in the space.

    Raises
    ------
    ConfigError
        The space is no table of states, or `grid` does not fit it.
    """
    size, index = _index(space, grid, name)
    if size > LARGEST:
        many = str(size) if size < 10**15 else "more than 10^15"  # Python does not print a number of any length
        raise ConfigError(f"{name} has {many} states; a table of more than {LARGEST} does not fit. Use fewer bins.")

    def checked(seen: Any) -> int:
        try:
            return index(seen)
        except _Outside as outside:
            raise ManagedSystemError(
                f"{name} gave the observation {shown(seen)}, which is not in its observation space {space}{outside}"
            ) from None

    return size, checked


def _index(space: spaces.Space[Any], grid: BoxGrid | None, name: str) -> tuple[int, Index]:
    if isinstance(space, spaces.Box):
        return _binned(space, grid, name)
    if grid is not None:
        raise ConfigError(f"system.discretise is for Box observations; {name} has {space}. Leave it out.")
    if isinstance(space, spaces.Discrete):
        return _counted(int(space.n), int(space.start))
    if isinstance(space, spaces.MultiDiscrete):
        counts = [int(n) for n in np.ravel(space.nvec)]
        starts = [int(first) for first in np.ravel(space.start)]
        return _mixed(counts, starts, space.shape)
    if isinstance(space, spaces.MultiBinary):
        size = int(np.prod(space.shape))
        # The first bit counts least, in a MultiDiscrete the first number most.
        return _mixed([2] * size, [0] * size, space.shape, [1 << power for power in range(size)])
    if isinstance(space, spaces.Tuple):
        return _nested([_index(part, None, name) for part in space.spaces])
    raise ConfigError(
        f"{name} has observations {space}; tabular learning needs Discrete, MultiDiscrete, MultiBinary, a Tuple of "
        "such, or a Box with system.discretise"
    )


def _counted(size: int, start: int) -> tuple[int, Index]:
    def counted(seen: Any) -> int:
        try:
            state = operator.index(seen) - start
        except TypeError:  # text, a float, an array
            raise _Outside from None
        if 0 <= state < size:
            return state
        raise _Outside

    return size, counted


def _mixed(
    counts: list[int], starts: list[int], shape: tuple[int, ...], weights: list[int] | None = None
) -> tuple[int, Index]:
    if weights is None:
        weights = [math.prod(counts[i + 1 :]) for i in range(len(counts))]
    places = list(zip(starts, counts, weights, strict=True))

    def mixed(seen: Any) -> int:
        total = 0
        for value, (first, count, weight) in zip(_values(seen, shape), places, strict=True):
            digit = value - first
            if not 0 <= digit < count or digit != int(digit):
                raise _Outside
            total += int(digit) * weight
        return total

    return math.prod(counts), mixed


def _nested(parts: list[tuple[int, Index]]) -> tuple[int, Index]:
    def nested(seen: Any) -> int:
        if not isinstance(seen, (tuple, list, np.ndarray)) or len(seen) != len(parts):
            raise _Outside
        total = 0
        for (size, index), value in zip(parts, seen, strict=True):
            total = total * size + index(value)
        return total

    return math.prod(size for size, _ in parts), nested


def _values(seen: Any, shape: tuple[int, ...]) -> list[Any]:
    """Return the numbers of an array of that shape, or of lists of lists, in their order."""
    try:
        array = seen if isinstance(seen, np.ndarray) else np.asarray(seen)
    except (TypeError, ValueError):  # lists of unequal length
        raise _Outside from None
    if array.shape != shape or array.dtype.kind not in "biuf":
        raise _Outside
    values: list[Any] = array.ravel().tolist()
    return values


def _rounded(value: float, dtype: Any) -> float:
    """Return a number as a space of that type holds it: beside the bounds of a float32 a float64 may seem outside."""
    with np.errstate(over="ignore"):
        return float(dtype.type(value))


def _binned(space: spaces.Box, grid: BoxGrid | None, name: str) -> tuple[int, Index]:
    dimensions = int(np.prod(space.shape))
    if grid is None:
        raise ConfigError(
            f"{name} has real observations of {dimensions} dimensions; give system.discretise with low, high and bins, "
            "one number per dimension"
        )
    if len(grid.bins) != dimensions:
        raise ConfigError(
            f"system.discretise names {len(grid.bins)} dimensions; the observations of {name} have {dimensions}"
        )
    assert space.dtype is not None
    real, shape = space.dtype.kind == "f", space.shape
    limits = zip(space.low.ravel().tolist(), space.high.ravel().tolist(), strict=True)
    bounds = list(zip(limits, grid.low, grid.high, grid.bins, strict=True))

    def binned(seen: Any) -> int:
        total = 0
        for value, ((least, most), low, high, bins) in zip(_values(seen, shape), bounds, strict=True):
            if not math.isfinite(value):
                raise _Outside("; a number that is binned is finite")
            if not (least <= value <= most or (real and least <= _rounded(value, space.dtype) <= most)):
                raise _Outside
            if not (real or value == int(value)):
                raise _Outside
            if value >= high:
                total = total * bins + bins - 1
            else:
                total = total * bins + (0 if value <= low else min(int((value - low) / (high - low) * bins), bins - 1))
        return total

    return math.prod(grid.bins), binned
