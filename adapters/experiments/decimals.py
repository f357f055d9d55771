"""How many decimals a number is written with: as many as can be told apart."""

from __future__ import annotations

import math
from collections.abc import Iterable

MOST = 6
"""Decimals; what is too small for them is written with a power of ten."""

LARGE = 1e15
"""From here on numbers are written with a power of ten: a float holds no more than 16 digits."""


def resolution(intervals: Iterable[tuple[float, float] | None]) -> float:
    """Return half the width of the narrowest interval that has a width, or 0.0 where none has.

    >>> resolution([(1.0, 5.0), None, (3.0, 3.0)])
    2.0
    """
    widths = [(interval[1] - interval[0]) / 2.0 for interval in intervals if interval is not None]
    return min((width for width in widths if width > 0.0), default=0.0)


def number(value: float, resolution: float, sign: str = "-") -> str:
    """Write a number with thousands separated and as many decimals as `resolution` calls for.

    Parameters
    ----------
    value
        The number.
    resolution
        How far it can be told from others; 0.0 asks for a tenth of the number itself.
    sign
        ``"+"`` writes the sign of positive numbers too.

    >>> number(23348.123, 90.0), number(-340.26, 0.8), number(5.9, 0.0)
    ('23,348', '-340.3', '5.9')
    >>> number(-0.2, 3.0, "+"), number(-2.5e-9, 1e-10)
    ('+0', '-2.500e-09')
    """
    size = resolution if resolution > 0.0 else abs(value) / 10.0
    decimals = 0 if size == 0.0 or not math.isfinite(size) else max(0, -math.floor(math.log10(size)))
    if (decimals > MOST and 0.0 < abs(value) < 1e-3) or abs(value) >= LARGE:
        return f"{value:{sign}.3e}"
    return f"{value:{sign}z,.{min(MOST, decimals)}f}"


def plain(value: float, decimals: int = 2) -> str:
    """Write a number with thousands separated and a fixed number of decimals, or with a power of ten where it is large.

    >>> plain(-1234.5), plain(123456.78, 0), plain(1e200)
    ('-1,234.50', '123,457', '1.000e+200')
    """
    return f"{value:,.{decimals}f}" if abs(value) < LARGE else f"{value:.3e}"
