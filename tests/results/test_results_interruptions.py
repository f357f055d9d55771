"""A run that is killed, interrupted or crowded out leaves what is finished, and goes on from there."""

import contextlib
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from real_runs import (
    MANY,
    children_of,
    contents,
    finished_chunks,
    leftovers,
    little_room,
    result_of,
    results_in,
    run,
    running,
    wait_for_a_chunk,
    wait_until_gone,
)

from adapters.cli.main import main
from adapters.results import COLUMNS, read_episodes
from adapters.results.chunk import read_arrays


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that nothing happened to."""
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    assert main([*MANY, "--workers", "1", "--out", str(out)]) == 0
    return out


def continue_in(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    """Give the command again, in this process and with one worker: neither may make a difference."""
    monkeypatch.chdir(folder)
    capsys.readouterr()
    assert main([*MANY, "--workers", "1", "--out", "out"]) == 0
    return capsys.readouterr().out


def assert_equal_runs(found: Path, expected: Path) -> None:
    assert result_of(found) == result_of(expected)
    table, other = (read_episodes(folder / "episodes-frozen_lake.npz") for folder in (found, expected))
    for column in COLUMNS:
        np.testing.assert_array_equal(table[column], other[column], err_msg=column)
    tables, others = (dict(np.load(folder / "q_tables-frozen_lake.npz")) for folder in (found, expected))
    assert sorted(tables) == sorted(others)
    for name, values in tables.items():
        np.testing.assert_array_equal(values, others[name], err_msg=name)
    assert sorted(contents(found)) == sorted(contents(expected))


def test_a_killed_run_is_continued_by_the_same_command_and_comes_to_the_same(
    tmp_path: Path, undisturbed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    with running(*MANY, "--out", "out", cwd=tmp_path) as process:
        wait_for_a_chunk(process, out)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    kept = len(finished_chunks(out))
    assert not (out / "result.json").exists()

    said = continue_in(tmp_path, monkeypatch, capsys)

    assert said.startswith(f"continuing in out: {kept} trials are finished already\n")
    assert_equal_runs(out, undisturbed)
    assert leftovers(out) == []


def test_workers_leave_when_their_parent_is_killed(tmp_path: Path) -> None:
    with running(*MANY, "--out", "out", cwd=tmp_path) as process:
        wait_for_a_chunk(process, tmp_path / "out")
        children = children_of(process.pid)
        assert len(children) >= 2
        process.kill()
        process.wait()
        wait_until_gone(children)


@pytest.mark.parametrize("times", [1, pytest.param(2, marks=pytest.mark.long)])
def test_ctrl_c_ends_with_130_names_the_folder_and_how_to_go_on_and_keeps_what_is_finished(
    tmp_path: Path, undisturbed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], times: int
) -> None:
    out = tmp_path / "out"
    with running(*MANY, "--out", "out", cwd=tmp_path) as process:
        wait_for_a_chunk(process, out)
        for _ in range(times):
            with contextlib.suppress(subprocess.TimeoutExpired):
                os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to parent and workers
                process.wait(0.02)
        said, complaint = process.communicate(timeout=60)

    assert process.returncode == 130, complaint
    kept = len(finished_chunks(out))
    *waited, last = complaint.splitlines()
    assert last == f"mapek: stopped. {kept} of 16 trials are finished and kept in out; `mapek resume out` continues."
    assert all("waiting for" in line for line in waited)  # said where the machine took more than a moment
    assert said == ""
    assert kept >= 1
    assert leftovers(out) == []
    assert not (out / "result.json").exists()
    assert f"continuing in out: {kept} trials" in continue_in(tmp_path, monkeypatch, capsys)
    assert_equal_runs(out, undisturbed)


def test_sigterm_leaves_nothing_half_written_under_a_final_name(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with running(*MANY, "--out", "out", cwd=tmp_path) as process:
        wait_for_a_chunk(process, out)
        children = children_of(process.pid)
        process.terminate()
        process.wait()
        wait_until_gone(children)

    assert process.returncode == -signal.SIGTERM
    assert not list(out.glob("*.npz"))
    assert not (out / "result.json").exists()
    for chunk in finished_chunks(out):
        # Each says how long its rows are, and what their hash is.
        assert results_in(chunk) is not None
        assert set(read_arrays(chunk.with_suffix(""))) == {f"q_{int(chunk.stem[:8])}", f"actions_{int(chunk.stem[:8])}"}


@pytest.mark.long
def test_a_second_run_into_a_folder_in_use_is_refused_and_the_first_ends_well(
    tmp_path: Path, undisturbed: Path
) -> None:
    out = tmp_path / "out"
    with running(*MANY, "--out", "out", cwd=tmp_path) as first:
        wait_for_a_chunk(first, out)
        os.killpg(first.pid, signal.SIGSTOP)  # else it might be over before the second begins
        second = run(*MANY, "--out", "out", cwd=tmp_path, code=1)
        os.killpg(first.pid, signal.SIGCONT)
        said, complaint = first.communicate()

    names = r"mapek: another run is writing to out( \(process (\d+)\))?; wait for it, or choose another --out\n"
    assert (found := re.fullmatch(names, second.stderr)), second.stderr
    if os.path.exists("/proc/locks"):
        assert int(found[2]) == first.pid
    assert (first.returncode, complaint) == (0, "")
    assert "results:  out" in said
    assert_equal_runs(out, undisturbed)


@pytest.mark.parametrize("workers", ["1", "2"])
def test_a_disk_that_fills_while_trials_run_is_said_once_and_leaves_no_half_of_a_file(
    tmp_path: Path, workers: str
) -> None:
    # A trial's rows are 19 kB, the manifest and configs below 2.
    full = run(*MANY, "--workers", workers, "--out", "out", cwd=tmp_path, code=1, start=little_room(15_000))

    assert full.stderr.startswith("mapek: ")
    assert "out/chunks/frozen_lake/000000" in full.stderr
    assert ".rows cannot be written: File too large. What was finished before is kept; make room" in full.stderr
    assert full.stderr.count("\n") == 1
    assert [name for name in contents(tmp_path / "out") if not name.endswith((".json", ".lock"))] == []
    assert finished_chunks(tmp_path / "out") == []


def test_a_disk_that_fills_when_the_tables_are_made_keeps_every_trial(
    tmp_path: Path, undisturbed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    full = run(*MANY, "--workers", "1", "--out", "out", cwd=tmp_path, code=1, start=little_room(30_000))

    assert full.stderr.startswith("mapek: out/episodes-frozen_lake.npz cannot be written: File too large. ")
    assert full.stderr.count("\n") == 1
    assert len(finished_chunks(out)) == 16
    assert not list(out.glob("*.npz"))
    assert not (out / "result.json").exists()
    assert leftovers(out) == []

    assert "continuing in out: 16 trials are finished already" in continue_in(tmp_path, monkeypatch, capsys)
    assert_equal_runs(out, undisturbed)


SMALL = ("run", MANY[1], "--set", "episodes=20", "--no-figures", "-q")


def test_json_onto_a_full_device_is_said_and_the_folder_is_complete(tmp_path: Path) -> None:
    full = run(*SMALL, "--out", "out", "--json", "/dev/full", cwd=tmp_path, code=1)

    assert full.stderr == (
        "mapek: /dev/full cannot be written: No space left on device. The run is complete; all of it is in out.\n"
    )
    assert result_of(tmp_path / "out")["passes"] == 20


def test_json_that_does_not_fit_leaves_the_earlier_file(tmp_path: Path) -> None:
    (tmp_path / "found.json").write_text("earlier")
    # The result is 5 kB long for 20 trials, and so is the one in the folder: nothing of the two may be there by half.
    full = run(
        *SMALL, "--trials", "20", "--out", "out", "--json", "found.json", cwd=tmp_path, code=1, start=little_room(4_000)
    )

    assert "cannot be written: File too large" in full.stderr
    assert "Traceback" not in full.stderr
    assert (tmp_path / "found.json").read_text() == "earlier"
    assert not (tmp_path / "out" / "result.json").exists()
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize("command", [(*SMALL, "--out", "out", "--json", "-"), ("list",)], ids=["run", "list"])
def test_standard_output_that_is_full_is_said(tmp_path: Path, command: tuple[str, ...]) -> None:
    start = ("bash", "-c", f'exec {sys.executable} -m mape "$@" > /dev/full', "bash")
    full = run(*command, cwd=tmp_path, code=1, start=start)

    kept = "" if command == ("list",) else " The run is complete; all of it is in out."
    assert full.stderr.splitlines()[-1] == (
        f"mapek: standard output cannot be written: No space left on device. Lead it to another place.{kept}"
    )
    assert "Traceback" not in full.stderr
    assert "Exception ignored" not in full.stderr
    assert command == ("list",) or result_of(tmp_path / "out")["passes"] == 20


SHOWN = (*SMALL, "--set", "episodes=2000", "--show", "1:2000", "--out", "out")


def test_standard_output_that_is_full_while_trials_run_is_not_blamed_on_the_results(tmp_path: Path) -> None:
    start = ("bash", "-c", f'exec {sys.executable} -m mape "$@" > /dev/full', "bash")
    full = run(*SHOWN, cwd=tmp_path, code=1, start=start)

    assert full.stderr == (
        "mapek: standard output cannot be written: No space left on device. Lead it to another place. "
        "0 of 1 trials are finished and kept in out; `mapek resume out` continues.\n"
    )
    assert leftovers(tmp_path) == []


def test_a_reader_of_a_run_that_leaves_early_is_told_how_to_go_on(tmp_path: Path) -> None:
    start = ("bash", "-c", f'set -o pipefail; {sys.executable} -m mape "$@" | head -1', "bash")
    left = run(*SHOWN, cwd=tmp_path, code=1, start=start)

    assert left.stdout.startswith("--- pass 1")
    assert left.stderr == (
        "mapek: nobody reads standard output any more. "
        "0 of 1 trials are finished and kept in out; `mapek resume out` continues.\n"
    )
    assert leftovers(tmp_path) == []


def test_a_run_that_a_fault_of_a_part_has_stopped_goes_on_with_the_mended_part_once_the_user_says_so(
    tmp_path: Path,
) -> None:
    part = tmp_path / "flaky.py"
    text = (
        "from mape.monitor.page_hinkley import PageHinkley\n\n"
        "class Flaky(PageHinkley):\n"
        "    seen = 0\n"
        "    def update(self, x):\n"
        "        Flaky.seen += 1\n"
        "        assert Flaky.seen < {limit}, 'worn out'\n"
        "        return super().update(x)\n"
    )
    part.write_text(faulty := text.format(limit=1000))
    command = (
        *MANY, "--trials", "4", "--workers", "1", "--set", 'monitor.detectors=["flaky:Flaky"]', "--out", "out",
    )  # fmt: skip

    failed = run(*command, cwd=tmp_path, code=1)
    assert "mapek: trial 2: detector Flaky raised AssertionError: worn out, at pass 200 on return = " in failed.stderr
    assert len(kept := finished_chunks(tmp_path / "out")) == 2
    assert leftovers(tmp_path / "out") == []

    part.write_text(text.format(limit=10**9))
    refused = run(*command, cwd=tmp_path, code=1).stderr
    assert "another version of module 'flaky'" in refused
    assert refused.endswith("`mapek resume out --mended`\n")
    assert finished_chunks(tmp_path / "out") == kept
    again = run("resume", "out", "--mended", cwd=tmp_path)
    assert f"continuing in {tmp_path / 'out'}: 2 trials are finished already" in again.stdout
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["modules"] == {"flaky": hashlib.sha256(part.read_bytes()).hexdigest()}
    assert manifest["mended"] == [{"module": "flaky", "sha256": hashlib.sha256(faulty.encode()).hexdigest()}]
    run(*command[:-1], "undisturbed", cwd=tmp_path)
    assert result_of(tmp_path / "out") == result_of(tmp_path / "undisturbed")


def test_a_trial_that_fails_leaves_the_trials_before_it_and_its_own_passes(tmp_path, monkeypatch):
    (tmp_path / "late_fault.py").write_text(
        "class LateFault:\n"
        "    direction, statistic = 'down', None\n"
        "    seen = 0\n"
        "    def update(self, x):\n"
        "        LateFault.seen += 1\n"
        "        if LateFault.seen > 250: raise RuntimeError('no more')\n"
        "        return False\n"
        "    def reset(self): pass\n"
        "    def state(self): return None\n"
        "    def restore(self, state): pass\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    config = Path(__file__).parents[2] / "examples" / "gridworld_goals.toml"
    line = 'monitor.detectors=["late_fault:LateFault"]'
    code = main(
        ["run", str(config), "--set", line, "--set", "episodes=100", "--trials", "4", "--workers", "1", "--out", "out"]
    )
    assert code == 1
    chunks = tmp_path / "out" / "chunks" / "gridworld_goals"
    finished = [trial.trial for stem in chunks.glob("*.json") for trial in results_in(stem)]
    assert finished == [0, 1]
    with np.load(chunks / "broken-2.npz") as broken:
        assert broken["episode"].tolist() == list(range(1, 51))
        assert set(broken["trial"].tolist()) == {2}
