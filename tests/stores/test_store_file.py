"""One SQLite file per run: what it holds, who may open it, and what it lets go."""

import hashlib
import json
import sqlite3
import struct
import subprocess
import sys
import textwrap
from contextlib import closing

import numpy as np
import pytest

from adapters.stores import SCHEMA, Snapshot, Store, Swap
from adapters.stores.sqlite_store import APPLICATION, SNAPSHOTS_KEPT, VERSION
from knowledge import QTable
from mape.errors import ResultsError


@pytest.fixture
def path(tmp_path):
    return tmp_path / "log.sqlite"


@pytest.fixture
def store(path):
    with Store(path) as store:
        yield store


def table_of(value, actions=(0, 3), states=4):
    table = QTable(actions, states)
    table.values[:] = np.arange(table.values.size).reshape(table.values.shape) + value
    return table


def by_sqlite(path, statement):
    """Ask as a stranger with SQLite's own tool would."""
    with closing(sqlite3.connect(path)) as db:
        return db.execute(statement).fetchall()


def kept(path):
    return {key for (key,) in by_sqlite(path, "SELECT sha256 FROM q_tables")}


# The file.


def test_any_sqlite_tool_reads_it(store, path):
    store.append(0, 1, 0, '{"a":1}')
    store.event("plan", "joined", "here I am", 0, 1)
    store.commit()
    assert by_sqlite(path, "SELECT loop, pass, stage, body, row FROM records") == [(0, 1, 0, '{"a":1}', None)]
    assert by_sqlite(path, "SELECT role, kind, text FROM events") == [("plan", "joined", "here I am")]
    assert by_sqlite(path, "PRAGMA integrity_check") == [("ok",)]
    assert by_sqlite(path, "PRAGMA application_id") == [(APPLICATION,)]
    assert by_sqlite(path, "PRAGMA user_version") == [(VERSION,)]


def test_the_schema_is_what_is_published(store, path):
    with closing(sqlite3.connect(":memory:")) as db:
        db.executescript(SCHEMA)
        expected = db.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL").fetchall()
    assert by_sqlite(path, "SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL") == expected


def test_it_can_be_kept_in_memory_alone(tmp_path):
    with Store(None) as store:
        store.append(0, 0, 3, "{}")
        store.commit()
        assert store.body(0, 0, 3) == "{}"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("durability", ["normal", "full"])
def test_what_was_committed_is_there_again(path, durability):
    with Store(path, durability) as store:
        store.set_facts(config={"a": [1, None]}, seal="s")
        store.append(0, 1, 0, "first")
        store.append(0, 1, 3, "plan", b"\x00row")
        assert [store.join("plan"), store.join("plan"), store.join("monitor")] == [1, 2, 1]
        store.drop(0, 2, 4)
        store.keep_swap(Swap(0, 3, "plan", {"name": "x"}, True, False))
        store.commit()
    with Store(path) as store:
        assert store.facts() == {"config": {"a": [1, None]}, "seal": "s"}
        assert store.since(0, {0: 1, 3: 0}, 9) == [(1, 0, "first"), (1, 3, "plan")]
        assert list(store.rows(0)) == [b"\x00row"]
        assert [store.epoch(role) for role in ("plan", "monitor", "execute")] == [2, 1, 0]
        assert store.dropped(0) == [(2, 4)]
        assert store.swaps() == [Swap(0, 3, "plan", {"name": "x"}, True, False)]


def test_what_was_not_committed_is_gone(path):
    with Store(path) as store:
        store.append(0, 0, 3, "kept")
        store.commit()
        store.append(0, 1, 0, "lost")
    with Store(path) as store:
        assert store.last(0) == (0, 0, 0, 0)


def test_rolling_back_forgets_what_was_not_committed(store):
    store.append(0, 0, 3, "kept")
    store.commit()
    store.append(0, 1, 0, "forgotten")
    store.roll_back()
    store.roll_back()
    store.append(0, 1, 0, "instead")
    store.commit()
    assert store.body(0, 1, 0) == "instead"


def test_last_of_an_empty_loop_and_of_one_that_goes_on(store):
    assert store.last(0) == (0, 0, 0, -1)
    for number, stage in [(0, 3), (1, 0), (1, 1), (2, 0), (5, 0)]:
        store.append(0, number, stage, "{}")
    store.append(1, 9, 2, "{}")
    assert store.last(0) == (5, 1, 0, 0)
    assert store.last(1) == (0, 0, 9, -1)


def test_since_takes_each_stage_from_its_own_pass_and_no_more_than_it_may(store):
    for number in range(4):
        for stage in range(4):
            store.append(0, number, stage, f"{number}.{stage}")
    assert [body for _, _, body in store.since(0, {1: 2, 3: 1}, 99)] == ["1.3", "2.1", "2.3", "3.1", "3.3"]
    assert [body for _, _, body in store.since(0, {1: 2, 3: 1}, 2)] == ["1.3", "2.1"]
    assert store.since(1, {0: 0}, 99) == []


def test_events_are_numbered_and_those_after_one_can_be_had(store):
    for text in "abc":
        store.event("plan", "note", text, 0, 7)
    first, *rest = store.events()
    assert [event.text for event in store.events(first.number)] == ["b", "c"]
    assert [event.number for event in rest] == [2, 3]
    assert (first.role, first.kind, first.loop, first.pass_no) == ("plan", "note", 0, 7)


# Who may open it.


def test_a_second_writer_is_refused_and_the_first_one_goes_on(store, path):
    with pytest.raises(ResultsError, match=r"another Knowledge writes .*log\.sqlite( \(process \d+\))?; end it first"):
        Store(path)
    store.append(0, 0, 3, "{}")
    store.commit()
    store.close()
    with Store(path) as second:
        assert second.body(0, 0, 3) == "{}"


def test_a_second_writer_in_another_process_is_refused(store, path):
    program = f"""
        from pathlib import Path
        from adapters.stores import Store
        from mape.errors import ResultsError
        try:
            Store(Path({str(path)!r}))
        except ResultsError as error:
            print(error)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, timeout=60)
    assert done.stdout.startswith("another Knowledge writes ")


def test_one_that_only_reads_sees_what_is_committed_beside_the_writer(store, path):
    with Store(path, readonly=True) as reader:
        store.append(0, 0, 3, "{}")
        assert reader.last(0)[3] == -1
        store.commit()
        assert reader.last(0)[3] == 0
        with pytest.raises(ResultsError, match="readonly"):
            reader.append(0, 1, 0, "{}")
        assert list(reader.rows(0)) == [None]


def test_one_that_only_reads_does_not_make_the_file(path):
    with pytest.raises(ResultsError, match=r"there is no log .*log\.sqlite; `mapek up`"):
        Store(path, readonly=True)
    assert not path.exists()


def another_application(path):
    with closing(sqlite3.connect(path)) as db:
        db.executescript("CREATE TABLE bookmarks (url TEXT);")


def another_application_with_a_write_ahead_log(path):
    with closing(sqlite3.connect(path)) as db:
        db.executescript("PRAGMA journal_mode = WAL; CREATE TABLE bookmarks (url TEXT);")


def another_version_with_a_write_ahead_log(path):
    another_version(path)
    with closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA journal_mode = WAL")


def another_version(path):
    Store(path).close()
    with closing(sqlite3.connect(path)) as db:
        db.execute(f"PRAGMA user_version = {VERSION + 1}")


def an_older_version(path):
    another_version(path)
    with closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA user_version = 1")


def a_text(path):
    path.write_text("Dear diary, today I learnt that files have headers.\n" * 40)


def a_short_text(path):
    path.write_text("short")


def a_folder(path):
    path.mkdir()


def a_torn_file(path):
    with Store(path) as store:
        store.set_facts(big="x" * 100_000)
        store.commit()
    whole = path.read_bytes()
    path.write_bytes(whole[:50] + b"\xff" * 500 + whole[550:])


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (another_application, "is no log of a run; name the folder or file"),
        (another_version, f"has schema version {VERSION + 1}; this mapek reads version {VERSION}"),
        (an_older_version, rf"has schema version 1; this mapek reads version {VERSION}: mapek 0\.2\.0\.dev0 reads it"),
        (another_application_with_a_write_ahead_log, "is no log of a run; name the folder or file"),
        (another_version_with_a_write_ahead_log, f"has schema version {VERSION + 1}"),
        (a_text, "cannot be opened as a log: file is not a database"),
        (a_short_text, "cannot be opened as a log: file is not a database"),
        (a_folder, "cannot be written: Is a directory; choose another folder|there is no log"),
        (a_torn_file, "cannot be opened as a log|is no log of a run"),
    ],
)
@pytest.mark.parametrize("readonly", [False, True])
def test_what_is_no_log_of_this_version_is_refused_with_a_sentence_and_left_as_it_is(path, make, sentence, readonly):
    make(path)
    before = path.read_bytes() if path.is_file() else None
    for _ in range(2):  # nor does it stay locked
        with pytest.raises(ResultsError, match=sentence):
            Store(path, readonly=readonly)
    assert (path.read_bytes() if path.is_file() else None) == before


def test_a_folder_that_is_not_there_is_said_so(tmp_path):
    with pytest.raises(ResultsError, match=r"cannot be written: No such file or directory; choose another folder"):
        Store(tmp_path / "nowhere" / "log.sqlite")


# Q-tables and states.


def test_a_q_table_comes_back_as_the_same_bits(store):
    table = QTable((5, 0), 3)
    table.values[:] = [[-0.0, 5e-324, 1 / 3], [1.7976931348623157e308, -1e-300, 0.1 + 0.2]]
    key = store.keep_table(table, remembered=True)
    store.commit()
    again = store.table(key)
    assert (again.actions, again.values.tobytes()) == (table.actions, table.values.tobytes())
    assert key == table.sha256() == again.sha256()
    assert store.table("0" * 64) is None


def test_the_hash_of_a_q_table_is_made_as_the_schema_says(store, path):
    store.keep_table(table_of(7.0), remembered=True)
    store.commit()
    ((key, actions, states, body),) = by_sqlite(path, "SELECT sha256, actions, states, body FROM q_tables")
    ids = json.loads(actions)
    rows = len(ids)
    assert key == hashlib.sha256(struct.pack(f"<{2 + rows}q", rows, states, *ids) + body).hexdigest()


def test_a_state_comes_back_with_its_q_table(store):
    assert store.snapshot(0, "execute") is None
    snapshot = Snapshot(0, "execute", 7, {"deep": [1, None, "x"]}, table_of(1), True)
    store.keep_snapshot(snapshot)
    again = store.snapshot(0, "execute")
    assert again._replace(table=None) == snapshot._replace(table=None)
    assert again.table.sha256() == snapshot.table.sha256()
    assert store.snapshot(1, "execute") is None
    assert store.snapshot(0, "plan") is None


def test_old_states_are_let_go_with_their_q_tables_and_remembered_ones_stay(store, path):
    remembered = store.keep_table(table_of(100), remembered=True)
    asked_for = table_of(200)
    store.keep_version(0, 3, asked_for)
    for number in range(1, 8):
        store.keep_snapshot(Snapshot(0, "execute", number, number, table_of(number)))
        store.keep_snapshot(Snapshot(0, "monitor", number, number, None))
    store.commit()
    passes = by_sqlite(path, "SELECT role, pass FROM snapshots ORDER BY role, pass")
    newest = list(range(8 - SNAPSHOTS_KEPT, 8))
    assert passes == [(role, number) for role in ("execute", "monitor") for number in newest]
    assert kept(path) == {remembered, asked_for.sha256(), *(table_of(number).sha256() for number in newest)}
    assert store.version(0, 3).sha256() == asked_for.sha256()


def test_a_q_table_that_was_asked_for_is_let_go_once_plan_is_past_it(store, path):
    for number in (3, 4):
        store.keep_version(0, number, table_of(number))
    store.keep_version(1, 3, table_of(13))
    store.keep_snapshot(Snapshot(0, "plan", 3, {}, None))
    store.commit()
    assert store.version(0, 3) is None
    assert store.version(0, 4).sha256() == table_of(4).sha256()
    assert kept(path) == {table_of(4).sha256(), table_of(13).sha256()}


def test_a_q_table_that_was_a_state_first_and_is_remembered_then_stays(store, path):
    store.keep_snapshot(Snapshot(0, "execute", 1, {}, table_of(1)))
    key = store.keep_table(table_of(1), remembered=True)
    store.keep_table(table_of(1), remembered=False)
    for number in range(2, 6):
        store.keep_snapshot(Snapshot(0, "execute", number, {}, table_of(number)))
    store.commit()
    assert key in kept(path)


def test_a_state_that_is_older_than_the_newest_ones_does_not_take_their_place(store):
    for number in (5, 6, 2):
        store.keep_snapshot(Snapshot(0, "monitor", number, number, None))
    assert store.snapshot(0, "monitor").pass_no == 6


def test_a_state_of_the_same_pass_is_replaced(store):
    store.keep_snapshot(Snapshot(0, "execute", 5, "first", table_of(1)))
    store.keep_snapshot(Snapshot(0, "execute", 5, "second", table_of(2), True))
    found = store.snapshot(0, "execute")
    assert (found.state, found.final, found.table.sha256()) == ("second", True, table_of(2).sha256())
