"""Observations as table indices: discrete spaces as they are, boxes through a grid of bins."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces

from mape.config import BoxGrid
from mape.errors import ConfigError

LARGEST = 50_000_000


def state_index(space: spaces.Space[Any], grid: BoxGrid | None, name: str) -> tuple[int, Callable[[Any], int]]:
    """Return the number of states of `space` and the function from observation to index.

    Raises
    ------
    ConfigError
        The space is no table of states, or `grid` does not fit it.
    """
    size, index = _index(space, grid, name)
    if size > LARGEST:
        many = str(size) if size < 10**15 else "more than 10^15"  # Python does not print a number of any length
        raise ConfigError(f"{name} has {many} states; a table of more than {LARGEST} does not fit. Use fewer bins.")
    return size, index


def _index(space: spaces.Space[Any], grid: BoxGrid | None, name: str) -> tuple[int, Callable[[Any], int]]:
    if isinstance(space, spaces.Box):
        return _binned(space, grid, name)
    if grid is not None:
        raise ConfigError(f"system.discretise is for Box observations; {name} has {space}. Leave it out.")
    if isinstance(space, spaces.Discrete):
        start = int(space.start)
        return int(space.n), lambda seen: int(seen) - start
    if isinstance(space, spaces.MultiDiscrete):
        counts = [int(n) for n in np.ravel(space.nvec)]
        starts = [int(first) for first in np.ravel(space.start)]
        weights = [math.prod(counts[i + 1 :]) for i in range(len(counts))]
        return math.prod(counts), lambda seen: sum(
            (int(value) - first) * weight
            for value, first, weight in zip(np.ravel(seen).tolist(), starts, weights, strict=True)
        )
    if isinstance(space, spaces.MultiBinary):
        bits = int(np.prod(space.shape))
        return 2**bits, lambda seen: sum(int(bit) << i for i, bit in enumerate(np.ravel(seen).tolist()))
    if isinstance(space, spaces.Tuple):
        parts = [_index(part, None, name) for part in space.spaces]

        def mixed(seen: Any) -> int:
            total = 0
            for (size, index), value in zip(parts, seen, strict=True):
                total = total * size + index(value)
            return total

        return math.prod(size for size, _ in parts), mixed
    raise ConfigError(
        f"{name} has observations {space}; tabular learning needs Discrete, MultiDiscrete, MultiBinary, a Tuple of "
        "such, or a Box with system.discretise"
    )


def _binned(space: spaces.Box, grid: BoxGrid | None, name: str) -> tuple[int, Callable[[Any], int]]:
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
    bounds = list(zip(grid.low, grid.high, grid.bins, strict=True))

    def binned(seen: Any) -> int:
        total = 0
        for value, (low, high, bins) in zip(np.ravel(seen).tolist(), bounds, strict=True):
            if not math.isfinite(value):
                raise ValueError(f"observation {np.ravel(seen).tolist()} is not finite")
            total = total * bins + min(max(int((value - low) / (high - low) * bins), 0), bins - 1)
        return total

    return math.prod(grid.bins), binned
