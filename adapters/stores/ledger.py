"""The sequenced logs of a run over its store: what is taken, what is refused, what is there after a restart."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

from adapters.stores.sqlite_store import Snapshot, Store, Swap
from knowledge import (
    STAGES,
    Ack,
    ChangePlan,
    ChangeRequest,
    FreeLog,
    Log,
    MalformedRecord,
    Observation,
    Pass,
    Reading,
    Record,
    RowLayout,
    Symptom,
    from_json,
)
from mape.errors import BusError, ResultsError
from mape.states import told

WINDOW = 1
"""Finished passes of each loop that stay in memory; what is older is read from the store."""

EVENTS_KEPT = 1000
"""Events of one kind that are noted one by one, since Knowledge's start; after that they are only counted."""


class Conflict(BusError):
    """Another record has this one's place in the log."""


class Taken(NamedTuple):
    """What became of a record, and the number of the last one of its stage that the log holds."""

    ack: Ack
    last: int


class Ledger:
    """The logs of all loops of a run, appended to one record at a time, and written together at `commit`.

    A record is taken as the bytes that were sent: whoever sends it again, after a crash, is answered by comparing
    bytes, however old it is.

    Parameters
    ----------
    store
        What outlives the process. One that holds a run already is gone on with.
    units
        Number of loops.
    episodes
        Passes of each loop.
    free
        Whether the managed systems run freely; else the loops are in lockstep, and their logs have a hash.

    Raises
    ------
    ResultsError
        What the store holds is no whole log.
    """

    def __init__(self, store: Store, units: int, episodes: int, *, free: bool = False) -> None:
        self.store = store
        self.units = units
        self.episodes = episodes
        self.free = free
        self.layout: RowLayout | None = None
        self.refused = 0
        self._noted: Counter[str] = Counter()
        self._epochs: dict[str, int] = {}
        self._logs: list[Log | FreeLog] = []
        self._fit: Fit | None = None
        self._final: set[int] = set()
        facts = store.facts()
        if "layout" in facts:
            self._restore(facts["layout"])

    # Who is there.

    def begin(self, layout: Mapping[str, Any]) -> None:
        """Fix what the rows of the run hold; from then on records are taken.

        Raises
        ------
        BusError
            The run has another layout already.
        """
        if self.layout is not None:
            if self.store.facts()["layout"] != layout:
                raise BusError(
                    f"the run has the layout {self.store.facts()['layout']}, and this Execute has {dict(layout)}: its "
                    "managed system is another one"
                )
            return
        self._restore(layout)
        self.store.set_facts(layout=dict(layout))

    def join(self, role: str) -> int:
        """Count that `role` joins, and return its epoch; older ones are refused from then on."""
        self._epochs[role] = self.store.join(role)
        return self._epochs[role]

    def epoch(self, role: str) -> int:
        """Return the newest epoch of `role`, 0 where it never joined."""
        if role not in self._epochs:
            self._epochs[role] = self.store.epoch(role)
        return self._epochs[role]

    def last(self, loop: int) -> tuple[int, int, int, int]:
        """Return the number of the last record of each stage: -1 where there is no plan 0."""
        log = self._logs[loop] if self._logs else None
        if log is None:
            return 0, 0, 0, -1
        if isinstance(log, FreeLog):
            seen, symptom, request, plan = (log.last(kind) for kind in STAGES)
            return seen, symptom, request, plan
        done, begun = log.passes, len(log.open_records)
        return done + (begun > 0), done + (begun > 1), done + (begun > 2), done if log.started else -1

    # Records.

    def take(self, loop: int, stage: int, data: bytes) -> Taken:
        """Take a record if it is the next one of its loop and stage.

        Raises
        ------
        MalformedRecord, ValueError
            It is no record, one of another stage or loop, or does not fit the run's layout. Nothing was changed.
        Conflict
            Another record has its place. Nothing was changed.
        """
        record = from_json(data)
        kind = STAGES[stage]
        if type(record) is not kind:
            raise MalformedRecord(f"a {type(record).__name__} came where only a {kind.__name__} is taken")
        if record.loop != loop:
            raise MalformedRecord(f"{kind.__name__} of loop {record.loop} came under the key of loop {loop}")
        log = self._log(loop)
        number = record.pass_no
        assert self._fit is not None
        self._fit.check(record)
        last = self.last(loop)[stage]
        if (number > 0 or kind is ChangePlan) and 0 <= number <= last:
            self._compare(loop, stage, record, data)
            return Taken(Ack.DUPLICATE, last)
        ack = log.append(record)
        if ack is Ack.CONFLICT:
            raise Conflict(
                f"{kind.__name__} {number} is refused: it hands on other signals or action sets than its pass was "
                "given, or stands for an episode that was dropped"
            )
        if ack is Ack.OK:
            row = log.last_row() if kind is ChangePlan and isinstance(log, Log) else None
            self.store.append(loop, number, stage, data.decode(), row)
            last = number
        return Taken(ack, last)

    def drop(self, loop: int, first: int, last: int) -> Taken:
        """Note that a free-running loop's episodes `first` to `last` could not be logged.

        Raises
        ------
        MalformedRecord
            The loops are in lockstep, where nothing is dropped.
        """
        log = self._log(loop)
        if not isinstance(log, FreeLog):
            raise MalformedRecord("nothing is dropped in lockstep")
        ack = log.drop(first, last)
        if ack is Ack.OK:
            self.store.drop(loop, first, last)
        elif ack is Ack.CONFLICT:
            raise Conflict(f"episodes {first} to {last} were not all dropped: some are in the log")
        return Taken(ack, self.last(loop)[0])

    def since(self, loop: int, stages: Mapping[int, int], limit: int) -> list[str]:
        """Return the records of the stages named, each from its pass on, in the order of the log."""
        self._log(loop)
        return [body for _, _, body in self.store.since(loop, stages, limit)]

    def sha256(self, loop: int) -> str | None:
        """Return the hash of a loop's log; None where it runs freely."""
        log = self._logs[loop]
        return log.sha256() if isinstance(log, Log) else None

    # States.

    def keep(self, role: str, snapshot: Snapshot, stage: int) -> Taken:
        """Keep a role's state, if the log holds the record after which it was."""
        last = self.last(snapshot.loop)[stage]
        final = snapshot.final and role == "execute"
        if final and snapshot.pass_no != self.episodes:
            raise MalformedRecord(f"a state of pass {snapshot.pass_no} is not the last one of {self.episodes} passes")
        if snapshot.pass_no > (self.last(snapshot.loop)[3] if final else last):
            return Taken(Ack.GAP, last)
        self.store.keep_snapshot(snapshot)
        if final:
            self._final.add(snapshot.loop)
        return Taken(Ack.OK, last)

    def swapped(self, swap: Swap) -> None:
        """Keep that a part was replaced, for the role's next start and for a replay."""
        self._log(swap.loop)
        self.store.keep_swap(swap)

    def note(self, role: str, kind: str, text: str, loop: int | None = None, number: int | None = None) -> None:
        """Note what happened beside the records: of each kind the first thousand, and the number of all refusals.

        What is of no single loop is noted with the newest pass that was driven by then.
        """
        self.refused += kind == "refused"
        self._noted[kind] += 1
        if self._noted[kind] > EVENTS_KEPT:
            return
        if loop is None:
            number = max((self.last(unit)[0] for unit in range(self.units)), default=0)
        self.store.event(role, kind, text, loop, number)

    def ended(self, loop: int) -> bool:
        """Whether a loop has all its passes, and its Q-table at the end."""
        return loop in self._final

    @property
    def complete(self) -> bool:
        """Whether every loop has all its passes, and its Q-table at the end."""
        return bool(self._logs) and len(self._final) == self.units

    def commit(self) -> None:
        """Write what was taken since the last commit.

        Raises
        ------
        ResultsError
            It could not be written. The logs in memory are then ahead of the store: make another ledger.
        """
        self.store.commit()

    def _log(self, loop: int) -> Log | FreeLog:
        if not self._logs:
            raise ValueError("the run has not begun: no Execute has told yet what its system's signals are")
        if not 0 <= loop < self.units:
            raise ValueError(f"loop {loop}; this run has loops 0 to {self.units - 1}")
        return self._logs[loop]

    def _compare(self, loop: int, stage: int, record: Record, data: bytes) -> None:
        there = self.store.body(loop, record.pass_no, stage)
        if there == data.decode():
            return
        named = f"{type(record).__name__} {record.pass_no} of loop {loop}"
        if there is None:
            raise Conflict(f"{named} was dropped from the log, and is sent now")
        way_out = ""
        if isinstance(record, Observation):
            way_out = (
                ". Does the managed system carry something from one episode to the next? Then give it get_state and "
                "set_state, or set system.redrivable = false"
            )
        raise Conflict(f"{named} differs from the one in the log{differences(there, data.decode())}{way_out}")

    def _restore(self, facts: Mapping[str, Any]) -> None:
        self.layout = layout = layout_from(facts)
        self._fit = Fit(layout)
        try:
            self._logs = [self._restored(loop, layout) for loop in range(self.units)]
        except (ValueError, LookupError, TypeError) as error:
            raise ResultsError(f"{self.store.path} holds no whole log: {error}") from error
        for loop in range(self.units):
            found = self.store.snapshot(loop, "execute")
            if found is not None and found.final:
                self._final.add(loop)

    def _restored(self, loop: int, layout: RowLayout) -> Log | FreeLog:
        last = self.store.last(loop)
        if self.free:
            dropped = self.store.dropped(loop)
            seen = max([last[0], *(interval[1] for interval in dropped)])
            return FreeLog.restore(loop, (seen, *last[1:]), dropped)
        log = Log(layout, loop, WINDOW)
        if last[3] < 0:
            return log
        done = last[3]
        first = max(1, done - WINDOW + 1)
        found = self.store.since(loop, dict.fromkeys(range(4), first), 4 * (WINDOW + 2))
        records = [from_json(body) for _, _, body in found]
        finished = 4 * (done - first + 1)
        passes = [Pass(*records[at : at + 4]) for at in range(0, finished, 4)]  # type: ignore[arg-type]
        start = from_json(str(self.store.body(loop, 0, 3)))
        assert isinstance(start, ChangePlan)
        rows = self.store.rows(loop)
        next(rows)  # plan 0's
        log.restore(start, rows, passes, records[finished:])
        if self.store.count(loop) != 1 + sum(last):
            raise ValueError(f"loop {loop} lacks records before its last ones")
        return log


def layout_from(facts: Mapping[str, Any]) -> RowLayout:
    """Make the layout that a role told Knowledge.

    Raises
    ------
    ResultsError
        These are no facts of a layout, as in a damaged log.
    """
    try:
        return RowLayout(tuple(facts["signals"]), facts["detectors"], facts["rates"], facts["max_actions"])
    except (LookupError, TypeError, ValueError) as error:
        raise ResultsError(f"the layout of the run's rows, {facts!r}, is damaged: {told(error)}") from error


def differences(there: str, given: str) -> str:
    """Say where two records differ, field by field.

    >>> differences('{"steps": 3, "plan": 1}', '{"steps": 4, "plan": 1}')
    ': steps is 3 there, and 4 here'
    """
    first, second = json.loads(there), json.loads(given)
    found = [
        f"{name} is {json.dumps(first.get(name))} there, and {json.dumps(second.get(name))} here"
        for name in {**first, **second}
        if first.get(name) != second.get(name)
    ]
    return f": {'; '.join(found)}" if found else " in the way it is written"


class Fit:
    """What a record has to be to stand in the rows of a run.

    Parameters
    ----------
    layout
        Of the run's rows.
    """

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
        """Look whether a record fits.

        Raises
        ------
        ValueError
            It does not.
        """
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
