"""A log that is gone, older than it was, or another one is told by its mark, and never begun anew or gone on with."""

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import textwrap
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from damaged_folders import CONFIG, QUIETLY, copied, hashes, logged, mapek
from replay_logs import write_log

from adapters.stores import Store
from adapters.stores.mark import Mark, MarkFile, boot_id, read_mark
from mape.errors import ResultsError


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A complete log, as it is after kill -9: with what was committed last in its -wal."""
    return logged(tmp_path_factory.mktemp("killed") / "out", open_wal=True)


@pytest.fixture
def folder(killed: Path, tmp_path: Path) -> Path:
    return copied(killed, tmp_path / "out")


def empty(log: Path) -> None:
    os.truncate(log, 0)
    for ending in ("-wal", "-shm"):
        log.with_name(log.name + ending).unlink()


def half(log: Path) -> None:
    Store(log).close()
    os.truncate(log, log.stat().st_size // 2 // 4096 * 4096)


def gone(log: Path) -> None:
    for path in log.parent.glob("log.sqlite*"):
        path.unlink()


def without_wal(log: Path) -> None:
    for ending in ("-wal", "-shm"):
        log.with_name(log.name + ending).unlink()


def zeroed_page(log: Path) -> None:
    Store(log).close()
    data = bytearray(log.read_bytes())
    data[4096 * 5 : 4096 * 6] = bytes(4096)
    log.write_bytes(data)


def older_copy(log: Path) -> None:
    """Put back a backup from before the last commits."""
    Store(log).close()
    backup = log.read_bytes()
    with Store(log) as store:
        store.event("plan", "note", "one more")
        store.commit()
    log.write_bytes(backup)


def older_wal(log: Path) -> None:
    """Put back the -wal and -shm of an earlier moment beside a file that has gone on."""
    pair = {path: path.read_bytes() for path in log.parent.glob("log.sqlite-*")}
    with Store(log) as store:
        for number in range(40):
            store.event("plan", "note", str(number))
            store.commit()
    for path, data in pair.items():
        path.write_bytes(data)


def another_runs(log: Path) -> None:
    gone(log)
    other = log.parent.parent / "other.sqlite"
    write_log(other, CONFIG)  # the same config; and still another run
    shutil.copy(other, log)


def no_mark(log: Path) -> None:
    (log.parent / "log.mark").unlink()


def cut_mark(log: Path) -> None:
    os.truncate(log.parent / "log.mark", 40)


def another_mark(log: Path) -> None:
    mark = log.parent / "log.mark"
    mark.write_text(mark.read_text().replace("0", "1", 1))


LOSSES = {
    empty: "is gone or empty, and log.mark counts",
    half: "cannot be",
    gone: "is gone or empty, and log.mark counts",
    without_wal: "is behind its mark: log.mark counts|cannot be",
    zeroed_page: "cannot be",
    older_copy: "is behind its mark: log.mark counts",
    older_wal: "is behind its mark: log.mark counts|cannot be read",
    another_runs: "is not the log that log.mark beside it was kept of",
    no_mark: "log.mark is missing beside",
    cut_mark: "log.mark is damaged",
    another_mark: "log.mark is damaged",
}


@pytest.mark.parametrize("lose", LOSSES)
def test_what_was_lost_is_told_by_every_command_and_nothing_begins_anew(
    folder: Path, lose: Callable[[Path], None]
) -> None:
    lose(folder / "log.sqlite")
    before = {path.name: path.read_bytes() for path in folder.glob("log.*")}
    up = ("up", folder.parent / "small.json", *QUIETLY, "--out", folder)
    (folder.parent / "small.json").write_text(CONFIG.to_json())
    for command in (("verify", folder), ("resume", folder), up, ("replay", folder, "-q"), ("log", folder)):
        said = mapek(*command)
        assert said.code == 1, (command, said)
        assert any(sentence in said.err for sentence in LOSSES[lose].split("|")), (command, said)
        assert "Traceback" not in said.err
    assert not (folder / "result.json").exists()
    # Whoever looks at a log may move its -wal into it, or make its companions; nothing else.
    assert {name: data for name, data in before.items() if name == "log.mark"} == {
        path.name: path.read_bytes() for path in folder.glob("log.mark")
    }


def test_a_log_as_a_killed_knowledge_leaves_it_is_gone_on_with(folder: Path, tmp_path: Path) -> None:
    assert mapek("verify", folder).code == 0
    assert mapek("resume", folder).code == 0
    assert mapek("verify", folder).code == 0
    assert hashes(folder) == hashes_of_run(tmp_path)


def hashes_of_run(place: Path) -> tuple[str, str]:
    (place / "again.json").write_text(CONFIG.to_json())
    assert mapek("run", place / "again.json", *QUIETLY, "--out", place / "again").code == 0
    return hashes(place / "again")


def test_a_log_that_lost_its_last_commits_with_the_machines_power_is_gone_on_with(folder: Path) -> None:
    log = folder / "log.sqlite"
    mark = read_mark(log)
    assert mark is not None
    assert mark.boot == boot_id()
    without_wal(log)
    with pytest.raises(ResultsError, match="is behind its mark"):
        Store(log)
    MarkFile(log, mark._replace(boot="another")).close()
    Store(log).close()  # what was flushed is there
    MarkFile(log, mark._replace(boot="another", flushed=mark.commits)).close()
    with pytest.raises(ResultsError, match="is behind its mark"):
        Store(log)


@pytest.mark.parametrize("durability", ["normal", "full"])
def test_the_mark_counts_what_was_committed_and_what_was_flushed(tmp_path: Path, durability: str) -> None:
    log = tmp_path / "log.sqlite"
    with Store(log, durability) as store:
        for number in range(3):
            store.event("plan", "note", str(number))
            store.commit()
        store.commit()  # nothing
        mark = read_mark(log)
        assert isinstance(mark, Mark)
        assert (mark.commits, mark.flushed) == (3, 3 if durability == "full" else 0)
    mark = read_mark(log)
    assert isinstance(mark, Mark)
    assert (mark.commits, mark.flushed) == (3, 3)


# Killed between any two writes.

STEPS = ["link", "mark", "commit", "marked", "closing"]

DIES = """
    import os, signal, sys
    from pathlib import Path
    from adapters.stores import Store, database
    from adapters.stores.mark import MarkFile

    at, after = sys.argv[2], int(sys.argv[3])

    def die():
        os.kill(os.getpid(), signal.SIGKILL)

    if at == "link":
        link = os.link
        os.link = lambda *names: (link(*names), die())
    init, write = MarkFile.__init__, MarkFile.write
    if at == "mark":
        MarkFile.__init__ = lambda *arguments: die()
    count = [0]

    def counted(file, mark):
        count[0] += 1
        if at == "commit" and count[0] == after:
            die()  # it is committed, and its mark is not written
        write(file, mark)
        if at == "marked" and count[0] == after:
            die()

    MarkFile.write = counted
    store = Store(Path(sys.argv[1]))
    for number in range(5):
        store.event("plan", "note", str(number))
        store.append(0, number, 3, str(number))
        store.commit()
        print(number, flush=True)
    if at == "closing":
        Store.roll_back = lambda store: die()
    store.close()
    print("closed")
"""


@pytest.mark.parametrize("at", STEPS)
@pytest.mark.parametrize("after", [2, 4])
def test_who_is_killed_between_two_writes_leaves_what_is_gone_on_with(tmp_path: Path, at: str, after: int) -> None:
    log = tmp_path / "log.sqlite"
    program = [sys.executable, "-c", textwrap.dedent(DIES), str(log), at, str(after)]
    done = subprocess.run(program, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == -signal.SIGKILL, done
    acknowledged = done.stdout.split()
    Store(log, readonly=True).close()
    with Store(log) as store:
        assert len(store.events()) >= len(acknowledged)
        assert store.count(0) == len(store.events())
        store.event("plan", "note", "goes on")
        store.commit()
    Store(log, readonly=True).close()


def test_a_log_that_was_rolled_back_by_another_tool_is_told(tmp_path: Path) -> None:
    log = tmp_path / "log.sqlite"
    with Store(log) as store:
        store.event("plan", "note", "here")
        store.commit()
    with closing(sqlite3.connect(log)) as db, db:
        db.execute("UPDATE seal SET commits = 0")
    with pytest.raises(ResultsError, match="its table seal is not what was written"):
        Store(log)
