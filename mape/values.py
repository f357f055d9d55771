"""What environments and parts return, taken for what it is: a number, a truth value, ids; never for something near.

Python's own conversions are kinder: `float` reads numbers out of texts and `bool` finds truth in anything; NumPy's drop
the imaginary part, and `int` what is behind the point. Each function here returns None for what is not of its kind.
"""

from __future__ import annotations

import operator
import reprlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

_LONGEST = 80


def number(value: Any) -> float | None:
    """Return a real number as a float; None for text, a vector, a complex number, or one too large for a float.

    >>> number(np.float32(0.5)), number(np.array(3)), number("3"), number([3.0]), number(1j)
    (0.5, 3.0, None, None, None)
    """
    if isinstance(value, float):
        return float(value)
    if isinstance(value, (np.ndarray, np.generic)):
        real = value.shape == () and value.dtype.kind in "biuf"
    else:
        # As an int, a fraction, or another library's number without dimensions.
        real = hasattr(value, "__float__") and getattr(value, "shape", ()) == ()
    try:
        return float(value) if real else None
    except (TypeError, ValueError, OverflowError):
        return None


def truth(value: Any) -> bool | None:
    """Return True or False where that is what it is, Python's or NumPy's, or as 1 or 0.

    >>> truth(np.True_), truth(0), truth("False"), truth(None), truth(2)
    (True, False, None, None, None)
    """
    if value is True or value is False:
        return bool(value)
    if isinstance(value, (np.ndarray, np.generic)):
        legal = value.shape == () and value.dtype.kind in "biu"
    else:
        legal = isinstance(value, int)
    return bool(value) if legal and (value == 0 or value == 1) else None


def whole(value: Any) -> int | None:
    """Return an integer as an int; None for all else, a bool and a float among it.

    >>> whole(np.int8(3)), whole(np.array(3)), whole(3.0), whole(True)
    (3, 3, None, None)
    """
    if isinstance(value, bool):
        return None
    try:
        return operator.index(value)
    except TypeError:
        return None


def ids(value: Any) -> tuple[int, ...] | None:
    """Return integers as a tuple, in their order; None where it is something else.

    >>> ids(np.array([2, 0])), ids({1}), ids((0, 1.5)), ids("01"), ids(3), ids([True, False])
    ((2, 0), (1,), None, None, None, None)
    """
    if isinstance(value, (str, bytes, Mapping)) or not isinstance(value, Iterable):
        return None
    try:
        found = tuple(whole(item) for item in value)
    except TypeError:  # an array without dimensions
        return None
    return None if None in found else found  # type: ignore[return-value]


def shown(value: Any) -> str:
    """Return a value as one line of a message, however long it is, or whatever its own `repr` does.

    >>> shown(np.array([[0, 4], [1, 2]])), shown("left"), len(shown("x" * 1000)) < 100
    ('[[0, 4], [1, 2]]', "'left'", True)
    """
    try:
        if isinstance(value, (np.ndarray, np.generic)):
            value = value.tolist() if value.size <= _LONGEST else value.ravel()[:_LONGEST].tolist()
        text = " ".join(repr(value).split())
    except Exception:  # of somebody else's class; an int of more digits than Python writes
        text = reprlib.repr(type(value))
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."
