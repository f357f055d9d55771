"""Files of a run are its owner's alone, and no link leads out of its folder."""

import json
import os
import sqlite3
import stat
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from damaged_folders import CONFIG, QUIETLY, logged, mapek

from adapters.results.files import read_sealed, write_sealed
from adapters.stores import Store
from mape.errors import ResultsError


def modes(folder: Path) -> dict[str, int]:
    paths = [folder, *folder.rglob("*")]
    return {str(path.relative_to(folder)): stat.S_IMODE(path.lstat().st_mode) for path in paths}


@pytest.mark.parametrize(
    "umask", [pytest.param("000", marks=pytest.mark.long), "022", pytest.param("777", marks=pytest.mark.long)]
)
def test_files_have_mode_600_and_folders_700_whatever_the_umask(tmp_path: Path, umask: str) -> None:
    (tmp_path / "small.json").write_text(CONFIG.to_json())
    script = (
        f"import os, sys; os.umask(0o{umask})\n"
        "from adapters.cli.main import main\n"
        "sys.exit(main(sys.argv[1:]))"
    )  # fmt: skip
    command = ["run", "small.json", "-q", "--trace", "1:3", "--workers", "1", "--out", "deep/out"]
    if umask == "777":
        (tmp_path / "deep").mkdir()  # nothing else is made around it
    done = subprocess.run(
        [sys.executable, "-c", script, *command], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=240
    )
    assert done.returncode == 0, done.stderr
    found = modes(tmp_path / "deep" / "out")
    assert "figures/learning_curve.png" in found
    wanted = {name: 0o700 if (tmp_path / "deep" / "out" / name).is_dir() else 0o600 for name in found}
    assert found == wanted


def test_a_log_its_mark_and_its_companions_have_mode_600(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        with Store(tmp_path / "log.sqlite") as store:
            store.event("plan", "note", "here")
            store.commit()
            found = modes(tmp_path)
    finally:
        os.umask(before)
    assert {name for name in found if name != "."} == {"log.sqlite", "log.sqlite-wal", "log.sqlite-shm", "log.mark"}
    assert {mode for name, mode in found.items() if name != "."} == {0o600}


@pytest.mark.parametrize("name", ["logs/knowledge.log", "log.sqlite", "log.mark", ".lock", "manifest.json", "chunks"])
def test_a_link_in_the_folder_of_a_run_is_refused_and_what_it_leads_to_is_left(tmp_path: Path, name: str) -> None:
    folder = logged(tmp_path / "out")
    (folder / "logs").mkdir()
    (folder / "chunks").mkdir(exist_ok=True)
    theirs = tmp_path / "theirs"
    path = folder / name
    if path.is_dir():
        path.rename(theirs)
    else:
        theirs.write_bytes(path.read_bytes() if path.exists() else b"dear diary")
        path.unlink(missing_ok=True)
    path.symlink_to(theirs)
    before = theirs.read_bytes() if theirs.is_file() else list(theirs.iterdir())
    for command in ("resume", "replay", "verify", "log"):
        said = mapek(command, folder)
        assert (said.code, f"{path} is a symbolic link" in said.err) == (1, True), (command, said)
    said = mapek("up", tmp_path / "small.json", *QUIETLY, "--out", folder)
    assert (said.code, f"{path} is a symbolic link" in said.err) == (1, True), said
    assert (theirs.read_bytes() if theirs.is_file() else list(theirs.iterdir())) == before


def test_a_pipe_in_the_folder_of_a_run_is_refused(tmp_path: Path) -> None:
    folder = logged(tmp_path / "out")
    os.mkfifo(folder / "result.json")
    for command in ("resume", "replay", "verify"):
        assert "is neither a file nor a folder" in mapek(command, folder).err


def test_resume_writes_to_no_file_that_the_folder_names(tmp_path: Path) -> None:
    precious = tmp_path / "precious.json"
    precious.write_text("mine")
    folder = logged(tmp_path / "out")
    manifest = read_sealed(folder / "manifest.json")
    write_sealed(folder / "manifest.json", {**manifest, "command": [*manifest["command"], "--json", str(precious)]})
    said = mapek("resume", folder, "--json", tmp_path / "asked.json")
    assert said.code == 0
    assert json.loads((tmp_path / "asked.json").read_text())["name"] == CONFIG.name
    assert precious.read_text() == "mine"

    folder = logged(tmp_path / "again")
    write_sealed(folder / "manifest.json", {**manifest, "command": [*manifest["command"], "--json", str(precious)]})
    said = mapek("resume", folder)
    assert said.code == 0
    assert f"--json {precious} is not written" in said.err
    assert precious.read_text() == "mine"


# The write-ahead log.


def test_a_standing_reader_ends_the_run_before_the_write_ahead_log_is_beyond_its_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("adapters.stores.database.READER_LEAVES_WITHIN", 0.05)
    log = tmp_path / "log.sqlite"
    with Store(log, wal_limit=1) as store:
        store.append(0, 0, 3, "{}")
        store.commit()
        with closing(sqlite3.connect(log, isolation_level=None)) as reader:
            reader.execute("BEGIN")
            reader.execute("SELECT count(*) FROM records").fetchone()
            sizes: list[int] = []

            def fill() -> None:
                for number in range(1, 10_000):
                    store.append(0, number, 0, "x" * 1000)
                    store.commit()
                    sizes.append((tmp_path / "log.sqlite-wal").stat().st_size)

            with pytest.raises(ResultsError, match=r"log\.sqlite-wal has grown to 1 MB, beyond its limit of 1 MB"):
                fill()
            done = len(sizes)
            assert max(sizes) <= 1_500_000  # it is looked at now and then
            reader.execute("COMMIT")
        # With the reader gone it is gone on with, and nothing was lost.
        store.append(0, done + 2, 0, "x")
        store.commit()
    with Store(log, wal_limit=1) as store:
        assert store.count(0) == done + 3
        for number in range(done + 3, done + 1000):
            store.append(0, number, 0, "x" * 1000)
            store.commit()
            assert (tmp_path / "log.sqlite-wal").stat().st_size < 2_500_000
