"""`mapek resume`: the command that began a run goes on, wherever it is given."""

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from real_runs import (
    DEADLINE,
    FROZEN_LAKE,
    MANY,
    children_of,
    finished_chunks,
    leftovers,
    result_of,
    run,
    running,
    wait_for_a_chunk,
    wait_until_gone,
)
from replay_logs import edited

from adapters.cli.main import main
from adapters.results import RunFolder, files, read_episodes
from mape.errors import ResultsError

SMALL = """\
name = "small"
episodes = 6

[system]
id = "mapek/Gridworld-v0"
options = { size = [3, 3], start = [0, 0], goals = [[2, 2]], max_steps = 10 }

[execute]
engine = "python"

[agents.eager.plan]
alpha = 0.5
"""
QUIETLY = ("--no-figures", "-q")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.toml").write_text(SMALL)
    return tmp_path


def hashes(folder: Path) -> tuple[str, str]:
    result = result_of(folder)
    return result["log_sha256"], result["q_table_sha256"]


def assert_equal_tables(found: Path, expected: Path) -> None:
    names = sorted(path.name for path in expected.glob("*.npz"))
    assert names
    assert sorted(path.name for path in found.glob("*.npz")) == names
    for name in names:
        with np.load(found / name) as there, np.load(expected / name) as here:
            assert there.files == here.files
            for column in here.files:
                np.testing.assert_array_equal(there[column], here[column], err_msg=f"{name}, {column}")


def test_reproduce_that_is_killed_goes_on_and_comes_to_the_same(tmp_path: Path) -> None:
    jump = ("reproduce", "jump", "--trials", "40", "--workers", "2", *QUIETLY)  # a chunk for each of four agents
    out = tmp_path / "out"
    with running(*jump, "--out", "out", cwd=tmp_path) as process:
        wait_for_a_chunk(process, out)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    kept = len(finished_chunks(out))
    assert kept >= 1
    assert not (out / "result.json").exists()

    (tmp_path / "elsewhere").mkdir()
    said = run("resume", "../out", cwd=tmp_path / "elsewhere").stdout
    run(*jump, "--out", "undisturbed", cwd=tmp_path)

    assert said.startswith(f"continuing in {out}: ")
    assert result_of(out) == result_of(tmp_path / "undisturbed")
    assert_equal_tables(out, tmp_path / "undisturbed")
    assert leftovers(out) == []
    assert not list((tmp_path / "elsewhere").iterdir())


def wait_for_passes(process: "subprocess.Popen[str]", log: Path, passes: int) -> None:
    """Wait until so many passes are on disk; the run must not be over by then."""
    deadline = time.monotonic() + DEADLINE
    pause = threading.Event()
    while True:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        if log.exists():
            db = sqlite3.connect(f"{log.as_uri()}?mode=ro", uri=True)
            try:
                if (db.execute("SELECT max(pass) FROM records").fetchone()[0] or 0) >= passes:
                    return
            except sqlite3.OperationalError:
                pass  # the file is there, its tables are not yet
            finally:
                db.close()
        pause.wait(0.01)


@pytest.mark.long
def test_up_whose_supervisor_is_killed_goes_on_and_comes_to_what_run_comes_to(tmp_path: Path) -> None:
    lake = (str(FROZEN_LAKE), "--set", "episodes=1500", *QUIETLY)
    out = tmp_path / "out"
    with running("up", *lake, "--out", "out", cwd=tmp_path) as process:
        wait_for_passes(process, out / "log.sqlite", 300)
        children = children_of(process.pid)
        assert len(children) == 5
        process.kill()
        process.wait()
        wait_until_gone(children)
    assert not (out / "result.json").exists()
    assert run("replay", "out", "--json", cwd=tmp_path).stdout.startswith("{")  # as far as it goes, nothing differs

    run("resume", "out", cwd=tmp_path)
    run("run", *lake, "--out", "undisturbed", cwd=tmp_path)

    assert result_of(out) == result_of(tmp_path / "undisturbed")
    assert_equal_tables(out, tmp_path / "undisturbed")


def test_the_manifest_says_which_command_began_the_run_and_where(here: Path, stop: Callable[..., None]) -> None:
    command = ["run", "small.toml", *QUIETLY, "--workers", "1", "--out", "out"]

    stop(*command)

    manifest = json.loads(Path("out/manifest.json").read_text())
    assert (manifest["command"], manifest["cwd"]) == (command, str(here))
    assert main(["resume", "out"]) == 0
    assert json.loads(Path("out/result.json").read_text())["command"] == command


@pytest.mark.parametrize(
    "command",
    [
        ("run", "small.toml", "--seed", "3", "--set", "plan.alpha=0.3", "--trials", "2", "--trace", "1:3"),
        ("run", "small.toml", "--agent", "eager"),
        ("compare", "small.toml", "other.toml", "--trials", "2"),
        ("reproduce", "jump", "--trials", "2", "--set", "episodes=5"),
        ("reproduce", "table1", "--trials", "1", "--set", "episodes=5", "--profile", "paper"),
    ],
    ids=lambda command: " ".join(command[:3]),
)
def test_whatever_command_began_it_goes_on_from_any_folder(
    here: Path, monkeypatch: pytest.MonkeyPatch, stop: Callable[..., None], command: tuple[str, ...]
) -> None:
    Path("other.toml").write_text(SMALL.replace('"small"', '"other"') + "[learner]\ndiscount = 0.5\n")
    stop(*command, *QUIETLY, "--workers", "1", "--out", "out")
    assert main([*command, *QUIETLY, "--workers", "1", "--out", "undisturbed"]) == 0
    (here / "elsewhere").mkdir()
    monkeypatch.chdir(here / "elsewhere")

    assert main(["resume", "../out", "-q", "--workers", "2"]) == 0

    assert Path.cwd() == here / "elsewhere"
    assert result_of(here / "out") == result_of(here / "undisturbed")
    assert_equal_tables(here / "out", here / "undisturbed")


def test_a_part_of_the_users_own_is_found_where_the_run_was_begun(tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "mine.py").write_text(
        "from mape.monitor.page_hinkley import PageHinkley\nclass Mine(PageHinkley):\n    pass\n"
    )
    command = (*MANY, "--set", 'monitor.detectors=["mine:Mine"]', "--out", "out")
    with running(*command, cwd=tmp_path / "work") as process:
        wait_for_a_chunk(process, tmp_path / "work" / "out")
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    said = run("resume", "work/out", cwd=tmp_path).stdout

    assert said.startswith(f"continuing in {tmp_path / 'work' / 'out'}: ")
    assert result_of(tmp_path / "work" / "out")["passes"] == 400


@pytest.mark.parametrize("agent", [(), ("--agent", "eager")])
def test_the_config_that_is_gone_is_taken_from_the_folder(
    here: Path, stop: Callable[..., None], agent: tuple[str, ...]
) -> None:
    command = ("run", "small.toml", *agent, "--seed", "5", "--set", "episodes=7", "--trials", "2", *QUIETLY)
    assert main([*command, "--out", "undisturbed"]) == 0
    stop(*command, "--out", "out")
    Path("small.toml").unlink()

    assert main(["resume", "out"]) == 0

    assert hashes(here / "out") == hashes(here / "undisturbed")
    assert_equal_tables(here / "out", here / "undisturbed")


def test_a_run_whose_folder_of_then_is_gone_goes_on_from_here(
    here: Path, monkeypatch: pytest.MonkeyPatch, stop: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "then").mkdir()
    shutil.copy("small.toml", here / "then")
    monkeypatch.chdir(here / "then")
    stop("run", "small.toml", *QUIETLY, "--out", str(here / "out"))
    monkeypatch.chdir(here)
    shutil.rmtree(here / "then")
    capsys.readouterr()

    assert main(["resume", "out"]) == 0

    assert f"the folder {here / 'then'}, where the run was begun, is gone" in capsys.readouterr().err
    assert read_episodes("out/episodes-small.npz")["return"].shape == (1, 6)


def edit_manifest(folder: Path, **entries: Any) -> None:
    with edited(folder / "manifest.json") as manifest:
        for name, value in entries.items():
            manifest.pop(name)
            if value is not None:
                manifest[name] = value


def test_an_older_manifest_does_not_say_the_command_and_still_goes_on_by_out(
    here: Path, stop: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    stop("run", "small.toml", *QUIETLY, "--out", "out")
    edit_manifest(here / "out", command=None, cwd=None)
    capsys.readouterr()

    assert main(["resume", "out"]) == 1
    assert f"give that command again, with --out {here / 'out'}, to continue" in capsys.readouterr().err
    assert main(["run", "small.toml", *QUIETLY, "--out", "out"]) == 0


def test_the_same_run_may_be_gone_on_with_by_another_command_line(
    here: Path, monkeypatch: pytest.MonkeyPatch, stop: Callable[..., None]
) -> None:
    stop("run", "small.toml", *QUIETLY, "--seed", "4", "--out", "out")
    (here / "elsewhere").mkdir()
    monkeypatch.chdir(here / "elsewhere")

    assert main(["run", "../small.toml", *QUIETLY, "--set", "seed=4", "--out", "../out"]) == 0


def test_a_command_that_is_not_known_any_more_is_said(
    here: Path, stop: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    stop("run", "small.toml", *QUIETLY, "--out", "out")
    for command in (["walk", "small.toml"], ["list"], ["run", "small.toml", "--backwards"]):
        edit_manifest(here / "out", command=command)
        capsys.readouterr()
        assert main(["resume", "out"]) == 1
        said = f"mapek: {here / 'out'} was begun by `mapek {' '.join(command)}`, which this mapek does not know\n"
        assert capsys.readouterr().err == said


def test_workers_are_no_option_of_processes_that_are_roles(
    here: Path, stop: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    stop("run", "small.toml", *QUIETLY, "--out", "out")
    edit_manifest(here / "out", command=["up", "small.toml"])
    capsys.readouterr()

    assert main(["resume", "out", "--workers", "2"]) == 2
    assert "`mapek up` has no --workers" in capsys.readouterr().err


def test_a_finished_run_and_what_is_no_run_are_refused(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "small.toml", *QUIETLY, "--out", "out"]) == 0
    (here / "theirs").mkdir()
    (here / "theirs" / "letter.txt").write_text("dear diary")
    (here / "odd").mkdir()
    (here / "odd" / "manifest.json").write_text("[1, 2]")
    (here / "cut").mkdir()
    (here / "cut" / "manifest.json").write_text('{"format": 1, "ki')

    for name, says in (
        ("out", f"{here / 'out'} holds a finished run, which is left as it is"),
        ("theirs", f"{here / 'theirs'} holds no run of ours"),
        ("nowhere", f"{here / 'nowhere'} holds no run of ours"),
        ("odd", f"{here / 'odd'}/manifest.json is of no run of ours"),
        ("cut", f"{here / 'cut'}/manifest.json is damaged"),
    ):
        capsys.readouterr()
        assert main(["resume", name]) == 1
        assert capsys.readouterr().err.startswith(f"mapek: {says}")


@pytest.mark.parametrize("where", [(), ("--out", "out")], ids=["default", "out"])
def test_ctrl_c_after_the_trials_names_the_folder_and_how_to_go_on(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], where: tuple[str, ...]
) -> None:
    def interrupt(*arguments: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr("adapters.experiments.pictures.pictures_of_run", interrupt)
        assert main(["run", "small.toml", "-q", "--workers", "1", "--trials", "3", *where]) == 130

    (out,) = [Path("out")] if where else Path("results").iterdir()
    said = f"3 of 3 trials are finished and kept in {out}; `mapek resume {out}` continues.\n"
    assert capsys.readouterr().err == f"mapek: stopped. {said}"
    assert main(["resume", str(out)]) == 0
    assert list((out / "figures").iterdir())


def test_ctrl_c_after_the_result_says_that_all_is_there(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def write_json(path: Path, *arguments: Any, **options: Any) -> None:
        if path.name == "found.json":
            raise KeyboardInterrupt
        written(path, *arguments, **options)

    written = files.write_json
    monkeypatch.setattr(files, "write_json", write_json)
    assert main(["run", "small.toml", *QUIETLY, "--json", "found.json", "--out", "out"]) == 130
    assert capsys.readouterr().err == "mapek: stopped. The run is complete; all of it is in out.\n"


def test_json_that_fails_after_all_names_the_folder_where_the_result_is(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "elsewhere").mkdir()
    finish = RunFolder.finish

    def finish_and_remove(folder: RunFolder, result: Any) -> None:
        finish(folder, result)
        (here / "elsewhere").rmdir()

    monkeypatch.setattr(RunFolder, "finish", finish_and_remove)
    assert main(["run", "small.toml", *QUIETLY, "--json", "elsewhere/found.json", "--out", "out"]) == 1
    assert capsys.readouterr().err == (
        "mapek: elsewhere/found.json cannot be written: No such file or directory. The run is complete; all of it is "
        "in out.\n"
    )


def read_q_tables(out: Path) -> None:
    finished = RunFolder.__new__(RunFolder)  # as it is: it would not be opened again
    finished.path = out
    finished.q_tables("small")


@pytest.mark.parametrize(
    ("file", "read"),
    [
        ("episodes-small.npz", lambda out: read_episodes(out / "episodes-small.npz")),
        ("q_tables-small.npz", read_q_tables),
    ],
)
def test_a_table_that_is_cut_short_says_how_it_is_made_again_and_so_it_is(
    here: Path, file: str, read: Callable[[Path], object]
) -> None:
    assert main(["run", "small.toml", *QUIETLY, "--trials", "2", "--out", "undisturbed"]) == 0
    assert main(["run", "small.toml", *QUIETLY, "--trials", "2", "--out", "out"]) == 0
    os.truncate(here / "out" / file, 100)

    with pytest.raises(ResultsError) as failed:
        read(here / "out")
    assert str(failed.value).endswith(
        f"Delete {here}/out/result.json, if it is there; then `mapek resume {here}/out` makes the tables again."
    )
    assert main(["resume", "out"]) == 1
    (here / "out" / "result.json").unlink()
    assert main(["resume", "out"]) == 0
    assert hashes(here / "out") == hashes(here / "undisturbed")
    assert_equal_tables(here / "out", here / "undisturbed")


def test_a_config_that_is_gone_from_the_folder_is_written_again(here: Path, stop: Callable[..., None]) -> None:
    stop("run", "small.toml", *QUIETLY, "--out", "out")
    kept = (here / "out" / "config-small.json").read_bytes()
    (here / "out" / "config-small.json").unlink()

    assert main(["resume", "out"]) == 0
    assert (here / "out" / "config-small.json").read_bytes() == kept


def test_a_name_that_is_too_long_is_no_folder(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["resume", "x" * 300]) == 1
    assert "holds no run of ours" in capsys.readouterr().err
