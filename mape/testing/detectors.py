"""The contract of a detector."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, get_args

from knowledge.records import Direction
from mape.ports import Detector
from mape.testing.clauses import (
    Broken,
    Feed,
    Finding,
    finite,
    judge,
    resumable,
    stream_of,
    walk,
)
from mape.testing.quiet import by_rule

STREAM = stream_of((50, 5, 150), (-400, 5, 60), (-400, 0, 40), (9000, 200, 240), (-9000, 1, 60))
"""Signal that a detector is checked on: noise, falls, a rise, a stretch without any noise."""


def check_detector(make: Callable[[], Detector], stream: Sequence[float] = STREAM) -> list[Finding]:
    """Check a detector on `stream`; it is reset after each alarm, as Monitor does it."""

    def script() -> Feed:
        def feed(parts: Sequence[Detector], i: int) -> list[Any]:
            return [_reading(part, stream[i]) for part in parts]

        return feed

    def forgets() -> None:
        half = len(stream) // 2
        for count in (1, half):
            # As many values to both: a count of the episodes is no evidence, and may be kept.
            first, second = make(), make()
            for x, y in zip(stream[:count], reversed(stream[-count:]), strict=True):
                _reading(first, x)
                _reading(second, y)
            first.reset()
            second.reset()
            for i, x in enumerate(stream[:half]):
                one, other = _reading(first, x), _reading(second, x)
                if one != other:
                    raise Broken(
                        f"two that saw {count} different values before their reset give {one} and {other} at value {i} "
                        "after it; reset() sets all that update() writes"
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
