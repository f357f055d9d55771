"""What a role has sent: kept, and sent again, until Knowledge has acknowledged it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from adapters.buses.questions import ANSWER_WITHIN, Refused
from adapters.buses.wire import ORDERED, Wire
from adapters.roles import STAGE_OF
from knowledge import STAGES
from mape.errors import BusError

RESEND_AFTER = 0.5
"""Seconds without an acknowledgement after which a record is sent again."""

REPEAT_AFTER = 0.05
"""The same, where Knowledge says that a record before another is missing."""

RESENT_AT_ONCE = 64
"""Most records of a loop that are sent again together."""


class _Sent(NamedTuple):
    number: int
    payload: bytes
    attachment: bytes
    at: float


class Outbox:
    """The records of one role that are on their way, of all loops.

    Parameters
    ----------
    wire, role
        Where Knowledge listens, and whose they are.
    handler
        Zenoh's for the answers; who takes them in tells `acknowledged`.

    Attributes
    ----------
    get : the session's, None while there is none.
    """

    def __init__(self, wire: Wire, role: str, handler: Any) -> None:
        self.get: Callable[..., object] | None = None
        self._wire = wire
        self._role = role
        self._handler = handler
        self._sent: dict[int, deque[_Sent]] = {}
        self._kept: dict[int, int] = {}  # loop -> number of the last record of this stage that Knowledge has

    def begin(self, loop: int, last: int) -> None:
        """Take note of the last record of a loop that Knowledge had when this role joined."""
        self._kept.setdefault(loop, last)

    def put(self, loop: int, number: int, payload: bytes, attachment: bytes) -> None:
        """Send the record `number` of a loop, again until it is acknowledged.

        Raises
        ------
        BusError
            There is no session.
        """
        waiting = self._sent.get(loop)
        if waiting is None:
            waiting = self._sent[loop] = deque()
        waiting.append(_Sent(number, payload, attachment, time.monotonic()))
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
        while waiting and waiting[0].number <= last:
            waiting.popleft()
        if not waiting:
            return
        # One that was lost lets all behind it come too early; they are not answered by as many repetitions.
        if time.monotonic() - waiting[0].at > (REPEAT_AFTER if ack == "gap" else RESEND_AFTER):
            self._send_again(loop)

    def keep_up(self, now: float) -> None:
        """Send again what has waited for too long."""
        for loop, waiting in self._sent.items():
            if waiting and now - waiting[0].at > RESEND_AFTER:
                self._send_again(loop)

    def _send_again(self, loop: int) -> None:
        now = time.monotonic()
        waiting = self._sent[loop]
        for i in range(min(len(waiting), RESENT_AT_ONCE)):
            waiting[i] = waiting[i]._replace(at=now)
            self._transmit(loop, waiting[i].payload, waiting[i].attachment)

    def _transmit(self, loop: int, payload: bytes, attachment: bytes) -> None:
        if self.get is None:
            raise BusError(f"{self._role} is not connected; call connect()")
        self.get(
            self._wire.append(self._role, loop), self._handler, payload=payload, attachment=attachment,
            timeout=ANSWER_WITHIN, **ORDERED,
        )  # fmt: skip
