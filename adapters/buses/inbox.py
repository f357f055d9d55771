"""What a role is to see: each record of its input once, in order, whatever is lost on the way."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import zenoh

from adapters.buses.questions import ANSWER_WITHIN
from adapters.buses.round_trip import RoundTrip
from adapters.buses.wire import INPUT, LARGEST_MESSAGE, ORDERED, Wire
from knowledge import STAGES, MalformedRecord, Record, from_json
from mape.errors import BusError

SILENCE = 0.3
"""Seconds without a publication after which Knowledge is asked whether one was missed, at the earliest."""

LONGEST_SILENCE = 5.0
"""Seconds of silence, or what an answer takes if that is more, after which it is asked however slow the loop is."""


class Inbox:
    """The records that come to one role, of all loops that it watches.

    What is published is taken if it bears Knowledge's seal and is the next of its loop; where one was missed, where
    nothing comes for a while, and at the start, Knowledge is asked for what the log holds from there on.

    Parameters
    ----------
    wire, role
        Where Knowledge listens, and who sees them.
    handler
        Zenoh's for the answers; who takes them in hands them to `caught_up`.
    take
        Takes a record that is seen.
    round_trip
        How long answers take on this link.

    Attributes
    ----------
    get : the session's, None while there is none.
    seal : Knowledge's.
    """

    def __init__(
        self, wire: Wire, role: str, handler: Any, take: Callable[[Record], object], round_trip: RoundTrip
    ) -> None:
        self.get: Callable[..., object] | None = None
        self.seal = b""
        self._wire = wire
        self._role = role
        self._input = STAGES.index(INPUT[role])
        self._handler = handler
        self._take = take
        self._round_trip = round_trip
        self._turnaround = RoundTrip(LONGEST_SILENCE)  # of a loop, from one of its records to the next
        self._next: dict[int, int] = {}  # loop -> pass of the next record that is waited for
        self._heard: dict[int, float] = {}  # when something of a loop came last
        self._fetched: dict[int, float] = {}  # loops of which an answer is awaited, and since when
        self._nothing_new: dict[int, int] = {}  # loop -> answers in a row that brought nothing

    def watch(self, loop: int, number: int) -> None:
        """Wait for the records of a loop from pass `number` on.

        Raises
        ------
        BusError
            There is no session.
        """
        self._next[loop] = number
        self._fetch(loop)

    def unwatch(self, loop: int) -> None:
        """Wait for no more of a loop."""
        self._next.pop(loop, None)
        self._heard.pop(loop, None)
        self._fetched.pop(loop, None)

    def ask_again(self) -> None:
        """Ask for all anew: the link over which answers and publications would have come was gone."""
        self._fetched.clear()
        self._nothing_new.clear()
        for loop in self._next:
            self._fetch(loop)

    def hear(self, sample: zenoh.Sample) -> None:
        """Take a publication.

        Raises
        ------
        MalformedRecord
            It is none of Knowledge's, or none that this role takes.
        """
        if len(sample.payload) > LARGEST_MESSAGE:
            raise MalformedRecord(f"a publication of {len(sample.payload)} bytes")
        seal = sample.attachment
        if seal is None or seal.to_bytes() != self.seal:
            raise MalformedRecord("a publication that does not bear Knowledge's seal")
        record = from_json(sample.payload.to_bytes())
        if type(record) is not STAGES[self._input]:
            raise MalformedRecord(f"a {type(record).__name__}, which {self._role} does not take")
        expected = self._next.get(record.loop)
        if expected is None or record.pass_no < expected:
            return
        if record.pass_no > expected:
            self._fetch(record.loop)
            return
        now = time.monotonic()
        if (before := self._heard.get(record.loop)) is not None and not self._nothing_new.get(record.loop):
            self._turnaround.took(now - before)
        self._next[record.loop] = expected + 1
        self._heard[record.loop] = now
        self._nothing_new.pop(record.loop, None)
        self._take(record)

    def caught_up(self, loop: int, lines: Sequence[bytes], more: bool) -> None:
        """Take an answer to what was asked: records of a loop, in order, and whether the log has more of them."""
        now, news = time.monotonic(), False
        if (asked := self._fetched.pop(loop, None)) is not None:
            self._round_trip.took(now - asked)
            self._heard[loop] = now
        for line in lines:
            record = from_json(line)
            expected = self._next.get(record.loop)
            if expected is not None and record.pass_no >= expected:
                self._next[record.loop] = record.pass_no + 1
                self._take(record)
                news = True
        self._nothing_new[loop] = 0 if news else self._nothing_new.get(loop, 0) + 1
        # An answer that was read late, after its question was asked again, asks for no more.
        if news and more and loop in self._next:
            self._fetch(loop)

    def keep_up(self, now: float) -> None:
        """Ask for what may have been missed."""
        answer, longest = self._round_trip.within(ANSWER_WITHIN), max(LONGEST_SILENCE, self._round_trip.expected)
        silence = max(SILENCE, self._turnaround.expected)
        in_vain = False
        for loop in self._next:
            asked = self._fetched.get(loop)
            if asked is not None and now - asked > answer:
                del self._fetched[loop]
                in_vain = True
                self._fetch(loop)
            # Where there is nothing new, it is asked ever more rarely: the loop may be at work.
            elif asked is None and now - self._heard.get(loop, 0.0) > min(
                longest, silence * 2 ** min(16, self._nothing_new.get(loop, 0))
            ):
                self._fetch(loop)
        if in_vain:
            self._round_trip.in_vain()

    def _fetch(self, loop: int) -> None:
        if loop in self._fetched:
            return
        self._fetched[loop] = time.monotonic()
        if self.get is None:
            raise BusError(f"{self._role} is not connected; call connect()")
        # The answer is not waited for: a managed system that runs freely does not stand still for it.
        self.get(
            f"{self._wire.ask('since')}?loop={loop};from={self._input}:{self._next[loop]}", self._handler,
            timeout=self._round_trip.within(ANSWER_WITHIN), **ORDERED,
        )  # fmt: skip
