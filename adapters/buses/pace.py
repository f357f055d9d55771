"""How often Knowledge answers: so many questions of a kind and role a second, so that none of them slows the run."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any, NamedTuple

from adapters.roles import ROLES

PACE = 100
"""Questions of one kind and role that are answered in each second."""

PER_LOOP = 20
"""So many times as often, for each loop, is answered what passes rest on: records, states, Q-tables, events."""

WAITS = 5.0
"""Seconds for which a question waits for its turn, at most; one that would wait for longer is not answered."""

ROOM = 1024
"""Records of one role, for each loop, that wait to be appended at most; of signs of life as many."""

FEW = 32
"""Messages that may wait before each role's are counted."""

_BESIDE = ("status", "swap", "join")  # no pass rests on these


class Pace:
    """Lets questions through at their pace; those beyond it come late, and in order.

    Parameters
    ----------
    take
        Told each question in its turn.
    leave
        Told each that would have to wait for too long; who asked it asks again.
    most
        Questions of a kind and role a second.
    loops
        Number of loops of the run.
    """

    def __init__(
        self, take: Callable[[Any], object], leave: Callable[[Any], object], most: int = PACE, loops: int = 1
    ) -> None:
        self._take, self._leave = take, leave
        self._most, self._loops = most, loops
        self._turn: dict[tuple[str, str], float] = {}
        self._lock = threading.Lock()
        self._late: SimpleQueue[tuple[float, Any] | None] = SimpleQueue()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._hand_on, name="pace", daemon=True)

    def start(self) -> None:
        """Begin to let late questions through."""
        self._thread.start()

    def stop(self) -> None:
        """Let go what still waits."""
        self._stopped.set()
        self._late.put(None)
        self._thread.join()

    def hear(self, query: Any) -> None:
        """Take a question under ``knowledge``; called on Zenoh's threads, which it does not hold up."""
        what, _, role = str(query.key_expr).partition("/knowledge/")[2].partition("/")
        most = self._most if what in _BESIDE else self._most * PER_LOOP * self._loops
        kind = (what[:16], role if role in ROLES else "")
        now = time.monotonic()
        with self._lock:
            turn = max(self._turn.get(kind, 0.0), now - 1.0) + 1.0 / most
            waits = turn - now
            if waits <= WAITS:
                self._turn[kind] = turn
                if len(self._turn) > 256:  # of kinds that there are not
                    self._turn.clear()
        if waits <= 0.0:
            self._take(query)
        elif waits <= WAITS:
            self._late.put((turn, query))
        else:
            self._leave(query)

    def _hand_on(self) -> None:
        while (late := self._late.get()) is not None:
            turn, query = late
            if self._stopped.wait(max(0.0, turn - time.monotonic())):
                self._leave(query)
            else:
                self._take(query)


class Room:
    """Lets each role have so much waiting, so that none keeps the others waiting behind what it sends.

    Whose a message is, is looked at only where much waits: it costs a call into Zenoh and a lock, twice a record.

    Parameters
    ----------
    queue
        Where what there is room for is put, as (kind, message).
    kind
        Which messages these are.
    leave
        Told each message that there is no room for; who sent it sends it again.
    most
        Messages of a role that wait at most, beside the few of whomever.
    few
        Messages in `queue` up to which nobody's are counted.
    """

    def __init__(
        self, queue: SimpleQueue[Any], kind: str, leave: Callable[[Any], object], most: int = ROOM, few: int = FEW
    ) -> None:
        self._put, self._waits, self._leave = queue.put, queue.qsize, leave
        self._kind, self._most, self._few = kind, most, few
        self._waiting = dict.fromkeys((*ROLES, ""), 0)
        self._lock = threading.Lock()

    def hear(self, what: Any) -> None:
        """Take a query or sample whose key ends with its role; called on Zenoh's threads."""
        if self._waits() < self._few:
            self._put((self._kind, what))
            return
        role = self._role(what)
        with self._lock:
            there_is = self._waiting[role] < self._most
            self._waiting[role] += there_is
        if there_is:
            self._put((self._kind, Counted(self, what)))
        else:
            self._leave(what)

    def heard(self, what: Any) -> None:
        """Make room again: what was counted is dealt with."""
        with self._lock:
            self._waiting[self._role(what)] -= 1

    def _role(self, what: Any) -> str:
        role = str(what.key_expr).rpartition("/")[2]
        return role if role in self._waiting else ""


class Counted(NamedTuple):
    """A message that takes room until it is dealt with."""

    room: Room
    what: Any
