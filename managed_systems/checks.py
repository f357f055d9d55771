"""Checks of constructor values. Each raises a ValueError that names the value, what is legal, and the way out."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from typing import Any

import numpy as np


def whole(name: str, value: object, low: int, high: int | None = None) -> int:
    """Return `value` as an int within ``low..high``; no upper limit where `high` is None.

    Raises
    ------
    ValueError
        It is not an integer (a bool is none), or outside.
    """
    legal = f"an integer of at least {low}" if high is None else f"an integer in {low}..{high}"
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ValueError(f"{name} is {value!r}; give {legal}")
    number = int(value)
    if number < low or (high is not None and number > high):
        raise ValueError(f"{name} is {number}; give {legal}")
    return number


def real(name: str, value: object, low: float = -math.inf, high: float = math.inf) -> float:
    """Return `value` as a finite float within ``low..high``.

    Raises
    ------
    ValueError
        It is not a number, not finite, or outside.
    """
    if high < math.inf:
        limits = f" in {low:g}..{high:g}"
    else:
        limits = f" of at least {low:g}" if low > -math.inf else ""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise ValueError(f"{name} is {value!r}; give a finite number{limits}")
    number = float(value)
    if not math.isfinite(number) or not low <= number <= high:
        raise ValueError(f"{name} is {number}; give a finite number{limits}")
    return number


def items(name: str, value: object, legal: str, length: int | None = None) -> tuple[Any, ...]:
    """Return the items of a sequence as a tuple, with exactly `length` of them where it is given.

    Raises
    ------
    ValueError
        It is not a sequence (text is none), or has another length.
    """
    found = None if isinstance(value, str | bytes) or not isinstance(value, Iterable) else tuple(value)
    if found is None or (length is not None and len(found) != length):
        raise ValueError(f"{name} is {value!r}; give {legal}")
    return found


def integer_pair(name: str, value: object, low: int, high: int | None = None) -> tuple[int, int]:
    """Return two integers, each within ``low..high``.

    Raises
    ------
    ValueError
        They are not two, not integers, or outside.
    """
    first, second = items(name, value, "two integers", length=2)
    return whole(f"{name}[0]", first, low, high), whole(f"{name}[1]", second, low, high)


def episodes(name: str, value: object) -> tuple[int, ...]:
    """Return the episodes of a schedule: integers of at least 2, strictly increasing.

    Raises
    ------
    ValueError
        They are not; phase 0 holds in episode 1, so no switch can be due then.
    """
    legal = "strictly increasing episodes of at least 2, such as (301, 601), or () for no switch"
    found = tuple(whole(f"{name}[{i}]", episode, 2) for i, episode in enumerate(items(name, value, legal)))
    if any(later <= earlier for earlier, later in itertools.pairwise(found)):
        raise ValueError(f"{name} is {found}; give {legal}")
    return found


def one_of(name: str, value: object, legal: tuple[object, ...]) -> None:
    """Raise a ValueError unless `value` is one of `legal`."""
    if value not in legal:
        raise ValueError(f"{name} is {value!r}; give one of {', '.join(map(repr, legal))}")
