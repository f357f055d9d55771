"""The in-process bus: first in, first out, run to completion."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from knowledge import STAGES, Ack, Log, Record
from mape.errors import BusError

_OK = Ack.OK


class LocalBus:
    """Appends each record to the log and delivers it within the process, as the object that it is.

    A record sent from within a handler waits its turn: there is no recursion, and the order is that of the log.

    Parameters
    ----------
    log
        The log that says what is next.
    """

    def __init__(self, log: Log) -> None:
        self._log = log
        self._handlers: dict[type, list[Callable[[Any], object]]] = {kind: [] for kind in STAGES}
        self._waiting: deque[Record] = deque()
        self._append: Callable[[Record], Ack] = log.append
        self._put = self._waiting.append

    def subscribe(self, kind: type[Record], handler: Callable[[Any], object]) -> None:
        """Deliver every record of `kind` to `handler`, after those that subscribed before."""
        self._handlers[kind].append(handler)

    @property
    def subscriptions(self) -> int:
        """Number of handlers, of all kinds."""
        return sum(map(len, self._handlers.values()))

    def send(self, record: Record) -> None:
        """Append `record` and queue it; what is there already is not delivered again.

        Raises
        ------
        BusError
            Records before it are missing, another record has its place, or it does not fit the run's layout.
        """
        try:
            ack = self._append(record)
        except ValueError as error:
            raise BusError(f"{type(record).__name__} {record.pass_no} is refused: {error}") from error
        if ack is _OK:
            self._put(record)
        elif ack is not Ack.DUPLICATE:
            raise refusal(record, ack, self._log.passes)

    def deliver(self) -> Record | None:
        """Deliver the oldest waiting record and return it, or return None where none waits."""
        if not self._waiting:
            return None
        record = self._waiting.popleft()
        for handler in self._handlers[type(record)]:
            handler(record)
        return record

    def run(self) -> int:
        """Deliver until nothing waits; return the number of records delivered."""
        waiting, handlers, delivered = self._waiting, self._handlers, 0
        take = waiting.popleft
        while waiting:
            record = take()
            for handler in handlers[type(record)]:
                handler(record)
            delivered += 1
        return delivered

    def close(self) -> None:
        """Drop what still waits and all handlers, and take nothing more; the log keeps what it has."""
        self._waiting.clear()
        for handlers in self._handlers.values():
            handlers.clear()
        self._append = _closed


def refusal(record: Record, ack: Ack, passes: int) -> BusError:
    """Say why the log, which holds `passes` finished passes, did not take a record."""
    return BusError(
        f"{type(record).__name__} {record.pass_no} is refused as a {ack.value}: the log holds {passes} finished "
        "passes. Each stage sends one record per pass, in order, and hands on the signals and action sets that it was "
        "given."
    )


def _closed(record: Record) -> Ack:
    raise BusError(f"{type(record).__name__} {record.pass_no} was sent on a closed bus")
