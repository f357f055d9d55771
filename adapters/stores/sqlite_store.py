"""Durable Knowledge: one SQLite file (WAL) per run, which any SQLite tool can open.

Schema, version 2 (``PRAGMA user_version``); times are seconds since 1970, in UTC:

=============  ==========================================================================================
table          holds
=============  ==========================================================================================
``run``        facts of the run by name, as JSON: config, versions, layout, seal; and begun, the
               last episode that each loop began, of systems that cannot be driven again
``records``    the log: one row per record. ``stage`` is 0 Observation, 1 Symptom, 2 ChangeRequest,
               3 ChangePlan; ``body`` the record as JSON, byte for byte as it was sent; ``row``, with a
               ChangePlan of a lockstep run, the packed pass of which the log's hash is taken
``dropped``    of free-running loops: the episodes that were driven and could not be logged
``snapshots``  the newest states of each role, from which it goes on after a crash: JSON, and the hash of
               a Q-table; ``final`` marks the one at the end of the run
``q_tables``   Q-tables: ids of the rows as JSON, number of states, and the values, row-major little-endian
               float64. Their ``sha256`` is of shape and ids, each a little-endian int64, and then the values:
               of ``struct.pack(f"<{2 + rows}q", rows, states, *ids) + body``
``versions``   which Q-table was the one at the end of an episode, where a planner asked for it
``swaps``      parts that were replaced, the first pass that the new one served, whether it took over the old
               one's state, and whether the config had planned it
``roles``      how often each role has joined: its newest epoch
``events``     what happened beside the records: who joined, what was refused or aborted; where ``loop`` is
               NULL, ``pass`` is the newest one that had been driven in any loop
``seal``       the run's name for itself, the number of commits, and the total of all rows' sums
=============  ==========================================================================================

The last column ``sum`` of each table holds the checksum of the row, see `adapters.stores.sums`. The records of a
loop and stage hang together as a chain: each one's sum is over the one before it too.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from adapters.stores.database import Database, Form
from adapters.stores.sums import record_sum, toggled
from knowledge import STAGES, QTable
from knowledge.q_table import SCHEMA as TABLE_SCHEMA

VERSION = 2
APPLICATION = 0x4D50454B  # "MPEK"

SCHEMA = """
CREATE TABLE run (name TEXT PRIMARY KEY, value TEXT NOT NULL, sum BLOB NOT NULL);
CREATE TABLE records (
    loop INTEGER, pass INTEGER, stage INTEGER, body TEXT NOT NULL, row BLOB, sum BLOB NOT NULL,
    PRIMARY KEY (loop, pass, stage)
) WITHOUT ROWID;
CREATE TABLE dropped (
    loop INTEGER, first INTEGER, last INTEGER NOT NULL, sum BLOB NOT NULL, PRIMARY KEY (loop, first)
) WITHOUT ROWID;
CREATE TABLE snapshots (
    loop INTEGER, role TEXT, pass INTEGER, final INTEGER NOT NULL, state TEXT NOT NULL, q_table TEXT, sum BLOB NOT NULL,
    PRIMARY KEY (loop, role, pass)
) WITHOUT ROWID;
CREATE TABLE q_tables (
    sha256 TEXT PRIMARY KEY, actions TEXT NOT NULL, states INTEGER NOT NULL, body BLOB NOT NULL,
    remembered INTEGER NOT NULL, sum BLOB NOT NULL
);
CREATE TABLE versions (
    loop INTEGER, pass INTEGER, q_table TEXT NOT NULL, sum BLOB NOT NULL, PRIMARY KEY (loop, pass)
) WITHOUT ROWID;
CREATE TABLE swaps (
    loop INTEGER, pass INTEGER, part TEXT, spec TEXT NOT NULL, handed_over INTEGER NOT NULL, planned INTEGER NOT NULL,
    sum BLOB NOT NULL, PRIMARY KEY (loop, pass, part)
) WITHOUT ROWID;
CREATE TABLE roles (role TEXT PRIMARY KEY, epoch INTEGER NOT NULL, sum BLOB NOT NULL);
CREATE TABLE events (
    number INTEGER PRIMARY KEY, time REAL NOT NULL, role TEXT NOT NULL, kind TEXT NOT NULL, loop INTEGER, pass INTEGER,
    text TEXT NOT NULL, sum BLOB NOT NULL
);
CREATE TABLE seal (
    one INTEGER PRIMARY KEY, run TEXT NOT NULL, commits INTEGER NOT NULL, total BLOB NOT NULL, sum BLOB NOT NULL
);
"""

COLUMNS = {
    "run": ("name", "value"),
    "records": ("loop", "pass", "stage", "body", "row"),
    "dropped": ("loop", "first", "last"),
    "snapshots": ("loop", "role", "pass", "final", "state", "q_table"),
    "q_tables": ("sha256", "actions", "states", "body", "remembered"),
    "versions": ("loop", "pass", "q_table"),
    "swaps": ("loop", "pass", "part", "spec", "handed_over", "planned"),
    "roles": ("role", "epoch"),
    "events": ("number", "time", "role", "kind", "loop", "pass", "text"),
}

KEYS = {
    "run": 1, "records": 3, "dropped": 2, "snapshots": 3, "q_tables": 1, "versions": 2, "swaps": 3, "roles": 1,
    "events": 1,
}  # fmt: skip

READERS = {1: "0.2.0.dev0"}
"""Which mapek reads a file of an older version."""

SNAPSHOTS_KEPT = 1


class Snapshot(NamedTuple):
    """State of a role after the record of pass `pass_no` that it sent."""

    loop: int
    role: str
    pass_no: int
    state: Any
    table: QTable | None
    final: bool = False


class Swap(NamedTuple):
    """A part that was replaced; `spec` is its name and options, `planned` whether the config has it."""

    loop: int
    pass_no: int
    part: str
    spec: dict[str, Any]
    handed_over: bool
    planned: bool


class Event(NamedTuple):
    """Something that happened beside the records."""

    number: int
    time: float
    role: str
    kind: str
    loop: int | None
    pass_no: int | None
    text: str


class Store(Database):
    """One run's file. All that is written waits for `commit`; how it is opened stands at `Database`."""

    form = Form(APPLICATION, VERSION, SCHEMA, COLUMNS, KEYS, READERS)

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self._heads: dict[tuple[int, int], bytes] = {}  # the sum of the last record of a loop and stage
        super().__init__(*arguments, **options)

    def roll_back(self) -> None:
        """Forget everything since the last commit."""
        self._heads.clear()
        super().roll_back()

    # Facts of the run.

    def facts(self) -> dict[str, Any]:
        """Return the facts of the run; empty where it has not begun."""
        return {name: self._json(value, f"the {name} in value of run") for name, value in self._rows("run")}

    def set_facts(self, **facts: Any) -> None:
        """Write facts of the run."""
        for name, value in facts.items():
            self._put("run", name, json.dumps(value))

    def join(self, role: str) -> int:
        """Count that `role` joins; return its epoch, from 1."""
        epoch = self.epoch(role) + 1
        self._put("roles", role, epoch)
        return epoch

    def epoch(self, role: str) -> int:
        """Return how often `role` has joined."""
        found = self._row("roles", "WHERE role = ?", role)
        return 0 if found is None else int(found[1])

    # The log.

    def append(self, loop: int, number: int, stage: int, body: str, row: bytes | None = None) -> None:
        """Write a record that is next in its log."""
        before = self._heads.get((loop, stage))
        if before is None:
            query = "SELECT sum FROM records WHERE loop = ? AND stage = ? ORDER BY pass DESC LIMIT 1"
            before = (self._first(query, loop, stage) or (b"",))[0]
        found = record_sum(before, loop, number, stage, body, row)
        self._write("INSERT INTO records VALUES (?, ?, ?, ?, ?, ?)", loop, number, stage, body, row, found)
        self._heads[loop, stage] = found
        self._total = toggled(self._total, found)

    def _sums(self, table: str) -> Iterator[bytes]:
        """Yield the sums of a table's rows, each held against its row."""
        if table != "records":
            yield from super()._sums(table)
            return
        heads: dict[tuple[int, int], bytes] = {}
        query = "SELECT loop, pass, stage, body, row, sum FROM records ORDER BY loop, pass, stage"
        for loop, number, stage, body, row, found in self._each(query):
            place = (loop, stage)
            if (
                type(body) is not str
                or type(row) not in (bytes, type(None))
                or found != record_sum(heads.get(place, b""), loop, number, stage, body, row)
            ):
                named = STAGES[stage].__name__ if stage in range(len(STAGES)) else f"stage {stage}"
                raise self._unreadable(
                    f"{named} {number} of loop {loop} is not the one that was written there, or the one before it is "
                    "missing"
                )
            heads[place] = found
            yield found

    def body(self, loop: int, number: int, stage: int) -> str | None:
        """Return a record as JSON, or None where it is not in the log."""
        query = "SELECT body FROM records WHERE loop = ? AND pass = ? AND stage = ?"
        found = self._first(query, loop, number, stage)
        return None if found is None else str(found[0])

    def last(self, loop: int) -> tuple[int, int, int, int]:
        """Return the number of the last record of each stage: -1 where there is no plan 0, else 0 for none."""
        # From the end of the primary key backwards: the newest record of a stage is among the newest of all.
        query = "SELECT pass FROM records WHERE loop = ? AND stage = ? ORDER BY pass DESC LIMIT 1"
        seen, symptom, request, plan = (self._number(query, loop, stage) for stage in range(4))
        return max(0, seen), max(0, symptom), max(0, request), plan

    def count(self, loop: int) -> int:
        """Return the number of a loop's records."""
        return self._number("SELECT count(*) FROM records WHERE loop = ?", loop)

    def since(self, loop: int, stages: Mapping[int, int], limit: int) -> list[tuple[int, int, str]]:
        """Return (pass, stage, body) of the stages named, each from its pass on, in order of pass and stage."""
        where = " OR ".join("(stage = ? AND pass >= ?)" for _ in stages)
        values = [value for pair in stages.items() for value in pair]
        query = f"SELECT pass, stage, body FROM records WHERE loop = ? AND pass >= ? AND ({where}) ORDER BY pass, stage LIMIT ?"  # noqa: E501
        return self._all(query, loop, min(stages.values()), *values, limit)

    def rows(self, loop: int) -> Iterator[bytes]:
        """Yield the packed rows of plan 0 and of each finished pass, in order."""
        query = "SELECT row FROM records WHERE loop = ? AND stage = 3 ORDER BY pass"
        for (row,) in self._each(query, loop):
            yield row

    def drop(self, loop: int, first: int, last: int) -> None:
        """Write that the episodes `first` to `last` were driven and could not be logged."""
        self._put("dropped", loop, first, last)

    def dropped(self, loop: int) -> list[tuple[int, int]]:
        """Return what was dropped, as (first, last)."""
        return [(first, last) for _, first, last in self._rows("dropped", "WHERE loop = ? ORDER BY first", loop)]

    # States and tables.

    def keep_snapshot(self, snapshot: Snapshot) -> None:
        """Keep a role's state, and let go the one before it, and the Q-tables that nothing names any longer."""
        loop, role, number, state, table, final = snapshot
        key = None if table is None else self.keep_table(table, remembered=False)
        self._put("snapshots", loop, role, number, final, json.dumps(state), key)
        self._remove(
            "snapshots",
            "loop = ? AND role = ? AND pass NOT IN "
            "(SELECT pass FROM snapshots WHERE loop = ? AND role = ? ORDER BY pass DESC LIMIT ?)",
            loop, role, loop, role, SNAPSHOTS_KEPT,
        )  # fmt: skip
        if role == "plan":  # it will not ask again for what it read before
            self._remove("versions", "loop = ? AND pass <= ?", loop, number)
        if key is not None or role == "plan":
            self._remove(
                "q_tables",
                "NOT remembered AND sha256 NOT IN (SELECT q_table FROM snapshots WHERE q_table IS NOT NULL) "
                "AND sha256 NOT IN (SELECT q_table FROM versions)",
            )

    def snapshot(self, loop: int, role: str) -> Snapshot | None:
        """Return a role's newest state, or None."""
        found = self._row("snapshots", "WHERE loop = ? AND role = ? ORDER BY pass DESC", loop, role)
        if found is None:
            return None
        _, _, number, final, state, key = found
        table = None if key is None else self.table(key)
        return Snapshot(loop, role, number, self._json(state, "state of snapshots"), table, bool(final))

    def keep_table(self, table: QTable, *, remembered: bool) -> str:
        """Keep a Q-table under its hash, which is returned; one that is remembered stays for the whole run."""
        key = table.sha256()
        header, body = table.to_bytes()
        there = self._first("SELECT remembered FROM q_tables WHERE sha256 = ?", key)
        if there is None or there[0] < remembered:
            self._put("q_tables", key, json.dumps(header["actions"]), table.n_states, body, remembered)
        return key

    def table(self, key: str) -> QTable | None:
        """Return the Q-table with that hash, or None.

        Raises
        ------
        ResultsError
            It is not the one that was kept under the hash.
        """
        found = self._row("q_tables", "WHERE sha256 = ?", key)
        if found is None:
            return None
        _, text, states, body, _ = found
        try:
            actions = json.loads(text)
            header = {"schema": TABLE_SCHEMA, "actions": actions, "shape": [len(actions), states], "dtype": "<f8"}
            return QTable.from_bytes({**header, "sha256": key}, body)
        except (TypeError, ValueError) as error:
            raise self._unreadable(f"the Q-table {key[:12]}... in q_tables is damaged ({error})") from error

    def keep_version(self, loop: int, number: int, table: QTable) -> None:
        """Keep the Q-table at the end of episode `number`, for a planner that asked for it."""
        key = self.keep_table(table, remembered=False)
        self._put("versions", loop, number, key)

    def version(self, loop: int, number: int) -> QTable | None:
        """Return the Q-table at the end of episode `number` if it was asked for before, or None."""
        found = self._row("versions", "WHERE loop = ? AND pass = ?", loop, number)
        return None if found is None else self.table(found[2])

    # What happened beside the records.

    def keep_swap(self, swap: Swap) -> None:
        """Write that a part was replaced; what was planned does not take the place of what was asked for."""
        loop, number, part, spec, handed_over, planned = swap
        there = self._row("swaps", "WHERE loop = ? AND pass = ? AND part = ?", loop, number, part)
        # Who does a pass again first tells again of the part that was planned, and not of the one that followed it.
        if there is None or there[5] or not planned:
            self._put("swaps", loop, number, part, json.dumps(spec), handed_over, planned)

    def swaps(self) -> list[Swap]:
        """Return the parts that were replaced while the loop ran, in order of loop and pass."""
        return [
            Swap(loop, number, part, self._json(spec, "spec of swaps"), bool(handed_over), bool(planned))
            for loop, number, part, spec, handed_over, planned in self._rows("swaps", "ORDER BY loop, pass, part")
        ]

    def event(self, role: str, kind: str, text: str, loop: int | None = None, number: int | None = None) -> None:
        """Write an event, with the time of this machine's clock."""
        place = max(0, self._number("SELECT max(number) FROM events")) + 1
        self._put("events", place, time.time(), role, kind, loop, number, text)

    def events(self, after: int = 0) -> list[Event]:
        """Return the events numbered above `after`."""
        return [Event(*row) for row in self._rows("events", "WHERE number > ? ORDER BY number", after)]
