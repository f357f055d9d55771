"""States that a role has kept at Knowledge while it goes on: the newest of each loop, large ones piece by piece."""

from __future__ import annotations

import time
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

import zenoh

from adapters.buses import pieces
from adapters.buses.messages import State
from adapters.buses.questions import ANSWER_WITHIN
from adapters.buses.round_trip import RoundTrip
from adapters.buses.wire import MISSING, ORDERED, Wire
from knowledge import QTable
from mape.errors import BusError

_UNHEARD: Any = zenoh.handlers.Callback(lambda reply: None, indirect=False)


class _Underway:
    """A state that is being sent."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.whole = pieces.sha256(data)
        self.at = 0
        self.asked_at = 0.0
        self.number = 0  # of the question that is waited for


class Keeping:
    """The states of one role that are on their way to Knowledge.

    One is sent at a time, a piece after the acknowledgement of the one before; a newer one of its loop waits, and takes
    the place of what waits already. So a slow link carries each piece once, and whole states come through it. That one
    gets lost does no harm, as another one will follow.

    Parameters
    ----------
    wire, role
        Where Knowledge listens, and whose they are.
    arrived
        Takes the answers, as ``("kept", ...)``; who takes them in hands them to `answered`.
    round_trip
        How long answers take on this link.

    Attributes
    ----------
    get : the session's, None while there is none.
    epoch : the role's, as it is attached.
    """

    def __init__(self, wire: Wire, role: str, arrived: SimpleQueue[Any], round_trip: RoundTrip) -> None:
        self.get: Callable[..., object] | None = None
        self.epoch = b""
        self._wire = wire
        self._role = role
        self._put = arrived.put
        self._round_trip = round_trip
        self._next: dict[int, bytes] = {}  # by loop
        self._underway: _Underway | None = None
        self._questions = 0

    def put(self, state: State, table: QTable | None) -> None:
        """Have a state kept: a small one at once, a large one as soon as the one under way is."""
        data = state.pack(table)
        if len(data) <= pieces.PIECE:
            self._say(f"snapshot/{self._role}", data, _UNHEARD)
            return
        self._next[state.loop] = data
        if self._underway is None:
            self._begin()

    def answered(self, number: int, reply: zenoh.Reply) -> None:
        """Take an answer of Knowledge."""
        now = self._underway
        if now is None or number != now.number:
            return  # its question was asked again
        said = "" if reply.err is None else reply.err.payload.to_string()
        if said == "Timeout":
            return
        self._round_trip.took(time.monotonic() - now.asked_at)
        if said.startswith(MISSING):
            now.at = 0
        elif reply.ok is None or now.at == len(now.data):
            self._begin()  # it is kept; or is not wanted, and another one will follow
            return
        else:
            now.at = int(reply.ok.payload.to_bytes())
        self._ask()

    def keep_up(self, now: float) -> None:
        """Ask again what was not answered."""
        if self._underway is not None and now - self._underway.asked_at > self._round_trip.within(ANSWER_WITHIN):
            self._round_trip.in_vain()
            self._ask()

    def ask_again(self) -> None:
        """Ask again what was under way over a link that is gone."""
        if self._underway is not None:
            self._ask()

    def _begin(self) -> None:
        self._underway = None
        if self._next:
            self._underway = _Underway(self._next.pop(next(iter(self._next))))
            self._ask()

    def _ask(self) -> None:
        now = self._underway
        assert now is not None
        self._questions += 1
        now.number, now.asked_at = self._questions, time.monotonic()
        put, number = self._put, self._questions
        handler: Any = zenoh.handlers.Callback(lambda reply: put(("kept", (number, reply))), indirect=False)
        if now.at < len(now.data):
            self._say(f"piece/{self._role}", pieces.cut(now.data, now.whole, now.at), handler)
        else:
            self._say(f"snapshot/{self._role}?whole={now.whole}", None, handler)

    def _say(self, what: str, payload: bytes | None, handler: Any) -> None:
        if self.get is None:
            raise BusError(f"{self._role} is not connected; call connect()")
        self.get(
            self._wire.ask(what), handler, payload=payload, attachment=self.epoch, timeout=self._wire.patience,
            **ORDERED,
        )  # fmt: skip
