"""What a role is to see: each record of its input once, in order, whatever is lost on the way."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import zenoh

from adapters.buses.questions import ANSWER_WITHIN
from adapters.buses.wire import INPUT, LARGEST_MESSAGE, ORDERED, SINCE_LIMIT, Wire
from knowledge import STAGES, MalformedRecord, Record, from_json
from mape.errors import BusError

SILENCE = 0.3
"""Seconds without a publication after which Knowledge is asked whether one was missed."""


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

    Attributes
    ----------
    get : the session's, None while there is none.
    seal : Knowledge's.
    """

    def __init__(self, wire: Wire, role: str, handler: Any, take: Callable[[Record], object]) -> None:
        self.get: Callable[..., object] | None = None
        self.seal = b""
        self._wire = wire
        self._role = role
        self._input = STAGES.index(INPUT[role])
        self._handler = handler
        self._take = take
        self._next: dict[int, int] = {}  # loop -> pass of the next record that is waited for
        self._heard: dict[int, float] = {}  # when something of a loop came last, or was asked for
        self._fetched: set[int] = set()  # loops of which an answer is awaited

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

    def forget_questions(self) -> None:
        """Await no answer any more: the session over which they would come is gone."""
        self._fetched.clear()

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
        self._next[record.loop] = expected + 1
        self._heard[record.loop] = time.monotonic()
        self._take(record)

    def caught_up(self, loop: int, lines: Sequence[bytes]) -> None:
        """Take an answer to what was asked: records of a loop, in order."""
        self._fetched.discard(loop)
        news = False
        for line in lines:
            record = from_json(line)
            expected = self._next.get(record.loop)
            if expected is not None and record.pass_no >= expected:
                self._next[record.loop] = record.pass_no + 1
                self._take(record)
                news = True
        # An answer that was read late, after its question was asked again, asks for no more.
        if news and len(lines) >= SINCE_LIMIT and loop in self._next:
            self._fetch(loop)

    def keep_up(self, now: float) -> None:
        """Ask for what may have been missed."""
        for loop in self._next:
            silent = now - self._heard.get(loop, 0.0)
            if silent > (ANSWER_WITHIN if loop in self._fetched else SILENCE):
                self._fetched.discard(loop)
                self._fetch(loop)

    def _fetch(self, loop: int) -> None:
        if loop in self._fetched:
            return
        self._fetched.add(loop)
        self._heard[loop] = time.monotonic()
        if self.get is None:
            raise BusError(f"{self._role} is not connected; call connect()")
        # The answer is not waited for: a managed system that runs freely does not stand still for it.
        self.get(
            f"{self._wire.ask('since')}?loop={loop};from={self._input}:{self._next[loop]}", self._handler,
            timeout=ANSWER_WITHIN, **ORDERED,
        )  # fmt: skip
