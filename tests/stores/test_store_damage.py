"""A log that is damaged, or just being made: a sentence names the file, and what is wrong with it."""

import sqlite3
import threading
from contextlib import closing

import pytest

from adapters.stores import Snapshot, Store, Swap
from adapters.stores.database import Database
from adapters.stores.ledger import Ledger
from adapters.stores.sqlite_store import COLUMNS
from knowledge import QTable
from mape.errors import ResultsError

TABLE = QTable((0, 3), 4)
TABLE.values[:] = 1.5


@pytest.fixture
def path(tmp_path):
    """A log with one of everything."""
    path = tmp_path / "log.sqlite"
    with Store(path) as store:
        store.set_facts(config={"episodes": 3})
        store.append(0, 1, 0, "{}")
        store.keep_snapshot(Snapshot(0, "execute", 1, {"passes": 1}, TABLE))
        store.keep_version(0, 1, TABLE)
        store.keep_swap(Swap(0, 1, "plan", {"name": "morphin"}, True, False))
        store.drop(0, 2, 2)
        store.event("plan", "joined", "here")
        store.join("plan")
        store.commit()
    return path


# Each value of each table, and what else it might be.
OTHERS = ["7", "-1", "NULL", "1.5", "'text'", "x'00'", "x'ff'", "zeroblob(32)", "'{'", "1e999", "{column} || ' '"]


@pytest.mark.parametrize("table", COLUMNS)
def test_whatever_else_stands_in_a_row_is_told_with_its_table(path, table):
    whole = path.read_bytes()
    tried = 0
    for column in (*COLUMNS[table], "sum"):
        for value in OTHERS:
            path.write_bytes(whole)
            with closing(sqlite3.connect(path)) as db, db:
                before = db.execute(f"SELECT hex({column}), typeof({column}) FROM {table}").fetchall()
                try:
                    db.execute(f"UPDATE {table} SET {column} = {value.replace('{column}', column)}")
                except sqlite3.Error:
                    continue  # it cannot stand there
                if db.execute(f"SELECT hex({column}), typeof({column}) FROM {table}").fetchall() == before:
                    continue
            tried += 1
            said = "Observation|NoneType|stage" if table == "records" else f"in its table {table} the row of"
            with pytest.raises(ResultsError, match=rf"log\.sqlite cannot be read: ({said}).*another folder"):
                Store(path, readonly=True)
    assert tried > 5


@pytest.mark.parametrize("table", COLUMNS)
def test_a_row_that_is_missing_is_told(path, table):
    with closing(sqlite3.connect(path)) as db, db:
        assert db.execute(f"DELETE FROM {table}").rowcount
    with pytest.raises(ResultsError, match="rows are missing"):
        Store(path)


def test_a_record_that_is_missing_on_the_way_is_told_at_the_next_one(path):
    with Store(path) as store:
        for number in range(2, 9):
            store.append(0, number, 0, "{}")
        store.commit()
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("DELETE FROM records WHERE pass = 4")
    with pytest.raises(ResultsError, match=r"Observation 5 of loop 0 is .* or the one before it is missing"):
        Store(path)


@pytest.mark.parametrize("column", ["run", "commits", "total", "sum"])
def test_a_seal_that_was_changed_is_told(path, column):
    whole = path.read_bytes()
    for value in ("7", "'x'", "zeroblob(32)"):
        path.write_bytes(whole)
        with closing(sqlite3.connect(path)) as db, db:
            db.execute(f"UPDATE seal SET {column} = {value}")
        with pytest.raises(ResultsError, match="its table seal is not what was written there"):
            Store(path)


@pytest.mark.parametrize("table", [*COLUMNS, "seal"])
def test_a_missing_table_is_named(path, table):
    with closing(sqlite3.connect(path)) as db, db:
        db.execute(f"DROP TABLE {table}")
    with pytest.raises(ResultsError, match=rf"log\.sqlite cannot be read: no such table: {table}\. .*another folder"):
        Store(path, readonly=True)


def test_pages_that_are_damaged_are_told(path):
    with Store(path) as store:
        for number in range(2, 2000):
            store.append(0, number, 0, "x" * 100)
        store.commit()
    whole = path.read_bytes()
    half = len(whole) // 2
    path.write_bytes(whole[:half] + b"\xff" * 40_000 + whole[half + 40_000 :])
    with pytest.raises(ResultsError, match=r"log\.sqlite cannot be "):
        Store(path, readonly=True)


@pytest.mark.parametrize("layout", [{}, {"signals": 3, "detectors": 1, "rates": 1, "max_actions": 4}, 7, None])
def test_a_damaged_layout_is_told(path, layout):
    with Store(path) as store:
        store.set_facts(layout=layout)
        store.commit()
        with pytest.raises(ResultsError, match=r"the layout of the run's rows.* is damaged"):
            Ledger(store, 1, 3)


# Being made.


def test_who_reads_a_log_finds_it_whole_from_the_moment_that_it_is_there(tmp_path):
    for round_ in range(20):
        path = tmp_path / f"{round_}.sqlite"
        maker = threading.Thread(target=lambda at=path: Store(at).close())
        maker.start()
        while not path.exists():
            pass
        Store(path, readonly=True).close()
        maker.join()
    assert not list(tmp_path.glob("*.part"))


def test_a_log_that_another_has_made_meanwhile_is_left_to_it(tmp_path, monkeypatch):
    path, made = tmp_path / "log.sqlite", []
    script = Database._script

    def other_first(store):
        if not made:
            made.append(None)
            made[0] = Store(path)
        return script(store)

    monkeypatch.setattr(Database, "_script", other_first)
    with pytest.raises(ResultsError, match="another Knowledge writes"):
        Store(path)
    made[0].close()
    assert sorted(one.name for one in tmp_path.iterdir()) == ["log.mark", "log.sqlite"]
