"""One SQLite file (WAL): held for one writer and any number of readers, written in transactions.

What `commit` has returned from survives the end of the process, however sudden; with ``durability="full"`` the end of
the machine's power too, at the price of a disk flush per commit. Not for network file systems, which do not lock.

Each row has a checksum, the last column ``sum``; the one row of the table ``seal`` holds the total of all of them
(`adapters.stores.sums`) and the number of commits, which the mark beside the file holds too (`adapters.stores.mark`).
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import secrets
import sqlite3
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple, Self

from adapters import private
from adapters.held import held_by
from adapters.stores.mark import Mark, MarkFile, boot_id, mark_path, read_mark
from adapters.stores.sums import SIZE, row_sum, seal_sum, toggled
from mape.errors import ResultsError

WAL_LIMIT = 256
"""Megabytes that the write-ahead log may take before a reader who stands in its way ends the run."""

READER_LEAVES_WITHIN = 10.0
"""Seconds that such a reader has to leave."""

LOOK_EVERY = 16
"""Commits from one look at the size of the write-ahead log to the next."""

FLUSH_EVERY = 1000
"""Commits from one look to the next whether all before them are flushed."""


class Form(NamedTuple):
    """By what a file is known, and how its tables are made.

    Attributes
    ----------
    application, version : ``PRAGMA application_id`` and ``PRAGMA user_version``.
    schema : the statements that make the tables, ``seal`` among them.
    columns : of each other table its columns but ``sum``, those of the key first.
    keys : of each the number of those.
    readers : which mapek reads a file of an older version.
    """

    application: int
    version: int
    schema: str
    columns: Mapping[str, tuple[str, ...]]
    keys: Mapping[str, int]
    readers: Mapping[int, str]


class Database:
    """A file of one form, which a subclass names. All that is written waits for `commit`.

    Parameters
    ----------
    path
        The file, or None to keep all in memory.
    durability
        ``"normal"`` or ``"full"``; see the module.
    readonly
        Open an existing file for reading, beside a process that writes it.
    wal_limit
        Megabytes that the write-ahead log may take.

    Attributes
    ----------
    held : table -> rows that were held against their checksums when the file was opened.

    Raises
    ------
    ResultsError
        The file is no store of this version, is damaged or behind its mark; another process writes it, or it cannot be
        opened.
    """

    form: Form

    def __init__(
        self, path: Path | None, durability: str = "normal", *, readonly: bool = False, wal_limit: int = WAL_LIMIT
    ) -> None:
        self.path = path
        self._lock: IO[bytes] | None = None
        self._mark: MarkFile | None = None
        self._opened = False  # whether the file has proved to be a log
        self._writing = False
        self._durability = durability
        self._wal, self._wal_limit = f"{path}-wal", wal_limit * 1_000_000
        self._run_id, self._commits, self._total = "", 0, 0
        try:
            if path is not None:
                self._look(path, readonly)
            if readonly:
                assert path is not None
                self._db = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, isolation_level=None)
            else:
                self._lock = None if path is None else self._made(path) or _locked(path)
                # Written by the one thread that answers all queries, opened by another.
                self._db = sqlite3.connect(path or ":memory:", isolation_level=None, check_same_thread=False)
            self._open(readonly)
            self.held = self.verify()
            if path is not None and not readonly:
                self._go_on(path)
            self._opened = True
        except sqlite3.Error as error:
            self.close()
            raise ResultsError(f"{path} cannot be opened as a log: {error}") from error
        except BaseException:
            self.close()
            raise

    def _open(self, readonly: bool) -> None:
        queries = ("PRAGMA application_id", "PRAGMA user_version", "SELECT count(*) FROM sqlite_master")
        application, version, tables = (self._db.execute(query).fetchone()[0] for query in queries)
        empty = tables == 0
        if (empty and readonly) or (not empty and application != self.form.application):
            raise ResultsError(f"{self.path} is no log of a run; name the folder or file that `mapek up` wrote")
        if not empty and version != self.form.version:
            reader = self.form.readers.get(version)
            other = f"mapek {reader} reads it" if reader else "another version of mapek wrote it, or it is damaged"
            raise ResultsError(
                f"{self.path} has schema version {version}; this mapek reads version {self.form.version}: {other}"
            )
        if empty:
            self._db.executescript(self._script())
        self._check_schema()

    def _look(self, path: Path, readonly: bool) -> None:
        """Look at the names before anything is opened: SQLite follows links, and makes what is missing."""
        for one in (path, *(path.with_name(path.name + end) for end in ("-wal", "-shm", "-journal"))):
            if one.is_symlink():
                raise ResultsError(f"{one} is a symbolic link, which mapek never makes; name the file it leads to")
        if path.is_file() and path.stat().st_size:
            return
        mark = read_mark(path)
        if mark is not None and (readonly or mark.commits):
            raise ResultsError(
                f"{path} is gone or empty, and {mark_path(path).name} counts {mark.commits:,} commits to it: what was "
                f"logged is lost. {_WAY_OUT}"
            )
        if readonly and not path.is_file():
            raise ResultsError(f"there is no log {path}; `mapek up` and `mapek serve` write one")

    def _check_schema(self) -> None:
        with contextlib.closing(sqlite3.connect(":memory:")) as fresh:
            fresh.executescript(self.form.schema)
            query = "SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL ORDER BY name"
            wanted, found = (dict(db.execute(query).fetchall()) for db in (fresh, self._db))
        for name in {**wanted, **found}:
            if name not in found:
                raise self._unreadable(f"no such table: {name}")
            if found[name] != wanted.get(name):
                raise self._unreadable(f"its table {name} is not made as a log's is")

    def _go_on(self, path: Path) -> None:
        """Begin to write: what is refused was left as it is."""
        self._db.execute("PRAGMA journal_mode = WAL")
        self._db.execute(f"PRAGMA synchronous = {self._durability.upper()}")
        # Each checkpoint waits for the disk, and all that wait for an acknowledgement wait with it.
        self._db.execute("PRAGMA wal_autocheckpoint = 4000")
        try:
            mark = Mark(self._run_id, self._commits, 0, boot_id())
            self._mark = MarkFile(path, mark)
        except OSError as error:
            raise ResultsError(
                f"{mark_path(path)} cannot be written: {error.strerror or error}; make room, or choose another folder"
            ) from error
        self._flushed()

    def _script(self) -> str:
        form = self.form
        known = f"PRAGMA application_id = {form.application}; PRAGMA user_version = {form.version};"
        run, total = secrets.token_hex(16), bytes(SIZE)
        seal = f"INSERT INTO seal VALUES (1, '{run}', 0, x'{total.hex()}', x'{seal_sum(run, 0, total).hex()}');"
        return f"BEGIN; {form.schema} {seal} {known} COMMIT;"

    def _made(self, path: Path) -> IO[bytes] | None:
        """Make a file that takes its name with its tables in it, for who waits for it; return what holds it.

        None where there is one already, or it can only be made in its place.
        """
        if os.path.lexists(path):
            return None
        part = path.with_name(f"{path.name}.{os.getpid()}.part")
        held = None
        try:
            held = _locked(part)
            with contextlib.closing(sqlite3.connect(part, isolation_level=None)) as db:
                db.executescript(self._script())
            os.link(part, path)  # which, unlike a change of name, takes the place of no other
            return held
        except (OSError, sqlite3.Error, ResultsError):  # what stands in the way is told where it is opened
            if held is not None:
                held.close()
            return None
        finally:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)

    def close(self) -> None:
        """Leave the file; what was not committed is gone."""
        if hasattr(self, "_db"):
            if self._lock is not None and self._opened:
                # Leaves one file, without its companions; not if somebody reads it just now, or the disk is full.
                with contextlib.suppress(sqlite3.Error, ResultsError):
                    self.roll_back()
                    self._db.execute("PRAGMA journal_mode = DELETE")
                    if self._mark is not None:
                        self._mark.write(self._mark.mark._replace(flushed=self._commits))
            self._db.close()
        if self._mark is not None:
            self._mark.close()
            self._mark = None
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # Transactions: many appends, one commit.

    def commit(self) -> None:
        """Make everything since the last commit last.

        Raises
        ------
        ResultsError
            The disk is full, or the file cannot be written; nothing of it was.
        """
        if not self._writing:
            return
        commits = self._commits + 1
        total = self._total.to_bytes(SIZE, "big")
        found = seal_sum(self._run_id, commits, total)
        self._run("UPDATE seal SET commits = ?, total = ?, sum = ?", commits, total, found)
        self._run("COMMIT")
        self._writing = False
        self._commits = commits
        if self._mark is None:
            return
        # After the commit and before anybody is told of it: killed between the two, the log is ahead of its mark.
        run, _, flushed, boot = self._mark.mark
        self._write_mark(self._mark, Mark(run, commits, commits if self._durability == "full" else flushed, boot))
        if commits % FLUSH_EVERY == 0:
            self._flushed()
        if commits % LOOK_EVERY == 0:
            self._bound_wal()

    def _write_mark(self, file: MarkFile, mark: Mark) -> None:
        try:
            file.write(mark)
        except OSError as error:
            assert self.path is not None
            raise self._unwritable(mark_path(self.path), error.strerror or error) from error

    def _flushed(self) -> None:
        """Note how far a loss of power cannot take the log back: as far as it has been moved out of the WAL."""
        _, frames, moved = self._db.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
        if self._mark is not None and frames == moved:
            self._write_mark(self._mark, self._mark.mark._replace(flushed=self._commits))

    def _bound_wal(self) -> None:
        assert self.path is not None
        try:
            size = os.stat(self._wal).st_size
        except OSError:
            return
        if size <= self._wal_limit:
            return
        self._db.execute(f"PRAGMA busy_timeout = {int(READER_LEAVES_WITHIN * 1000)}")
        blocked, _, _ = self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
        if blocked:
            raise ResultsError(
                f"{self._wal} has grown to {size / 1e6:,.0f} MB, beyond its limit of {self._wal_limit / 1e6:,.0f} MB: "
                f"a reader who is in the middle of a transaction ({_holders(self.path)}) keeps it from being moved "
                f"into {self.path.name}. What was acknowledged is kept; end the reader, or raise --wal-limit, and go "
                "on with `mapek resume`."
            )

    def roll_back(self) -> None:
        """Forget everything since the last commit."""
        if self._writing:
            self._writing = False
            if self._db.in_transaction:  # SQLite rolls back by itself where the disk is full
                self._db.execute("ROLLBACK")
            self._read_seal()

    def _write(self, statement: str, *values: Any) -> sqlite3.Cursor:
        if not self._writing:
            self._run("BEGIN IMMEDIATE")
            self._writing = True
        return self._run(statement, *values)

    def _run(self, statement: str, *values: Any) -> sqlite3.Cursor:
        try:
            return self._db.execute(statement, values)
        except sqlite3.Error as error:
            raise self._unwritable(self.path, error) from error

    def _unwritable(self, path: Path | None, why: object) -> ResultsError:
        return ResultsError(
            f"{path} cannot be written: {why}. What was acknowledged before is kept; make room, and go on with "
            "`mapek resume`."
        )

    # Rows with their sums.

    def _put(self, table: str, *values: Any) -> None:
        """Write a row, in the place of the one with its key if there is one."""
        key = " AND ".join(f"{name} = ?" for name in self.form.columns[table][: self.form.keys[table]])
        self._let_go(table, key, *values[: self.form.keys[table]])
        found = row_sum(table, values)
        places = ", ".join("?" * (len(values) + 1))
        self._write(f"INSERT OR REPLACE INTO {table} VALUES ({places})", *values, found)
        self._total = toggled(self._total, found)

    def _remove(self, table: str, where: str, *values: Any) -> None:
        """Let rows go."""
        if self._let_go(table, where, *values):
            self._write(f"DELETE FROM {table} WHERE {where}", *values)

    def _let_go(self, table: str, where: str, *values: Any) -> int:
        gone = self._all(f"SELECT sum FROM {table} WHERE {where}", *values)
        for (found,) in gone:
            self._total = toggled(self._total, found)
        return len(gone)

    def _rows(self, table: str, tail: str = "", *values: Any) -> Iterator[tuple[Any, ...]]:
        """Yield rows, each held against its sum.

        Raises
        ------
        ResultsError
            One is not what was written.
        """
        columns, keys = self.form.columns[table], self.form.keys[table]
        for *row, found in self._each(f"SELECT {', '.join(columns)}, sum FROM {table} {tail}", *values):
            if found != row_sum(table, tuple(row)):
                named = ", ".join(f"{name} {value}" for name, value in zip(columns[:keys], row, strict=False))
                raise self._unreadable(f"in its table {table} the row of {named} is not what was written there")
            yield tuple(row)

    def _row(self, table: str, tail: str, *values: Any) -> tuple[Any, ...] | None:
        """Return the first row that is found, held against its sum, or None."""
        return next(iter(list(self._rows(table, f"{tail} LIMIT 1", *values))), None)

    # What the file holds as a whole.

    def verify(self) -> dict[str, int]:
        """Hold each row against its sum, all of them against their total, and the number of commits against the mark.

        Returns
        -------
        table -> number of its rows

        Raises
        ------
        ResultsError
            Names the first row that is not what was written, or says what is missing.
        """
        mark = self._read_mark()  # first: who writes meanwhile goes on
        assert not self._writing, "what is being written is verified once it is committed"
        self._all("BEGIN")  # one moment, whoever writes meanwhile
        self._db.text_factory = _any_text
        again = False
        held: dict[str, int] = {}
        try:
            self._read_seal()
            try:
                self._hold_against(mark)
            except ResultsError:
                if self._read_mark() == mark:
                    raise
                again = True  # another process has just begun to write
            total = 0
            for table in self.form.columns:
                held[table] = 0
                for found in self._sums(table):
                    total = toggled(total, found)
                    held[table] += 1
            if total != self._total:
                raise self._unreadable(
                    "each row is what was written, and rows are missing, or there are some that were let go: the total "
                    "of their sums is not the one in its table seal"
                )
        finally:
            self._db.text_factory = str
            if self._db.in_transaction:
                self._db.execute("COMMIT")
        return self.verify() if again else held

    def _read_mark(self) -> Mark | None:
        return None if self.path is None else read_mark(self.path)

    def _sums(self, table: str) -> Iterator[bytes]:
        """Yield the sums of a table's rows, each held against its row."""
        for row in self._rows(table):
            yield row_sum(table, row)

    def _read_seal(self) -> None:
        seal = self._first("SELECT run, commits, total, sum FROM seal WHERE one = 1")
        if seal is None or list(map(type, seal[:3])) != [str, int, bytes] or seal[3] != seal_sum(*seal[:3]):
            raise self._unreadable("its table seal is not what was written there")
        self._run_id, self._commits, self._total = seal[0], seal[1], int.from_bytes(seal[2], "big")

    def _hold_against(self, mark: Mark | None) -> None:
        if self.path is None:
            return
        name = mark_path(self.path).name
        if mark is None:
            if self._commits:
                raise ResultsError(
                    f"{name} is missing beside {self.path}: nobody can tell whether the log is as it was left. It "
                    f"stands in the folder of the run; copy both. {_WAY_OUT}"
                )
            return
        if mark.run != self._run_id and not self._commits and not mark.commits:
            return  # nothing was committed to either
        if mark.run != self._run_id:
            raise ResultsError(
                f"{self.path} is not the log that {name} beside it was kept of: it is that of another run, or was "
                f"begun anew. {_WAY_OUT}"
            )
        # What was committed last may have been lost with the machine's power, unless it had been flushed.
        lost = mark.boot != boot_id() or not mark.boot
        if self._commits < (mark.flushed if lost else mark.commits):
            raise ResultsError(
                f"{self.path} is behind its mark: {name} counts {mark.commits:,} commits, and the log has "
                f"{self._commits:,}. It is an older copy, or was cut short, or its -wal was lost. {_WAY_OUT}"
            )

    # Reading.

    def _each(self, statement: str, *values: Any) -> Iterator[Any]:
        try:
            found = self._db.execute(statement, values)
            # No `yield from`, which closes what it has begun, maybe after the file.
            while (row := found.fetchone()) is not None:
                yield row
        except sqlite3.Error as error:
            raise self._unreadable(error) from error

    def _all(self, statement: str, *values: Any) -> list[Any]:
        return list(self._each(statement, *values))

    def _first(self, statement: str, *values: Any) -> Any:
        """Return the first row that is found, or None."""
        try:
            return self._db.execute(statement, values).fetchone()
        except sqlite3.Error as error:
            raise self._unreadable(error) from error

    def _number(self, statement: str, *values: Any) -> int:
        found = self._first(statement, *values)
        return -1 if found is None or found[0] is None else int(found[0])

    def _json(self, text: Any, where: str) -> Any:
        try:
            return json.loads(text)
        except (TypeError, ValueError) as error:
            raise self._unreadable(f"{where} is no JSON: {error}") from error

    def _unreadable(self, why: object) -> ResultsError:
        return ResultsError(f"{self.path} cannot be read: {why}. {_WAY_OUT}")


_WAY_OUT = "What is damaged there only a copy of the whole folder from before mends, or a new run in another folder."


def _any_text(data: bytes) -> str:
    # What is damaged may be no text any more, and is to be named by its place all the same.
    return data.decode("utf-8", "surrogateescape")


def _holders(path: Path) -> str:
    """Say which processes have a file open, as far as this one may know."""
    mine, found = str(os.getpid()), []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            opened = (os.readlink(one) for one in (process / "fd").iterdir())
            if process.name != mine and str(path.resolve()) in opened:
                found.append(process.name)
    return f"process {', '.join(found)}" if found else "of a process that is not this user's"


def _locked(path: Path) -> IO[bytes]:
    """Hold the file for one writer: SQLite would let two take turns. Its own locks are of another kind."""
    try:
        file = open(path, "ab", opener=private.opener)  # noqa: SIM115 - held until `close`
    except OSError as error:
        raise ResultsError(f"{path} cannot be written: {error.strerror or error}; choose another folder") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        who = held_by(file)
        file.close()
        raise ResultsError(f"another Knowledge writes {path}{who}; end it first, or choose another folder") from None
    return file
