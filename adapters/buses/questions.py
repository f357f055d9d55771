"""What a role asks of Knowledge, again until it is answered."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import zenoh

from adapters.buses import pieces
from adapters.buses.messages import Happened, State, Swapped, Table
from adapters.buses.round_trip import RoundTrip
from adapters.buses.wire import MISSING, OF_CONFIG, ORDERED, Wire
from knowledge import QTable, Record, from_json
from mape.errors import BusError, ConfigError

ANSWER_WITHIN = 2.0
"""Seconds after which a question counts as lost at the earliest, and is asked again."""

_UNHEARD: Any = zenoh.handlers.Callback(lambda reply: None, indirect=False)


class Refused(BusError):
    """Knowledge said no; to ask again would not change it."""


class Missing(Refused):
    """Knowledge does not have the pieces of what was said to consist of them."""


class Questions(ABC):
    """The questions of one role; `Member` has the session over which they go.

    Parameters
    ----------
    wire, role, patience, waiting
        As `Member` takes them.
    """

    def __init__(self, wire: Wire, role: str, patience: float | None, waiting: Callable[[str], object]) -> None:
        self.wire = wire
        self.role = role
        self.patience = patience
        self._tell = waiting
        self._told = ""
        self._session: zenoh.Session | None = None
        self._epoch = b""
        self._round_trip = RoundTrip(wire.patience)
        self._deaf_since: float | None = None  # the first question that was lost, of those since the last answer

    def _check_size(self, *parts: bytes | None) -> None:
        """Refuse to send what would be thrown away on the other side without a word."""
        size = sum(len(part) for part in parts if part is not None)
        if size > self.wire.largest:
            raise BusError(
                f"{self.role} has a message of {size:,} bytes, and at most {self.wire.largest:,} are taken: give "
                f"--largest-message {(size >> 20) + 2} to all processes of the run"
            )

    @abstractmethod
    def _lost(self) -> None:
        """Take note that a question was lost."""

    @abstractmethod
    def _look_at_keys(self, now: float) -> None:
        """Take note of a certificate that ends, or was renewed."""

    @abstractmethod
    def _between(self) -> None:
        """Do, between two pieces of something large, what is not to wait for all of it."""

    def _say(self, sentence: str) -> None:
        if sentence != self._told:
            self._told = sentence
            self._tell(sentence)

    def ask(
        self,
        what: str,
        payload: bytes | None = None,
        attachment: bytes | None = None,
        deadline: float | None = None,
        *,
        any_system: bool = False,
    ) -> bytes:
        """Ask Knowledge, again until it answers; with `any_system` the one that is there, of whatever system it is.

        Raises
        ------
        Refused
            It says no, and why.
        ConfigError
            It has another config.
        BusError
            It does not answer within the patience.
        """
        if self._session is None:
            raise BusError(f"{self.role} is not connected; call connect()")
        if deadline is None and self.patience is not None:
            deadline = time.monotonic() + self.patience
        self._check_size(payload, attachment)
        key = self.wire.ask_any(what) if any_system else self.wire.ask(what)
        pause, tick = 0.005, threading.Event()
        while True:
            # Nobody there, a hub that fell over the question, and one that is just restarting look the same: no reply.
            # To ask again is safe, as Knowledge takes everything once.
            outcome, asked_at = "no reply", time.monotonic()
            patience = self._round_trip.within(ANSWER_WITHIN)
            for reply in self._session.get(key, payload=payload, attachment=attachment, timeout=patience, **ORDERED):
                if reply.ok is not None:
                    self._deaf_since = None
                    self._round_trip.took(time.monotonic() - asked_at)
                    return bytes(reply.ok.payload.to_bytes())
                outcome = "Timeout" if reply.err is None else reply.err.payload.to_string()
                if outcome.startswith(MISSING):
                    raise Missing(outcome)
                if outcome.startswith(OF_CONFIG):
                    raise ConfigError(outcome.removeprefix(OF_CONFIG))
                if outcome != "Timeout" and not outcome.startswith("later: "):
                    raise Refused(f"{self.role} is refused by Knowledge: {outcome}")
            if outcome == "Timeout":
                self._round_trip.in_vain()
                self._lost()
            if deadline is not None and time.monotonic() > deadline:
                raise BusError(
                    f"Knowledge on {self.wire.endpoint} did not answer {self.role} ({outcome}). Is it running, with "
                    "the same system?"
                )
            self._look_at_keys(time.monotonic())
            if pause > 0.1:
                self._say(f"waiting for Knowledge on {self.wire.endpoint}")
            # No event tells that a queryable is there again; where one reply was lost, the first pause is short.
            tick.wait(pause)
            pause = min(2 * pause, 0.2)

    def ask_whole(self, what: str) -> bytes:
        """Ask Knowledge for what may be too large for one message, piece after piece."""
        parts = pieces.Assembled()
        found = parts.take(self.ask(what))
        while found is None:
            self._between()
            found = parts.take(self.ask(f"{what}{';' if '?' in what else '?'}whole={parts.whole};at={parts.at}"))
        return found

    def tell_whole(self, what: str, data: bytes) -> bytes:
        """Tell Knowledge what may be too large for one message; return its answer."""
        if len(data) <= pieces.PIECE:
            return self.ask(what, data, self._epoch)
        while True:
            whole = self._hand_over(data)
            try:
                return self.ask(f"{what}?whole={whole}", None, self._epoch)
            except Missing:
                pass  # it was started again in between

    def _hand_over(self, data: bytes) -> str:
        """Give Knowledge all pieces of a message, and return by what it names it."""
        whole, at = pieces.sha256(data), 0
        while at < len(data):
            at = int(self.ask(f"piece/{self.role}", pieces.cut(data, whole, at), self._epoch))
            self._between()
        return whole

    def snapshot(self, loop: int) -> tuple[State, QTable | None] | None:
        """Return this role's newest state of a loop, or None where it has none."""
        found = self.ask_whole(f"snapshot/{self.role}?loop={loop}")
        return State.unpack(found) if found else None

    def keep_surely(self, state: State, table: QTable | None = None) -> None:
        """Have a state kept, and wait for the answer."""
        self.tell_whole(f"snapshot/{self.role}", state.pack(table))

    def swapped(self, swap: Swapped) -> None:
        """Have it kept that a part was replaced; from its pass on every restart uses the new one."""
        self.ask(f"swapped/{self.role}", swap.pack(), self._epoch)

    def note(
        self, kind: str, text: str, loop: int | None = None, number: int | None = None, *, surely: bool = True
    ) -> None:
        """Note an event beside the records; `surely` waits for the answer."""
        what, payload = f"event/{self.role}", Happened(kind=kind, text=text, loop=loop, pass_no=number).pack()
        if surely:
            self.ask(what, payload, self._epoch)
            return
        if self._session is None:
            raise BusError(f"{self.role} is not connected; call connect()")
        self._session.get(
            self.wire.ask(what), _UNHEARD, payload=payload, attachment=self._epoch, timeout=self.wire.patience,
            **ORDERED,
        )  # fmt: skip

    def history(self, loop: int, stages: Mapping[int, int]) -> list[Record]:
        """Return the records of the stages named, each from its pass on; as many as fit into one answer."""
        wanted = ",".join(f"{stage}:{number}" for stage, number in stages.items())
        return [from_json(line) for line in self.ask(f"since?loop={loop};from={wanted}").splitlines()[1:]]

    def table(self, which: str) -> QTable:
        """Return a Q-table, by ``sha256=...`` or by ``loop=...;pass=...``."""
        _, table = Table.unpack(self.ask_whole(f"table?{which}"))
        if table is None:
            raise BusError("Knowledge answered without the Q-table that it was asked for")
        return table

    def remember(self, table: QTable) -> str:
        """Have a Q-table kept for a later plan; return its hash."""
        return self.tell_whole("remember/plan", Table(loop=None, pass_no=None).pack(table)).decode()
