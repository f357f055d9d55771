"""What a role has sent: kept, and sent again, until Knowledge has acknowledged it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from adapters.buses.questions import Refused
from adapters.buses.round_trip import RoundTrip
from adapters.buses.wire import ORDERED, Wire
from adapters.roles import STAGE_OF
from knowledge import STAGES
from mape.errors import BusError

RESEND_AFTER = 0.5
"""Seconds without an acknowledgement after which a record is sent again, at the earliest."""

REPEAT_AFTER = 0.05
"""The same, where Knowledge says that a record before another is missing."""

RESENT_AT_ONCE = 64
"""Most records of a loop that are sent again together."""


class _Sent(NamedTuple):
    number: int
    payload: bytes
    attachment: bytes
    at: float
    behind: bytes = b""  # what is too large to be sent with it, and is handed over before
    again: bool = False


class Outbox:
    """The records of one role that are on their way, of all loops.

    Parameters
    ----------
    wire, role
        Where Knowledge listens, and whose they are.
    handler
        Zenoh's for the answers; who takes them in tells `acknowledged`.
    round_trip
        How long answers take on this link.

    Attributes
    ----------
    get : the session's, None while there is none.
    """

    def __init__(self, wire: Wire, role: str, handler: Any, round_trip: RoundTrip) -> None:
        self.get: Callable[..., object] | None = None
        self._wire = wire
        self._role = role
        self._handler = handler
        self._round_trip = round_trip
        self._sent: dict[int, deque[_Sent]] = {}
        self._kept: dict[int, int] = {}  # loop -> number of the last record of this stage that Knowledge has

    def begin(self, loop: int, last: int) -> None:
        """Take note of the last record of a loop that Knowledge had when this role joined."""
        self._kept.setdefault(loop, last)

    def put(self, loop: int, number: int, payload: bytes, attachment: bytes, behind: bytes = b"") -> None:
        """Send the record `number` of a loop, again until it is acknowledged.

        What stands `behind` it was handed over in pieces; it is held as long as it may have to be again.

        Raises
        ------
        BusError
            There is no session.
        """
        waiting = self._sent.get(loop)
        if waiting is None:
            waiting = self._sent[loop] = deque()
        waiting.append(_Sent(number, payload, attachment, time.monotonic(), behind))
        self._transmit(loop, payload, attachment)

    @property
    def empty(self) -> bool:
        """Whether all is acknowledged."""
        return not any(self._sent.values())

    def unacknowledged(self, loop: int) -> int:
        """Return how many records of a loop were sent and not acknowledged yet."""
        return len(self._sent.get(loop, ()))

    def acknowledged(self, loop: int, ack: str, last: int) -> None:
        """Take Knowledge's answer: what became of a record, and the last one of the loop that is in the log.

        Raises
        ------
        Refused
            The log is behind of what it was.
        """
        waiting, kept = self._sent.get(loop), self._kept[loop]
        if last < kept:
            kind = STAGES[STAGE_OF[self._role]].__name__
            raise Refused(
                f"Knowledge had {kind} {kept} of loop {loop} from {self._role}, and has them up to {last} only. Was it "
                "started anew with an older log?"
            )
        self._kept[loop] = last
        now, first = time.monotonic(), None
        while waiting and waiting[0].number <= last:
            first = waiting.popleft()
            if not first.again:  # else nobody knows which of the two is answered
                self._round_trip.took(now - first.at)
        if not waiting:
            return
        # What was lost is what was sent before that which had to be sent again; or, where Knowledge misses something,
        # what has had the time to come. The others are on their way, and they are not answered by as many repetitions.
        lost_with_it = first is not None and first.again and not waiting[0].again and waiting[0].at < first.at
        missed = ack == "gap" and now - waiting[0].at > max(REPEAT_AFTER, self._round_trip.expected)
        if lost_with_it or missed:
            self._send_again(loop, now, RESENT_AT_ONCE)

    def keep_up(self, now: float) -> bool:
        """Send again what has waited for too long: the first of each loop, whose answer tells of the others.

        Returns
        -------
        bool
            Whether there was such a one.
        """
        long, in_vain = self._round_trip.within(RESEND_AFTER), False
        for loop, waiting in self._sent.items():
            if waiting and now - waiting[0].at > long:
                self._send_again(loop, now, 1)
                in_vain = True
        if in_vain:
            self._round_trip.in_vain()
        return in_vain

    @property
    def behind(self) -> dict[int, bytes]:
        """Return per loop what belongs to the first record that is not acknowledged, where that is large."""
        return {loop: waiting[0].behind for loop, waiting in self._sent.items() if waiting and waiting[0].behind}

    def send_again(self, loop: int) -> None:
        """Send the first record of a loop again, now that what belongs to it has been handed over."""
        self._send_again(loop, time.monotonic(), 1)

    def send_all_again(self) -> None:
        """Send again what was on its way over a link that is gone."""
        for loop in self._sent:
            self._send_again(loop, time.monotonic(), RESENT_AT_ONCE)

    def _send_again(self, loop: int, now: float, most: int) -> None:
        waiting = self._sent[loop]
        for i in range(min(len(waiting), most)):
            waiting[i] = waiting[i]._replace(at=now, again=True)
            self._transmit(loop, waiting[i].payload, waiting[i].attachment)

    def _transmit(self, loop: int, payload: bytes, attachment: bytes) -> None:
        if self.get is None:
            raise BusError(f"{self._role} is not connected; call connect()")
        self.get(
            self._wire.append(self._role, loop), self._handler, payload=payload, attachment=attachment,
            timeout=self._wire.patience, **ORDERED,  # an answer that comes late is one all the same
        )  # fmt: skip
