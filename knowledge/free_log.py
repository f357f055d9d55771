"""The sequence of a loop whose managed system does not wait: one increasing row of numbers per stage."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from knowledge.log import Ack
from knowledge.records import STAGES, ChangePlan, Record


class FreeLog:
    """The log of a free-running loop; it keeps numbers, and leaves the records to the store that holds them.

    Each stage has its own increasing sequence of passes. Observations come in order without a hole; what the managed
    system drove but could not send is said by `drop`. A later stage takes the passes of the stage before it, in
    order, past those that were dropped.

    `append` and `drop` answer

    - ``OK``: it was the next one of its stage;
    - ``DUPLICATE``: that stage is past it. Nothing is compared, as nothing is kept: the caller compares bytes;
    - ``GAP``: records before it are missing, of its own stage or of the one before; nothing was changed;
    - ``CONFLICT``: a record of a pass that was dropped and that its stage still has to go past, or a drop of
      Observations some of which are there; nothing was changed.

    Parameters
    ----------
    loop
        Number of the loop whose records are taken.

    Attributes
    ----------
    dropped : intervals (first, last) of dropped passes, in order, that ChangePlan still has to go past. Adjacent ones
        are merged, so that there are never more of them than passes under way, and one.

    Examples
    --------
    >>> from knowledge import Observation
    >>> log = FreeLog()
    >>> log.append(ChangePlan(0, 0, 1.0, (0.1,), (0, 1), (), (), False, None))
    <Ack.OK: 'ok'>
    >>> log.drop(1, 7)
    <Ack.OK: 'ok'>
    >>> log.append(Observation(0, 8, 0, 1.0, False, 40, (0, 1), (0, 1), {"return": -40.0}))
    <Ack.OK: 'ok'>
    >>> log.last(Observation), log.dropped
    (8, ((1, 7),))
    """

    def __init__(self, loop: int = 0) -> None:
        self.loop = loop
        self.dropped: tuple[tuple[int, int], ...] = ()
        self._last = [0, 0, 0, -1]  # in the order of STAGES; -1 until plan 0

    @classmethod
    def restore(cls, loop: int, last: Sequence[int], dropped: Iterable[tuple[int, int]] = ()) -> FreeLog:
        """Return the log that another one was.

        Parameters
        ----------
        loop
            Number of the loop.
        last
            What `last` says of each stage, in the order of `STAGES`.
        dropped
            Intervals of dropped passes, in any order; those that all stages are past may be among them.

        Raises
        ------
        ValueError
            No log was ever in that state.
        """
        log, numbers, intervals = cls(loop), list(last), sorted(dropped)
        fresh = log._last
        if (
            len(numbers) != len(STAGES)
            or numbers != sorted(numbers, reverse=True)
            or (numbers[-1] < 0 and numbers != fresh)
            or not all(1 <= a <= b <= numbers[0] for a, b in intervals)
            or any(a <= number <= b for a, b in intervals for number in numbers[1:])
        ):
            raise ValueError(
                f"no free-running log ends with {numbers} after dropping {intervals}: there is one number per stage, "
                f"none above that of the stage before; what was dropped lies within 1 .. the first, and no later stage "
                f"ends in it"
            )
        log._last, log.dropped = numbers, _merged(intervals)
        log._forget()
        return log

    def last(self, kind: type[Record]) -> int:
        """Return the newest pass of that stage: 0 if there is none, -1 for ChangePlan before plan 0.

        For Observation a dropped pass counts as one that is there.
        """
        return self._last[STAGES.index(kind)]

    def append(self, record: Record) -> Ack:
        """Take the number of `record` if it is the next one of its stage; see the class for the answers.

        Raises
        ------
        ValueError
            A record of another loop, or of a pass that cannot be.
        """
        number, kind = record.pass_no, type(record)
        if record.loop != self.loop:
            raise ValueError(f"a record of loop {record.loop} was sent to the log of loop {self.loop}")
        if number < 1 and (number, kind) != (0, ChangePlan):
            raise ValueError(f"{kind.__name__} {number}: passes are counted from 1; only plan 0 comes before")
        stage = STAGES.index(kind)
        if number <= self._last[stage]:
            return Ack.DUPLICATE
        if number > 0:
            if stage > 0 and any(first <= number <= last for first, last in self.dropped):
                return Ack.CONFLICT
            ready = self._last[-1] >= 0 and (stage == 0 or number <= self._last[stage - 1])
            if not ready or number != self._next(stage):
                return Ack.GAP
        self._last[stage] = number
        if kind is ChangePlan:
            self._forget()
        return Ack.OK

    def drop(self, first: int, last: int) -> Ack:
        """Note that the Observations `first` to `last` will not come; the next one is ``last + 1``.

        Raises
        ------
        ValueError
            These are no passes.
        """
        if not 1 <= first <= last:
            raise ValueError(f"passes {first} to {last} cannot be dropped: they are counted from 1, and upwards")
        seen = self._last[0]
        if last <= seen:
            return Ack.DUPLICATE
        if self._last[-1] < 0 or first > seen + 1:
            return Ack.GAP
        if first <= seen:
            return Ack.CONFLICT
        self._last[0] = last
        self.dropped = _merged([*self.dropped, (first, last)])
        return Ack.OK

    def _next(self, stage: int) -> int:
        number = self._last[stage] + 1
        if stage > 0:
            # Intervals are in order and never adjacent, so one step leads past each.
            for first, last in self.dropped:
                if first <= number <= last:
                    number = last + 1
        return number

    def _forget(self) -> None:
        # No stage is behind ChangePlan.
        self.dropped = tuple(interval for interval in self.dropped if interval[1] > self._last[-1])


def _merged(intervals: Sequence[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    merged: list[tuple[int, int]] = []
    for first, last in intervals:
        if merged and first <= merged[-1][1] + 1:
            first, end = merged.pop()
            last = max(last, end)
        merged.append((first, last))
    return tuple(merged)
