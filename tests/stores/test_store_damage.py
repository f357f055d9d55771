"""A log that is damaged, or just being made: a sentence names the file, and what is wrong with it."""

import sqlite3
import threading
from contextlib import closing

import pytest

from adapters.stores import Snapshot, Store, Swap
from adapters.stores.database import Database
from adapters.stores.ledger import Ledger
from knowledge import QTable
from mape.errors import ResultsError

TABLE = QTable((0, 3), 4)
TABLE.values[:] = 1.5
KEY = TABLE.sha256()


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
        store.commit()
    return path


def change(path, statement):
    with closing(sqlite3.connect(path)) as db, db:
        db.execute(statement)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("body", "zeroblob(64)"), ("body", "x'00'"), ("body", "'text'"), ("body", "7"), ("actions", "'[0, '"),
        ("actions", "'7'"), ("actions", "x'ff'"), ("states", "-4"), ("states", "'four'"), ("sha256", "'0'"),
    ],
)  # fmt: skip
def test_a_damaged_q_table_is_named(path, column, value):
    change(path, f"UPDATE q_tables SET {column} = {value}")
    with Store(path, readonly=True) as store:
        key = "0" if column == "sha256" else KEY
        with pytest.raises(ResultsError, match=rf"log\.sqlite cannot be read: the Q-table {key[:12]}.*damaged"):
            store.table(key)


READS = {
    "run": lambda store: store.facts(),
    "records": lambda store: (store.last(0), store.body(0, 1, 0), store.since(0, {0: 1}, 5), list(store.rows(0))),
    "dropped": lambda store: store.dropped(0),
    "snapshots": lambda store: store.snapshot(0, "execute"),
    "q_tables": lambda store: store.snapshot(0, "execute"),
    "versions": lambda store: store.version(0, 1),
    "swaps": lambda store: store.swaps(),
    "roles": lambda store: store.epoch("plan"),
    "events": lambda store: store.events(),
}


@pytest.mark.parametrize("table", READS)
def test_a_missing_table_is_named(path, table):
    change(path, f"DROP TABLE {table}")
    with (
        Store(path, readonly=True) as store,
        pytest.raises(ResultsError, match=rf"log\.sqlite cannot be read: no such table: {table}\. .*another folder"),
    ):
        READS[table](store)


@pytest.mark.parametrize(
    ("table", "column"),
    [("run", "value"), ("snapshots", "state"), ("swaps", "spec")],
)
@pytest.mark.parametrize("value", ["'{'", "'nought'", "x'ff'"])
def test_a_text_that_is_no_json_is_named_with_its_table(path, table, column, value):
    change(path, f"UPDATE {table} SET {column} = {value}")
    with (
        Store(path, readonly=True) as store,
        pytest.raises(ResultsError, match=rf"cannot be read: .*{column} of {table}"),
    ):
        READS[table](store)


def test_pages_that_are_damaged_are_told(path):
    with Store(path) as store:
        for number in range(2, 2000):
            store.append(0, number, 0, "x" * 100)
        store.commit()
    whole = path.read_bytes()
    half = len(whole) // 2
    path.write_bytes(whole[:half] + b"\xff" * 40_000 + whole[half + 40_000 :])
    with Store(path, readonly=True) as store, pytest.raises(ResultsError, match=r"log\.sqlite cannot be read: "):
        store.since(0, {0: 1}, 5000)


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
    assert [one.name for one in tmp_path.iterdir()] == ["log.sqlite"]
