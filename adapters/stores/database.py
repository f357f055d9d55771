"""One SQLite file (WAL): held for one writer and any number of readers, written in transactions.

What `commit` has returned from survives the end of the process, however sudden; with ``durability="full"`` the end of
the machine's power too, at the price of a disk flush per commit. Not for network file systems, which do not lock.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple, Self

from adapters.held import held_by
from mape.errors import ResultsError


class Form(NamedTuple):
    """By what a file is known (``PRAGMA application_id``, ``PRAGMA user_version``), and how its tables are made."""

    application: int
    version: int
    schema: str


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

    Raises
    ------
    ResultsError
        The file is no store of this version, another process writes it, or it cannot be opened.
    """

    form: Form

    def __init__(self, path: Path | None, durability: str = "normal", *, readonly: bool = False) -> None:
        self.path = path
        self._lock: IO[bytes] | None = None
        self._opened = False  # whether the file has proved to be a log
        self._writing = False
        try:
            if readonly:
                if path is None or not path.is_file():
                    raise ResultsError(f"there is no log {path}; `mapek up` and `mapek serve` write one")
                self._db = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, isolation_level=None)
            else:
                self._lock = None if path is None else self._made(path) or _locked(path)
                # Written by the one thread that answers all queries, opened by another.
                self._db = sqlite3.connect(path or ":memory:", isolation_level=None, check_same_thread=False)
            self._open(durability, readonly)
            self._opened = True
        except sqlite3.Error as error:
            self.close()
            raise ResultsError(f"{path} cannot be opened as a log: {error}") from error
        except BaseException:
            self.close()
            raise

    def _open(self, durability: str, readonly: bool) -> None:
        queries = ("PRAGMA application_id", "PRAGMA user_version", "SELECT count(*) FROM sqlite_master")
        application, version, tables = (self._db.execute(query).fetchone()[0] for query in queries)
        empty = tables == 0
        if (empty and readonly) or (not empty and application != self.form.application):
            raise ResultsError(f"{self.path} is no log of a run; name the folder or file that `mapek up` wrote")
        if not empty and version != self.form.version:
            raise ResultsError(
                f"{self.path} has schema version {version}; this mapek reads version {self.form.version}"
            )
        if readonly:
            return
        if self.path is not None:
            self._db.execute("PRAGMA journal_mode = WAL")
            self._db.execute(f"PRAGMA synchronous = {durability.upper()}")
            # Each checkpoint waits for the disk, and all that wait for an acknowledgement wait with it.
            self._db.execute("PRAGMA wal_autocheckpoint = 4000")
        if empty:
            self._db.executescript(self._script())

    def _script(self) -> str:
        form = self.form
        known = f"PRAGMA application_id = {form.application}; PRAGMA user_version = {form.version};"
        return f"BEGIN; {form.schema} {known} COMMIT;"

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
                with contextlib.suppress(sqlite3.Error):
                    self.roll_back()
                    self._db.execute("PRAGMA journal_mode = DELETE")
            self._db.close()
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
        if self._writing:
            self._run("COMMIT")
            self._writing = False

    def roll_back(self) -> None:
        """Forget everything since the last commit."""
        if self._writing:
            self._writing = False
            if self._db.in_transaction:  # SQLite rolls back by itself where the disk is full
                self._db.execute("ROLLBACK")

    def _write(self, statement: str, *values: Any) -> sqlite3.Cursor:
        if not self._writing:
            self._run("BEGIN IMMEDIATE")
            self._writing = True
        return self._run(statement, *values)

    def _run(self, statement: str, *values: Any) -> sqlite3.Cursor:
        try:
            return self._db.execute(statement, values)
        except sqlite3.Error as error:
            raise ResultsError(
                f"{self.path} cannot be written: {error}. What was acknowledged before is kept; make room, and go on "
                "with `mapek resume`."
            ) from error

    # Reading.

    def _each(self, statement: str, *values: Any) -> Iterator[Any]:
        try:
            yield from self._db.execute(statement, values)
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
        return ResultsError(
            f"{self.path} cannot be read: {why}. What is damaged there only a copy from before mends, or a new run in "
            "another folder."
        )


def _locked(path: Path) -> IO[bytes]:
    """Hold the file for one writer: SQLite would let two take turns. Its own locks are of another kind."""
    try:
        file = open(path, "ab")  # noqa: SIM115 - held until `close`
    except OSError as error:
        raise ResultsError(f"{path} cannot be written: {error.strerror or error}; choose another folder") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        who = held_by(file)
        file.close()
        raise ResultsError(f"another Knowledge writes {path}{who}; end it first, or choose another folder") from None
    return file
