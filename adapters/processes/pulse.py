"""The heartbeat of Execute while it drives: a sign of life for each step, and an end where a step never returns."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable
from typing import Self

import zenoh

from adapters.buses.member import BEAT_EVERY, Member
from adapters.processes.supervise import HUNG, SYSTEM_FAILED
from mape.execute import Execute

NOTED_WITHIN = 5.0
"""Seconds that the last word of a hung Execute may take."""


class Pulse:
    """Says every half second that Execute is alive while it drives, and ends it where no step returns for too long.

    It looks from a thread of its own at counters that the driving thread keeps anyway: a step costs nothing more. Time
    is counted in its own ticks, so that a process that was frozen has not hung meanwhile.

    Parameters
    ----------
    member
        Gives the link to Knowledge, which nobody else uses while a system is driven.
    driven
        Gives the loops that are driven, by their numbers.
    hang_after
        Seconds without a step after which the episode is given up, and this process with it; None for ever.
    end
        Ends the process, with an exit code; its driving thread cannot be told.
    """

    def __init__(
        self,
        member: Callable[[], Member],
        driven: Callable[[], dict[int, Execute]],
        hang_after: float | None,
        end: Callable[[int], object] = os._exit,
    ) -> None:
        self._member = member
        self._driven = driven
        self._hang_after = hang_after
        self._end = end
        self._still = 0.0
        self._seen: tuple[int, int, int] = (0, 0, 0)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="pulse", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stopping.set()
        self._thread.join()

    def _beat(self) -> None:
        while not self._stopping.wait(BEAT_EVERY):
            self.look(BEAT_EVERY)

    def look(self, passed: float) -> None:
        """Look once, so many seconds after the last time."""
        at_work = [(loop, number, one) for loop, one in self._driven().items() if (number := one.driving)]
        if not at_work:
            self._still = 0.0
            return  # it waits for a record, and says so itself
        loop, number, one = at_work[0]
        seen = (loop, number, one.steps)
        self._still = self._still + passed if seen == self._seen else 0.0
        self._seen = seen
        if self._hang_after is not None and self._still >= self._hang_after:
            self._give_up(loop, number, one)
            return
        with contextlib.suppress(zenoh.ZError):  # the link may just be lost
            self._member().beat()

    def _give_up(self, loop: int, number: int, one: Execute) -> None:
        where = f"step {one.steps + 1}" if one.steps >= 0 else "its reset"
        why = f"{where} of episode {number} did not return within {self._hang_after:g} s"
        noting = threading.Thread(target=self._note, args=(why, loop, number), daemon=True)
        noting.start()
        noting.join(NOTED_WITHIN)
        last = one.attempts.is_last(number)
        said = f"{why}. {one.attempts.rule}" if last else f"{why}."
        print(f"mapek: {said}", file=sys.stderr, flush=True)  # noqa: T201
        self._end(SYSTEM_FAILED if last else HUNG)

    def _note(self, why: str, loop: int, number: int) -> None:
        member = self._member()
        member.note("aborted", why, loop, number)
        member.settle()
