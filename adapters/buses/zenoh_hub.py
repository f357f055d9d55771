"""Knowledge's end of the wire: the meeting point of a loop's processes, and the only writer of the log."""

from __future__ import annotations

import json
import threading
import weakref
from collections.abc import Callable
from contextlib import ExitStack, suppress
from itertools import islice
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Self

import zenoh

from adapters.buses.wire import LARGEST_MESSAGE, ORDERED, STAGE_NAMES, Wire
from knowledge import (
    STAGES,
    Ack,
    ChangePlan,
    ChangeRequest,
    Log,
    Observation,
    Reading,
    Record,
    RowLayout,
    Symptom,
    from_json,
    to_json,
)
from mape.errors import ConfigError

SINCE_LIMIT = 512
"""Most records in one answer to `since`; a shorter answer reaches the end of the log."""

_Answer = Callable[[zenoh.Query], None]


class KnowledgeHub:
    """Appends what is sent to the log, publishes what it appended, and acknowledges; in this order.

    One worker thread answers all queries, one after the other, so what is published has the order of the log, and
    nothing is published that the log does not hold. `append` is answered with
    ``{"ack": "ok" | "duplicate" | "gap" | "conflict", "passes": finished passes}``, `since` with records, one a line;
    what cannot be answered gets an error reply that says why, and changes nothing.

    Parameters
    ----------
    log
        The loop's log. Between `connect` and `close` only the worker touches it; `log.passes` may be read.
    wire
        Where to listen.

    Raises
    ------
    ConfigError
        The wire is that of another loop.

    Examples
    --------
    >>> import tempfile
    >>> from adapters.buses import ZenohBus
    >>> log = Log(RowLayout(("return",), detectors=0, rates=1))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     wire = Wire(f"unixsock-stream/{folder}/k.sock", "example")
    ...     with KnowledgeHub(log, wire), ZenohBus(wire, "plan") as bus:
    ...         bus.subscribe(ChangePlan, lambda plan: print("epsilon", plan.epsilon))
    ...         bus.send(ChangePlan(0, 0, 0.5, (0.1,), (0, 1), (), (), False, None))
    ...         bus.run()
    epsilon 0.5
    1
    """

    def __init__(self, log: Log, wire: Wire) -> None:
        if log.loop != wire.loop:
            raise ConfigError(f"the log is that of loop {log.loop}, the wire that of loop {wire.loop}")
        self.log = log
        self.wire = wire
        self._fit = _Fit(log.layout)
        self._asked: SimpleQueue[tuple[_Answer, zenoh.Query] | None] = SimpleQueue()
        self._leave: Callable[..., object] | None = None
        self._worker: threading.Thread | None = None

    def connect(self) -> None:
        """Listen, and begin to answer.

        Raises
        ------
        BusError
            The endpoint is taken, or cannot be made.
        """
        if self._worker is not None:
            return
        with ExitStack() as opened:
            session = self.wire.listen()
            opened.callback(session.close)
            self._publishers = {
                kind: session.declare_publisher(
                    self.wire.stream(kind), encoding=zenoh.Encoding.APPLICATION_JSON, **ORDERED
                )
                for kind in STAGE_NAMES
            }
            # Daemonic, so that a hub that was never closed does not keep its process from ending.
            self._worker = worker = threading.Thread(target=self._work, name="knowledge", daemon=True)
            worker.start()
            opened.callback(self._finish, worker)
            for key, answer in ((self.wire.append, self._append), (self.wire.since, self._since)):
                queryable = session.declare_queryable(key, self._hand_over(answer), complete=True)
                opened.callback(queryable.undeclare)
            # Last: who sees the token finds everything else in place.
            token = session.liveliness().declare_token(self.wire.alive("knowledge", session))
            opened.callback(token.undeclare)
            # At the latest at the interpreter's exit: a Zenoh thread that then still calls Python aborts the process.
            self._leave = weakref.finalize(self, opened.pop_all().close)

    def close(self) -> None:
        """Answer what was asked, then leave; the log stays."""
        if self._leave is not None:
            self._leave()

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _finish(self, worker: threading.Thread) -> None:
        self._asked.put(None)
        worker.join()
        self._worker = None
        with suppress(Empty):
            while True:  # what came in between is dropped unanswered; its sender asks again
                if (left := self._asked.get_nowait()) is not None:
                    with left[1]:
                        pass

    def _hand_over(self, answer: _Answer) -> zenoh.handlers.Callback[zenoh.Query]:
        put = self._asked.put
        return zenoh.handlers.Callback(lambda query: put((answer, query)), indirect=False)

    def _work(self) -> None:
        while (asked := self._asked.get()) is not None:
            answer, query = asked
            with query:  # one that is not dropped lets its sender wait for the timeout
                try:
                    answer(query)
                except Exception as error:
                    # What is no fault of the query, such as a full disk under a listener of the log, is told as well;
                    # without a reply the sender would ask again.
                    said = str(error)
                    if not isinstance(error, (ValueError, LookupError)):
                        said = f"Knowledge failed with {type(error).__name__}: {error}"
                    with suppress(Exception):  # who asked may have gone; the others have not
                        query.reply_err(said)

    def _append(self, query: zenoh.Query) -> None:
        payload = query.payload
        if payload is None:
            raise ValueError("a query to append carries a record as its payload; this one carries nothing")
        if len(payload) > LARGEST_MESSAGE:
            raise ValueError(f"a message of {len(payload)} bytes; a record has at most {LARGEST_MESSAGE}")
        record = from_json(payload.to_bytes())
        self._fit.check(record)
        ack = self.log.append(record)
        if ack is Ack.OK:
            self._publishers[type(record)].put(to_json(record))
        query.reply(self.wire.append, json.dumps({"ack": ack.value, "passes": self.log.passes}))

    def _since(self, query: zenoh.Query) -> None:
        number, stage = (_whole(query, name) for name in ("pass", "stage"))
        if stage >= len(STAGES):
            raise ValueError(f"stage is {stage}; the stages of a pass are numbered from 0 to {len(STAGES) - 1}")
        records = islice(self.log.since(number, stage), SINCE_LIMIT)
        query.reply(self.wire.since, b"\n".join(to_json(record) for record in records))


def _whole(query: zenoh.Query, name: str) -> int:
    text = query.parameters.get(name)
    if text is None or not (text.isascii() and text.isdigit() and len(text) <= 18):
        raise ValueError(f"{name} is {text!r}; ask since?pass=N;stage=N with whole numbers")
    return int(text)


class _Fit:
    # A log packs a pass when its plan comes. By then the record that does not fit would be acknowledged, published and
    # irreplaceable, and every plan would be refused in its stead; so each is packed by itself, into a blank pass,
    # before it is appended.

    def __init__(self, layout: RowLayout) -> None:
        self._layout = RowLayout(layout.signals, layout.detectors, layout.rates, layout.max_actions)
        self._row = bytearray(layout.struct.size)
        signals = dict.fromkeys(layout.signals, 0.0)
        quiet = (Reading("", 0.0, None, False, "unknown"),) * layout.detectors
        self._blank: tuple[Record, ...] = (
            Observation(0, 0, 0, 0.0, False, 0, (), (), signals),
            Symptom(0, 0, signals, (), (), quiet),
            ChangeRequest(0, 0, (), (), (), signals),
            ChangePlan(0, 0, 0.0, (0.0,) * layout.rates, (), (), (), False, None),
        )

    def check(self, record: Record) -> None:
        named = f"{type(record).__name__} {record.pass_no}"
        if isinstance(record, Observation) and tuple(record.signals) != self._layout.signals:
            raise ValueError(
                f"{named} has signals {', '.join(record.signals) or 'none'}; the run's are, in this order, "
                f"{', '.join(self._layout.signals)}"
            )
        stage = STAGES.index(type(record))
        rows = (*self._blank[:stage], record, *self._blank[stage + 1 :])
        try:
            self._layout.pack_into(self._row, 0, *rows)  # type: ignore[arg-type]
        except ValueError as error:
            raise ValueError(f"{named} does not fit the run's layout: {error}") from error
