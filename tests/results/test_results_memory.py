"""Memory does not grow with the number of episodes."""

import os
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from adapters.cli.main import main
from adapters.results.chunk import _break_off
from adapters.results.files import whole
from adapters.results.folder import default_path
from adapters.results.table import COLUMNS, DTYPE, read_episodes, read_last, write_npz
from mape.errors import ResultsError

TRIALS, EPISODES = 3, 140_000


def rows_of(trial: int, episodes: int = EPISODES) -> np.ndarray:
    rows = np.zeros(episodes, DTYPE)
    rows["trial"] = trial
    rows["episode"] = np.arange(1, episodes + 1)
    rows["return"] = 1000.0 * trial + np.arange(episodes) % 7
    return rows


@pytest.fixture(scope="module")
def chunks(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("chunks")
    first, second = folder / "0.rows", folder / "2.rows"
    with open(first, "wb") as file:
        rows_of(0).tofile(file)
        rows_of(1).tofile(file)
    rows_of(2).tofile(second)
    return [first, second]


@pytest.fixture
def peak():
    """Most memory that was taken since, in MB."""
    tracemalloc.start()
    yield lambda: tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()


def test_a_table_is_written_and_its_end_read_in_blocks(tmp_path: Path, chunks: list[Path], peak) -> None:
    write_npz(tmp_path / "table.npz", chunks, TRIALS * EPISODES)  # 19 MB of rows
    last = read_last(tmp_path / "table.npz", "return", 100)
    assert peak() < 8.0

    table = read_episodes(tmp_path / "table.npz")
    for trial in range(TRIALS):
        for name, column in table.items():
            np.testing.assert_array_equal(column[trial], rows_of(trial)[name])
    np.testing.assert_array_equal(last, table["return"][:, -100:])


def test_reading_a_column_takes_little_more_than_that_column(tmp_path: Path, chunks: list[Path], peak) -> None:
    write_npz(tmp_path / "table.npz", chunks, TRIALS * EPISODES)
    tracemalloc.reset_peak()
    assert read_episodes(tmp_path / "table.npz", ["alarm"])["alarm"].shape == (TRIALS, EPISODES)
    assert peak() < 2.5  # the column is 0.4 MB, that of the trials 1.7 MB


def test_the_rows_of_a_broken_trial_are_moved_in_blocks(tmp_path: Path, peak) -> None:
    with whole(tmp_path / "0.rows") as file:
        file.write(rows_of(0, 10).tobytes())
        for _ in range(20):
            file.write(rows_of(1, 20_000).tobytes())
        tracemalloc.reset_peak()
        _break_off(file, 10, tmp_path / "broken-1.npz")  # 18 MB
        file.write(rows_of(2, 1).tobytes())
    assert peak() < 8.0
    np.testing.assert_array_equal(np.fromfile(tmp_path / "0.rows", DTYPE)["trial"], [0] * 10 + [2])
    with np.load(tmp_path / "broken-1.npz") as broken:
        assert tuple(broken.files) == COLUMNS
        assert len(broken["trial"]) == 400_000
        assert set(broken["trial"].tolist()) == {1}


@pytest.mark.parametrize("episodes", [7, 100, 101, 65_536])
def test_the_last_episodes_are_those_of_each_trial(tmp_path: Path, episodes: int) -> None:
    for trial in range(3):
        rows_of(trial, episodes).tofile(tmp_path / f"{trial}.rows")
    write_npz(tmp_path / "table.npz", [tmp_path / f"{trial}.rows" for trial in range(3)], 3 * episodes)
    tail = min(100, episodes)
    found = read_last(tmp_path / "table.npz", "return", tail)
    np.testing.assert_array_equal(found, [rows_of(trial, episodes)["return"][-tail:] for trial in range(3)])


def test_a_table_whose_trials_are_not_all_there_is_refused(tmp_path: Path) -> None:
    rows_of(0, 5).tofile(tmp_path / "0.rows")
    rows_of(1, 4).tofile(tmp_path / "1.rows")
    write_npz(tmp_path / "table.npz", [tmp_path / "0.rows", tmp_path / "1.rows"], 9)
    with pytest.raises(ResultsError, match="9 rows are of no whole number of episodes for 2 trials"):
        read_episodes(tmp_path / "table.npz")


def test_the_report_of_a_run_reads_no_whole_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("adapters.results.folder.read_episodes", None)
    example = Path(__file__).parents[2] / "examples" / "gridworld_goals.toml"
    run = ["run", str(example), "--set", "episodes=40", "--no-figures", "--out", str(tmp_path / "out")]
    assert main(run) == 0
    mean = read_episodes(tmp_path / "out" / "episodes-gridworld_goals.npz")["return"].mean()
    assert f"return:   {mean:,.2f}, mean of the last 40 episodes" in capsys.readouterr().out


def test_a_folder_name_is_taken_by_whoever_asks_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("time.strftime", lambda form: "20260101-000000")
    taken = [default_path("run") for _ in range(3)]
    assert [path.name for path in taken] == [f"run-20260101-000000{end}" for end in ("", "-2", "-3")]
    assert all(path.is_dir() and not os.listdir(path) for path in taken)


def test_results_that_are_no_folder_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "results").write_text("")
    with pytest.raises(ResultsError, match="results is a file"):
        default_path("run")


PROGRAM = """
import sys
from pathlib import Path
from adapters.results import RunFolder
from adapters.results.chunk import run_chunk
from mape.config import load
config = load(sys.argv[1], overrides=[f"episodes={sys.argv[2]}"])
with RunFolder(Path(sys.argv[3]), "run", {"one": config}) as folder:
    run_chunk(config.to_json(), 0, 1, folder.chunk_stem("one", 0, 1))
    folder.assemble("one")
    folder.last_episodes("one", "return", 100)
# Not `resource.getrusage`: its maximum holds that of the process that started this one.
(line,) = (line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(int(line.split()[1]) / 1024)
"""


@pytest.mark.long
def test_a_worker_needs_no_more_memory_for_twenty_times_the_episodes(tmp_path: Path) -> None:
    example = Path(__file__).parents[2] / "examples" / "gridworld_goals.toml"
    most = []
    for episodes in (20_000, 20_000, 400_000):  # the first one compiles, where nothing is in the cache yet
        arguments = [str(example), str(episodes), str(tmp_path / f"out-{len(most)}")]
        done = subprocess.run([sys.executable, "-c", PROGRAM, *arguments], capture_output=True, text=True, check=True)
        most.append(float(done.stdout))
    assert most[2] < 200.0
    assert most[2] - most[1] < 8.0
