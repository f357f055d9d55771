"""The sequenced log of one loop: every record of every pass, in order, once."""

from __future__ import annotations

import enum
import hashlib
import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from knowledge.records import STAGES, ChangePlan, ChangeRequest, Observation, Record, Symptom
from knowledge.rows import RowLayout

_new = tuple.__new__

SEGMENT = 512
"""Rows that are packed before they are hashed and handed on together."""

WINDOW = 256
"""Number of finished passes that stay readable."""


class Ack(enum.Enum):
    """What became of a record that was sent to the log."""

    OK = "ok"
    DUPLICATE = "duplicate"
    GAP = "gap"
    CONFLICT = "conflict"


_OK = Ack.OK  # an enum's member costs a call to look up
_PASS_NUMBER = struct.Struct("<q")  # a row begins with it


class Pass(NamedTuple):
    """The four records of a finished pass."""

    observation: Observation
    symptom: Symptom
    request: ChangeRequest
    plan: ChangePlan


class Log:
    """Append-only log of one loop, idempotent by (stage, pass), with a running hash.

    `append` answers

    - ``OK``: the record was the next one, and is now part of the log;
    - ``DUPLICATE``: it was there already. A record older than the window is answered so without a comparison;
    - ``GAP``: records before it are missing; nothing was changed;
    - ``CONFLICT``: another record has its place, or it hands on other signals or action sets than it was given;
      nothing was changed.

    Parameters
    ----------
    layout
        Layout of the run's rows.
    loop
        Number of the loop whose records are taken.
    window
        Number of finished passes that stay readable.

    Examples
    --------
    >>> log = Log(RowLayout(("return",), detectors=0, rates=1))
    >>> log.append(ChangePlan(0, 0, 1.0, (0.1,), (0, 1), (), (), False, None))
    <Ack.OK: 'ok'>
    >>> log.append(ChangePlan(0, 3, 1.0, (0.1,), (), (), (), False, None))
    <Ack.GAP: 'gap'>
    """

    def __init__(self, layout: RowLayout, loop: int = 0, window: int = WINDOW) -> None:
        self.layout = layout
        self.loop = loop
        self.passes = 0  # finished passes
        self._window: deque[Pass] = deque(maxlen=window)
        self._unread: deque[Sequence[Pass]] = deque()  # newer than these, and not looked at yet
        self._unread_passes = 0  # how many they are in all
        self._start: ChangePlan | None = None
        self._open: list[Any] = []  # the records of the pass that is being logged
        self._number = -1  # the pass whose record is expected next; none before plan 0
        self._expected: type[Record] | None = None  # nothing is in order before plan 0
        self._row_size = layout.struct.size
        self._buffer = bytearray(layout.struct.size * SEGMENT)
        self._filled = 0  # bytes of the buffer in use
        self._gone = 0  # bytes that have left it
        self._flushed_row = b""  # the newest row that has left the buffer; plan 0's before there was one
        self._hash = hashlib.sha256(layout.schema)
        self._listeners: list[_Listener] = []

    def on_rows(self, listener: Callable[[npt.NDArray[np.void]], object]) -> None:
        """Hand each segment of rows that are finished from now on to `listener`.

        It gets a structured array of its own, read-only, which may be kept. What it raises comes out of the `append`
        that begins the next pass, of `room`, or of `flush`; then the record was not taken, and the segment is offered
        again.
        """
        self._listeners.append(_Listener(listener, self._gone + self._filled))

    def append(self, record: Record) -> Ack:
        """Take `record` if it is the next one; see the class for the answers.

        Raises
        ------
        ValueError
            The record does not fit the run's layout.
        """
        kind = type(record)
        if kind is not self._expected or record[1] != self._number or record[0] != self.loop:
            return self._unexpected(record)
        if kind is ChangePlan:
            self._finish(record)
            return _OK
        if kind is Observation:
            if self._filled == len(self._buffer):
                self._flush()  # before the record is taken: a listener that fails costs no row and no record
            self._open = [record]
            self._expected = Symptom
            return _OK
        # A stage hands on what it was given; within a process these are the very objects, so identity comes first.
        seen: Any = self._open[0]
        signals = record[2] if kind is Symptom else record[5]
        if signals is not seen[8] and signals != seen[8]:
            return Ack.CONFLICT
        if kind is Symptom:
            if (record[3] is not seen[6] and record[3] != seen[6]) or (
                record[4] is not seen[7] and record[4] != seen[7]
            ):
                return Ack.CONFLICT
            self._expected = ChangeRequest
        else:
            self._expected = ChangePlan
        self._open.append(record)
        return _OK

    def _finish(self, plan: Any) -> None:
        seen, symptom, request = self._open
        self.layout.pack_into(self._buffer, self._filled, seen, symptom, request, plan)
        self._filled += self._row_size
        passed = _new(Pass, (seen, symptom, request, plan))
        if self._unread:
            self._put_off((passed,))
        else:
            self._window.append(passed)
        self._open = []
        self._expected = Observation
        self.passes = self._number
        self._number += 1

    def _unexpected(self, record: Record) -> Ack:
        if record.loop != self.loop:
            raise ValueError(f"a record of loop {record.loop} was sent to the log of loop {self.loop}")
        number = record.pass_no
        if number == 0 and isinstance(record, ChangePlan):
            if self._start is not None:
                return Ack.DUPLICATE if record == self._start else Ack.CONFLICT
            self._flushed_row = self.layout.pack_start(record)
            self._hash.update(self._flushed_row)
            self._start = record
            self._number, self._expected = 1, Observation
            return _OK
        if number < 1:
            raise ValueError(f"{type(record).__name__} {number}: passes are counted from 1; only plan 0 comes before")
        there = self.find(type(record), number)
        if there is not None:
            return Ack.DUPLICATE if there == record else Ack.CONFLICT
        return Ack.DUPLICATE if number <= self.passes else Ack.GAP

    def room(self) -> int:
        """Return how many passes can be finished before the listeners hear of them; if none, let them hear first."""
        if self._filled == len(self._buffer):
            self._flush()
        return (len(self._buffer) - self._filled) // self._row_size

    def extend(self, rows: npt.NDArray[np.void], read: Callable[[Any], Pass]) -> None:
        """Take finished passes as the rows that their records would be packed into.

        Parameters
        ----------
        rows
            Rows of the passes that come next, as many as there is `room` for; they are the log's from now on.
        read
            Turns one of them into the records of its pass; asked when somebody looks at them.

        Raises
        ------
        ValueError
            They are not of the log's layout, or not the passes that come next, or too many.
        """
        in_order = np.arange(self._number, self._number + len(rows))
        if self._expected is not Observation or rows.dtype != self.layout.dtype or (rows["pass"] != in_order).any():
            raise ValueError(f"rows of other passes than {self._number} and those after it were sent to the log")
        end = self._filled + rows.nbytes
        if end > len(self._buffer):
            room = (len(self._buffer) - self._filled) // self._row_size
            raise ValueError(f"{len(rows)} rows were sent to a log that has room for {room}")
        self._buffer[self._filled : end] = rows.tobytes()
        self._filled = end
        self.passes += len(rows)
        self._number += len(rows)
        self._put_off(_Unread(rows, read))

    def _put_off(self, passed: Sequence[Pass]) -> None:
        """Keep passes until somebody looks at them, or they have left the window."""
        self._unread.append(passed)
        self._unread_passes += len(passed)
        window = self._window.maxlen or 0
        while self._unread and self._unread_passes - len(self._unread[0]) >= window:
            self._unread_passes -= len(self._unread.popleft())

    @property
    def window(self) -> deque[Pass]:
        """The newest finished passes, oldest first; it moves on with the log, ``list(log.window)`` stays."""
        while self._unread:
            self._window.extend(self._unread.popleft())
        self._unread_passes = 0
        return self._window

    @property
    def started(self) -> bool:
        """Whether plan 0 is there."""
        return self._start is not None

    @property
    def open_records(self) -> tuple[Record, ...]:
        """The records of the pass that is being logged, in order."""
        return tuple(self._open)

    def find(self, kind: type[Record], number: int) -> Record | None:
        """Return the record of that kind and pass, or None where it has not come yet or has left the window."""
        if number == 0:
            return self._start if kind is ChangePlan else None
        stage = STAGES.index(kind)
        if number == self.passes + 1:
            return self._open[stage] if stage < len(self._open) else None
        back = self.passes - number
        return self.window[-1 - back][stage] if 0 <= back < len(self.window) else None

    def since(self, number: int, stage: int = 0) -> Iterator[Record]:
        """Yield what is readable from record (`number`, `stage`) on, in order.

        Raises
        ------
        LookupError
            That record has left the window.
        """
        if number == 0:
            if self._start is not None:
                yield self._start
            number, stage = 1, 0
        oldest = self.passes - len(self.window) + 1
        if number < oldest:
            raise LookupError(f"pass {number} has left the window; the oldest pass in memory is {oldest}")
        for at in range(number, self.passes + 1):
            yield from self.window[at - oldest][stage if at == number else 0 :]
        if number <= self.passes + 1:
            yield from self._open[stage if number > self.passes else 0 :]

    def flush(self) -> None:
        """Hand the rows of all finished passes to the listeners."""
        if self._filled:
            self._flush()

    def last_row(self) -> bytes:
        """Return the packed row of the newest finished pass; plan 0's after plan 0.

        Raises
        ------
        LookupError
            Not even plan 0 is there.
        """
        if self._start is None:
            raise LookupError("the log has no row yet; plan 0 makes the first")
        if self._filled:
            return bytes(self._buffer[self._filled - self._row_size : self._filled])
        return self._flushed_row

    def restore(
        self,
        start: ChangePlan | None,
        rows: Iterable[bytes],
        passes: Sequence[Pass],
        open_records: Sequence[Record],
    ) -> None:
        """Bring a fresh log to the state in which another one was: its hash, its window, the record expected next.

        Listeners hear of the rows that are finished from then on.

        Parameters
        ----------
        start
            Plan 0, or None if not even that had come.
        rows
            The packed row of each finished pass, from pass 1 on, in order; what `last_row` gave after each pass.
        passes
            The newest finished passes, the last one included. None of them, and the log hashes on but remembers no
            record.
        open_records
            The records of the pass after the last finished one, in order.

        Raises
        ------
        ValueError
            The log is not fresh, or what is given is no run: a row that is out of order, a pass whose row is another
            one, a record that does not come next. The log is then spoilt, and another one is to be made.
        """
        if self._start is not None:
            raise ValueError(f"a log of {self.passes} passes cannot be restored into; make a fresh one")
        listeners, self._listeners = self._listeners, []
        if start is not None:
            self._take(start)
        newest: deque[bytes] = deque()
        for number, row in enumerate(rows, 1):
            if start is None or len(row) != self._row_size or _PASS_NUMBER.unpack_from(row) != (number,):
                raise ValueError(f"row {number} of the restored log is not the packed row of pass {number}")
            newest.append(row)
            if len(newest) > len(passes):  # the rows of `passes` are packed again, and compared
                self._flushed_row = newest.popleft()
                self._hash.update(self._flushed_row)
                self.passes, self._number = number - len(passes), number - len(passes) + 1
        if len(newest) < len(passes):
            raise ValueError(f"{len(passes)} finished passes were given with the rows of {len(newest)}")
        for finished, row in zip(passes, newest, strict=True):
            for record in finished:
                self._take(record)
            if self.last_row() != row:
                raise ValueError(f"the records of pass {self.passes} do not give its row")
        for record in open_records:
            self._take(record)
        self.flush()
        for listener in listeners:
            listener.told = self._gone
        self._listeners = listeners

    def _take(self, record: Record) -> None:
        answer = self.append(record)
        if answer is not _OK:
            raise ValueError(
                f"{type(record).__name__} {record.pass_no} does not come next in the restored log: {answer.value}"
            )

    def sha256(self) -> str:
        """Hash the layout, plan 0 and all finished passes, as 64 hexadecimal digits."""
        digest = self._hash.copy()
        digest.update(memoryview(self._buffer)[: self._filled])
        return digest.hexdigest()

    def _flush(self) -> None:
        # A copy, as the buffer is filled anew: listeners may keep what they hear.
        rows = bytes(memoryview(self._buffer)[: self._filled])
        end = self._gone + self._filled
        for listener in self._listeners:
            if listener.told < end:
                listener.hear(np.frombuffer(rows, self.layout.dtype)[(listener.told - self._gone) // self._row_size :])
                listener.told = end
        digest = self._hash.copy()
        digest.update(rows)
        newest = rows[-self._row_size :]
        # At once, with no call between them: after a Ctrl-C the rows are all hashed, or all in the buffer.
        self._hash, self._flushed_row, self._gone, self._filled = digest, newest, end, 0


class _Unread(Sequence[Pass]):
    # Passes as rows, read when they are looked at.
    def __init__(self, rows: npt.NDArray[np.void], read: Callable[[Any], Pass]) -> None:
        self._rows = rows
        self._read = read

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, at: Any) -> Any:
        return self._read(self._rows[at])


class _Listener:
    # How many bytes of rows, of all so far, a listener was told: if another one fails, nothing is told twice.
    def __init__(self, hear: Callable[[npt.NDArray[np.void]], object], told: int) -> None:
        self.hear = hear
        self.told = told
