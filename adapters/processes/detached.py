"""A role's link to Knowledge on a thread of its own: who drives a system never waits for the network.

What the driving thread says is queued, and said in that order; what comes is queued for it. Whatever the link has to
wait for, a session that is opened, a queue that is full, an answer that does not come, this thread waits for.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable
from functools import partial
from queue import Empty, SimpleQueue
from typing import NamedTuple, Self

import zenoh

from adapters.buses.member import Asked, Member
from adapters.buses.messages import State, Swapped
from adapters.processes.role import IDLE
from knowledge import ChangePlan, QTable, Record

ENDS_WITHIN = 2.0
"""Seconds that the link's thread has to end, when it is not to finish what it does."""


class Brought(NamedTuple):
    """A plan, with the remembered Q-table that it adopts: who puts it in force need not ask for that."""

    plan: ChangePlan
    table: QTable


class Detached:
    """What `FreeExecuteRole` uses of a `Member`, none of which waits.

    Parameters
    ----------
    member
        The link, which is connected; from `start` to `stop` only the thread made here touches it.
    """

    def __init__(self, member: Member) -> None:
        self.wire, self.role, self.joined = member.wire, member.role, member.joined
        self._member = member
        self._jobs: deque[Callable[[], object]] = deque()
        self._came: SimpleQueue[Record | Asked | Brought | None] = SimpleQueue()
        self._asked_for: Counter[int] = Counter()  # loop -> records that were given to `send` or `drop`
        self._said: Counter[int] = Counter()  # of those, how many the member has been given
        self._alive = True  # the driving thread has shown itself since the last heartbeat
        self._stopping = self._finishing = False
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="link", daemon=True)

    def start(self) -> None:
        """Let the thread have the link."""
        self._member.vouched = self._vouched
        self._thread.start()

    def stop(self) -> None:
        """End the thread, whatever is still to be said."""
        self._stopping = True
        self._member.wake()
        self._thread.join(ENDS_WITHIN)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    # From the driving thread.

    @property
    def passes(self) -> int:
        """For the heartbeat: what all loops together have done."""
        return self._member.passes

    @passes.setter
    def passes(self, passes: int) -> None:
        self._member.passes = passes

    def beat(self) -> None:
        """Show that the driving thread is alive; the link's thread tells Knowledge."""
        self._alive = True

    def receive(self, timeout: float) -> Record | Asked | Brought | None:
        """Return what has come; None where nothing did within `timeout` seconds.

        Raises
        ------
        BusError
            The link has failed, as `Member.receive` says.
        """
        self._alive = True
        try:
            came = self._came.get(timeout=timeout) if timeout > 0.0 else self._came.get_nowait()
        except Empty:
            return None
        if came is None:
            self._raise()
        return came

    def send(self, record: Record, state: State | None = None, table: QTable | None = None) -> None:
        """Have a record appended, as `Member.send`."""
        self._asked_for[record.loop] += 1
        self._do(partial(self._send, record, state, table))

    def drop(self, loop: int, first: int, last: int) -> None:
        """Say that episodes will not be logged."""
        self._asked_for[loop] += 1
        self._do(partial(self._drop, loop, first, last))

    def unacknowledged(self, loop: int) -> int:
        """Return how many records of a loop are queued, or were sent and not acknowledged yet."""
        return self._asked_for[loop] - self._said[loop] + self._member.unacknowledged(loop)

    def keep(self, state: State, table: QTable | None = None) -> None:
        """Have a state kept."""
        self._do(partial(self._member.keep, state, table))

    def keep_surely(self, state: State, table: QTable | None = None) -> None:
        """Have a state kept; `settle` waits until it is."""
        self._do(partial(self._member.keep_surely, state, table))

    def swapped(self, swap: Swapped) -> None:
        """Have it kept, before all that is sent later, that a part was replaced."""
        self._do(partial(self._member.swapped, swap))

    def note(
        self, kind: str, text: str, loop: int | None = None, number: int | None = None, *, surely: bool = True
    ) -> None:
        """Note an event beside the records."""
        self._do(partial(self._member.note, kind, text, loop, number, surely=surely))

    def answer(self, asked: Asked, payload: bytes) -> None:
        """Answer a question to this role."""
        self._do(partial(self._member.answer, asked, payload))

    def refuse(self, query: zenoh.Query, why: str) -> None:
        """Say no to a question to this role, and why."""
        self._do(partial(self._member.refuse, query, why))

    def unwatch(self, loop: int) -> None:
        """Receive no more of `loop`."""
        self._do(partial(self._member.unwatch, loop))

    def settle(self, within: float | None = None) -> None:
        """Wait until all is said and acknowledged; nothing is said afterwards.

        Parameters
        ----------
        within
            Seconds after which it is given up, without a word; None for never.

        Raises
        ------
        BusError
            As `Member.settle`.
        """
        self._do(self._finish)
        self._thread.join(within)
        self._raise()

    def _do(self, job: Callable[[], object]) -> None:
        self._jobs.append(job)
        self._member.wake()

    def _raise(self) -> None:
        if self._failure is not None:
            raise self._failure

    # From the link's.

    def _vouched(self) -> bool:
        alive, self._alive = self._alive, False
        return alive

    def _work(self) -> None:
        try:
            while not self._stopping and not self._finishing:
                if self._jobs:
                    self._jobs.popleft()()
                    came = self._member.receive(0.0)
                else:
                    came = self._member.receive(IDLE)
                if isinstance(came, ChangePlan) and came.adopt is not None:
                    self._came.put(Brought(came, self._member.table(f"sha256={came.adopt}")))
                elif came is not None:
                    self._came.put(came)
        except BaseException as error:  # the driving thread raises it
            self._failure = error
            self._came.put(None)

    def _finish(self) -> None:
        self._member.settle()
        self._finishing = True

    def _send(self, record: Record, state: State | None, table: QTable | None) -> None:
        self._member.send(record, state, table)
        self._said[record.loop] += 1

    def _drop(self, loop: int, first: int, last: int) -> None:
        self._member.drop(loop, first, last)
        self._said[loop] += 1
