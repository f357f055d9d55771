"""The bus of a component that runs in a process of its own."""

from __future__ import annotations

import json
import time
import weakref
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, Self

import zenoh

from adapters.buses.wire import ORDERED, Wire, at_place, place, segment
from adapters.buses.zenoh_hub import SINCE_LIMIT
from knowledge import STAGES, Ack, MalformedRecord, Record, from_json, to_json
from mape.bus import refusal
from mape.errors import BusError

SILENCE = 0.3
"""Seconds without a publication after which Knowledge is asked whether one was missed."""

ANSWER_WITHIN = 2.0
"""Seconds after which a query counts as lost, and is sent again."""


class ZenohBus:
    """Sends records to a `KnowledgeHub`, and delivers what it appended on the caller's thread.

    Nothing rests on delivery. A record is sent again until Knowledge has acknowledged it; it appends a record once
    however often it comes. What is published is only a hint: when one comes that may be new, or nothing comes, the bus
    asks Knowledge for what the log holds from its own place on, and delivers that. So a bus that joins late, or comes
    back after its link was lost, catches up by itself, and a stray or forged publication costs a question and no more.

    Nobody is authenticated. Whoever reaches the endpoint may append a record, which then is in the log, or answer in
    Knowledge's stead; only who may open the socket, or is on this host, keeps strangers out.

    Over a wire "nothing waits" is never known for sure. `run` returns when everything is delivered that the log held
    when it was called, and what this bus sent since. To wait for others, `run_until`.

    Constructing does no I/O. Subscribe, `connect` (or enter the context), send and run, `close`; all on one thread.

    Parameters
    ----------
    wire
        Where Knowledge listens.
    name
        What this component is called; seen by others as its liveliness token.
    first_pass
        The pass to begin with; 0 begins with plan 0. One that has left the log's window cannot be had from here.
    patience
        Seconds that Knowledge may be away, at the start or between, before a BusError.
    """

    def __init__(self, wire: Wire, name: str, *, first_pass: int = 0, patience: float = 10.0) -> None:
        self.wire = wire
        self.name = segment(name, "a component's name")
        self.patience = patience
        self._handlers: dict[type[Record], list[Callable[[Any], object]]] = {}
        self._subscribers: dict[type[Record], zenoh.Subscriber[None]] = {}
        self._arrived: SimpleQueue[zenoh.Sample] = SimpleQueue()  # filled by Zenoh's thread, and by nobody else
        self._waiting: deque[Record] = deque()  # in order, each once
        self._next = max(0, len(STAGES) * (first_pass - 1) + 1)  # place of the first record that never waited
        self._sent = -1  # the farthest place that Knowledge acknowledged to this bus
        self._asked = False  # whether what was there before this bus has been fetched
        self._session: zenoh.Session | None = None
        self._leave: Callable[..., object] | None = None
        self._closed = False

    def subscribe(self, kind: type[Record], handler: Callable[[Any], object]) -> None:
        """Deliver every record of `kind` to `handler`, after those that subscribed before."""
        self._handlers.setdefault(kind, []).append(handler)
        if self._session is not None:
            self._declare(self._session, kind)

    def connect(self) -> None:
        """Join Knowledge; waits `patience` seconds for it at most.

        Raises
        ------
        BusError
            Nobody listens there, or this bus was closed.
        """
        if self._closed:
            raise BusError(f"the bus of {self.name} is closed; make another")
        if self._session is not None:
            return
        with ExitStack() as opened:
            session = self.wire.join(self.patience)
            opened.callback(session.close)
            for kind in self._handlers:
                self._declare(session, kind)
            # Last: who sees the token knows that the subscriptions stand.
            token = session.liveliness().declare_token(self.wire.alive(self.name, session))
            opened.callback(token.undeclare)
            # At the latest at the interpreter's exit: a Zenoh thread that then still calls Python aborts the process.
            self._leave = weakref.finalize(self, opened.pop_all().close)
        self._session = session

    def send(self, record: Record) -> None:
        """Have `record` appended, and wait for the acknowledgement; what is there already is not delivered again.

        Raises
        ------
        BusError
            Records before it are missing, another record has its place, it is malformed, or Knowledge does not answer.
        """
        named = f"{type(record).__name__} {record.pass_no}"
        try:
            payload = to_json(record)
        except (TypeError, ValueError) as error:
            raise BusError(f"{named} cannot be written for the wire: {error}") from error
        try:
            answer = json.loads(self._ask(self.wire.append, payload))
        except _Refused as refused:
            raise BusError(f"{named} is refused by Knowledge: {refused}") from None
        ack = Ack(answer["ack"])
        if ack in (Ack.GAP, Ack.CONFLICT):
            raise refusal(record, ack, answer["passes"])
        self._sent = max(self._sent, place(record))

    def run(self) -> int:
        """Deliver all that the log held at the call, and what is sent meanwhile by this bus; return how many.

        Raises
        ------
        BusError
            Knowledge does not answer, or what is missing has left the log's window. What a handler raises comes out
            too; the record counts as delivered.
        """
        if self._closed:
            return 0
        self._fetch()
        delivered = 0
        while True:
            while self._waiting:
                self._deliver()
                delivered += 1
            if self._closed or not self._lacks(self._sent):
                return delivered
            self._fetch()

    def run_until(self, condition: Callable[[], bool], timeout: float = 60.0) -> int:
        """Deliver records as they come until `condition` holds, and not one more; return how many.

        Raises
        ------
        BusError
            It does not hold after `timeout` seconds, or the bus is closed; and as in `run`.
        """
        deadline = time.monotonic() + timeout
        delivered = 0
        while not condition():
            if self._closed:
                raise BusError(f"the bus of {self.name} was closed before what it waits for had come")
            if self._waiting:
                self._deliver()
                delivered += 1
            elif (left := deadline - time.monotonic()) <= 0:
                raise BusError(
                    f"what {self.name} waits for did not come within {timeout:g} s; it has seen {self._seen()}. Is the "
                    "component that sends it running?"
                )
            elif not self._asked:
                self._fetch()
            else:
                self._receive(min(SILENCE, left))
        return delivered

    def close(self) -> None:
        """Leave; what still waits is dropped here, and kept by the log."""
        self._closed = True
        self._waiting.clear()
        self._session = None
        if self._leave is not None:
            self._leave()

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _declare(self, session: zenoh.Session, kind: type[Record]) -> None:
        if kind not in self._subscribers:
            # One queue for all kinds: a session receives in the order in which Knowledge published.
            hand_over = zenoh.handlers.Callback(self._arrived.put, indirect=False)
            self._subscribers[kind] = session.declare_subscriber(self.wire.stream(kind), hand_over)

    def _deliver(self) -> None:
        record = self._waiting.popleft()
        for handler in self._handlers[type(record)]:
            handler(record)

    def _receive(self, timeout: float) -> None:
        try:
            sample = self._arrived.get(timeout=timeout)
            known = place(from_json(sample.payload.to_bytes())) < self._next
        except (Empty, MalformedRecord):
            known = False
        if not known:
            self._fetch()

    def _take(self, at: int, record: Record) -> None:
        if at >= self._next:
            self._next = at + 1
            if type(record) in self._handlers:
                self._waiting.append(record)

    def _lacks(self, last: int) -> bool:
        # Whether a record that is subscribed to stands between what came and place `last`; stages repeat.
        places = range(self._next, min(last + 1, self._next + len(STAGES)))
        return any(STAGES[at_place(at)[1]] in self._handlers for at in places)

    def _seen(self) -> str:
        if self._next == 0:
            return "nothing of the log"
        number, stage = at_place(self._next - 1)
        return f"the log up to {STAGES[stage].__name__} {number}"

    def _fetch(self) -> None:
        self._asked = True
        while not self._arrived.empty():
            self._arrived.get_nowait()  # published before the question, so it comes with the answer
        while True:
            number, stage = at_place(self._next)
            try:
                answer = self._ask(f"{self.wire.since}?pass={number};stage={stage}", None)
            except _Refused as refused:
                raise BusError(f"{self.name} cannot catch up: {refused}") from None
            lines = answer.splitlines()
            for line in lines:
                record = from_json(line)
                self._take(place(record), record)
            if len(lines) < SINCE_LIMIT:
                break
        if self._lacks(self._sent):
            number, stage = at_place(self._sent)
            raise BusError(
                f"Knowledge acknowledged {STAGES[stage].__name__} {number} to {self.name}, and no longer has it. Was "
                "it started anew with an older log?"
            )

    def _ask(self, selector: str, payload: bytes | None) -> bytes:
        if self._session is None:
            raise BusError(f"the bus of {self.name} is {'closed' if self._closed else 'not connected; call connect()'}")
        deadline = time.monotonic() + self.patience
        pause = 0.005
        while True:
            # Nobody there, a hub that fell over the query, and one that is just restarting look the same: no reply.
            # To ask again is safe, as Knowledge takes a record once.
            outcome = "no reply"
            for reply in self._session.get(selector, payload=payload, timeout=ANSWER_WITHIN, **ORDERED):
                if reply.ok is not None:
                    answer: bytes = reply.ok.payload.to_bytes()
                    return answer
                if reply.err is not None:
                    outcome = reply.err.payload.to_string()
                if outcome != "Timeout":  # Zenoh's own word; everything else was said by the hub
                    raise _Refused(outcome)
            if time.monotonic() > deadline:
                raise BusError(
                    f"Knowledge on {self.wire.endpoint} did not answer within {self.patience:g} s ({outcome}). Is it "
                    "running, with the same system and loop?"
                )
            # No event tells that a queryable is there again; where one reply was lost, the first pause is short.
            time.sleep(pause)
            pause = min(2 * pause, 0.2)


class _Refused(Exception):
    # An answer that says no; to ask again would not change it.
    pass
