"""How long an answer takes, as it was observed: what is waited for, and asked again, follows from that."""

from __future__ import annotations

import random

SMOOTHING, SPREADING = 1 / 8, 1 / 4
"""Weights of the newest observation in the mean, and of its deviation in the mean deviation."""

DEVIATIONS = 4.0
"""So many mean deviations above the mean, an answer is late."""

JITTER = 0.25
"""Share by which waiting may be longer: those who wait for the same do not all ask again at once."""


class RoundTrip:
    """Mean and deviation of what was observed, and how long to wait for the next (RFC 6298).

    Each time that it was waited for in vain the patience doubles, up to a cap; whatever comes then resets it.

    Parameters
    ----------
    most
        Seconds that are waited at most.

    Examples
    --------
    >>> link = RoundTrip(most=60.0)
    >>> 0.5 <= link.within(0.5) <= 0.625  # nothing is known yet
    True
    >>> link.took(1.0)
    >>> 3.0 <= link.within(0.5) <= 3.75
    True
    >>> for _ in range(10):
    ...     link.in_vain()
    >>> link.within(0.5)
    60.0
    """

    def __init__(self, most: float) -> None:
        self.most = most
        self._mean: float | None = None
        self._deviation = 0.0
        self._doubled = 1.0

    def took(self, seconds: float) -> None:
        """Take note of how long an answer took."""
        self._doubled = 1.0
        if self._mean is None:
            self._mean, self._deviation = seconds, seconds / 2
            return
        self._deviation += SPREADING * (abs(seconds - self._mean) - self._deviation)
        self._mean += SMOOTHING * (seconds - self._mean)

    def in_vain(self) -> None:
        """Take note that an answer did not come in time."""
        self._doubled = min(2 * self._doubled, 2.0**20)

    @property
    def expected(self) -> float:
        """Seconds within which nearly all answers come; 0 where nothing is known."""
        return 0.0 if self._mean is None else self._mean + DEVIATIONS * self._deviation

    def within(self, least: float) -> float:
        """Return how many seconds to wait for an answer, `least` at least, and not twice exactly the same."""
        wanted = max(least, self.expected) * self._doubled * (1.0 + JITTER * random.random())
        return min(wanted, max(least, self.most))
