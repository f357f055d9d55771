"""The contract of a detector."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Any, get_args

from knowledge.records import Direction
from mape.ports import Detector
from mape.testing.clauses import (
    Broken,
    Feed,
    Finding,
    Noted,
    finite,
    judge,
    plain_json,
    resumable,
    stream_of,
    walk,
)
from mape.testing.quiet import by_rule

STREAM = stream_of((50, 5, 150), (-400, 5, 60), (-400, 0, 40), (9000, 200, 240), (-9000, 1, 60))
"""Signal that a detector is checked on: noise, falls, a rise, a stretch without any noise."""

PASTS = 16
"""Pairs of short pasts, and of longer ones, from which a detector is reset."""


def check_detector(make: Callable[[], Detector], stream: Sequence[float] = STREAM) -> list[Finding]:
    """Check a detector on `stream`; it is reset after each alarm, as Monitor does it."""

    def script() -> Feed:
        def feed(parts: Sequence[Detector], i: int) -> list[Any]:
            return [_reading(part, stream[i]) for part in parts]

        return feed

    def forgets() -> None:
        half = len(stream) // 2
        left = [_same_after_reset(make, stream[:count], stream[::-1][:count], stream[:half]) for count in (1, half)]
        # From many pasts and into many futures: what one-sided tests keep is seen by falls or by rises alone. Every
        # second future follows its past in the stream, where what is kept would tell most.
        rng = random.Random(1963)
        for turn, most in enumerate((*(10,) * PASTS, *(60,) * PASTS, half)):
            count, length = rng.randint(1, min(most, half)), min(2 * most, half)
            begin = rng.randint(0, len(stream) - count - length)
            past, after = stream[begin : begin + count], stream[begin + count : begin + count + length]
            future = _stretch(rng, stream, length) if turn % 2 else after
            left.append(_same_after_reset(make, past, _stretch(rng, stream, count), future))
        for told in filter(None, left):
            raise Noted(
                f"{told} are the states of two that saw other values before their reset; no reading showed it, but "
                "what a reset leaves is heard of some time, unless it is a mere record"
            )

    return judge(
        make,
        "direction statistic update() reset() state() restore()",
        [
            ("gives plain readings: a bool, and a finite statistic or None", walk(make, script, len(stream))),
            *resumable(make, script, len(stream)),
            ("forgets on reset the values that it has seen", forgets),
            by_rule("detector", make, script, len(stream)),
        ],
    )


def _stretch(rng: random.Random, stream: Sequence[float], length: int) -> Sequence[float]:
    """Return a stretch of the stream from anywhere in it, forwards or backwards."""
    begin = rng.randint(0, len(stream) - length)
    return stream[begin : begin + length][:: rng.choice((1, -1))]


def _same_after_reset(
    make: Callable[[], Detector], past: Sequence[float], other: Sequence[float], future: Sequence[float]
) -> str | None:
    """See that a reset leaves nothing of two pasts, of equal length: a count is no evidence, and may stay.

    Returns
    -------
    The states after the reset, where they differ though no reading does.
    """
    first, second = make(), make()
    for x, y in zip(past, other, strict=True):
        _reading(first, x)
        _reading(second, y)
    first.reset()
    second.reset()
    states = plain_json(first.state()), plain_json(second.state())
    for i, x in enumerate(future):
        one, another = _reading(first, x), _reading(second, x)
        if one != another:
            raise Broken(
                f"two that saw {len(past)} different values before their reset give {one} and {another} at value {i} "
                "after it; reset() sets all that update() writes"
            )
    return None if states[0] == states[1] else " and ".join(states)


def _reading(detector: Detector, x: float) -> tuple[bool, float | None, str]:
    alarm = detector.update(x)
    if type(alarm) is not bool:
        raise Broken(f"update({x}) returned {alarm!r}, a {type(alarm).__name__}; return bool(...)")
    statistic, direction = detector.statistic, detector.direction
    if statistic is not None and not finite(statistic):
        raise Broken(f"statistic is {statistic!r} after update({x}); give a finite number, or None before there is one")
    if direction not in get_args(Direction):
        raise Broken(f"direction is {direction!r}; it is one of {', '.join(get_args(Direction))}")
    if alarm:
        detector.reset()
    return alarm, statistic, direction
