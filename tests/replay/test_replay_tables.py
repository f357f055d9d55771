"""A folder of tables is run again and compared column by column."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from replay_logs import SMALL, edited, reseal_files, small

from adapters.cli.main import main
from adapters.results import COLUMNS

QUIETLY = ("--no-figures", "-q", "--workers", "1")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folders of a run of two loops, and of a comparison."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "small.json").write_text(small(trials=2, loops=2).to_json())
    agents = {"one": {}, "other": {"plan": {"name": "q_learning"}}}
    (folder / "both.json").write_text(json.dumps({**SMALL, "agents": agents}))
    assert main(["run", str(folder / "small.json"), *QUIETLY, "--out", str(folder / "run")]) == 0
    compare = ["compare", str(folder / "both.json"), "--trials", "3", *QUIETLY, "--out", str(folder / "compare")]
    assert main(compare) == 0
    return folder


@pytest.fixture
def folders(finished: Path, tmp_path: Path) -> Path:
    shutil.copytree(finished, tmp_path / "copy")
    return tmp_path / "copy"


@pytest.fixture
def replay(capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    def run(folder: Path, code: int) -> Any:
        capsys.readouterr()
        assert main(["replay", str(folder), "--json", "-q", "--workers", "1"]) == code
        return json.loads(capsys.readouterr().out)

    return run


def set_value(path: Path, name: str, index: Any, value: float) -> None:
    with np.load(path) as archive:
        arrays = dict(archive)
    arrays[name][index] = value
    np.savez(path, **arrays)
    reseal_files(path.parent)


@pytest.mark.parametrize("kind", ["run", "compare"])
def test_a_folder_that_was_left_as_it_is_has_no_difference(folders: Path, replay: Any, kind: str) -> None:
    found = replay(folders / kind, 0)

    assert found["difference"] is None
    assert found["trials"] == {"run": 4, "compare": 6}[kind]
    assert found["episodes"] == found["trials"] * 12
    if kind == "run":
        result = json.loads((folders / "run" / "result.json").read_text())
        assert (found["log_sha256"], found["q_table_sha256"]) == (result["log_sha256"], result["q_table_sha256"])


@pytest.mark.parametrize("column", COLUMNS)
def test_a_value_that_was_changed_is_named_by_trial_episode_and_column(folders: Path, replay: Any, column: str) -> None:
    table = folders / "run" / "episodes-small.npz"
    row = 1 * 12 + 6  # of the second loop, in episode 7
    if column == "episode":  # the table's shape is read from it
        row = 12 + 1
    with np.load(table) as archive:
        was = archive[column][row].item()
    new = not was if column == "alarm" else was + 3
    set_value(table, column, row, new)

    said = replay(folders / "run", 1)["difference"]

    value = float(new) if isinstance(was, float) else new
    episode = row - 12 + 1
    assert said == (f"agent small, trial 0, loop 1, episode {episode}: {column} is {value} there, and {was} here")


def test_the_first_of_several_differences_is_named(folders: Path, replay: Any) -> None:
    table = folders / "compare" / "episodes-other.npz"
    for row, column in ((2 * 12 + 3, "steps"), (1 * 12 + 8, "td_error"), (1 * 12 + 8, "q_change")):
        set_value(table, column, row, 77)

    said = replay(folders / "compare", 1)["difference"]

    assert said.startswith("agent other, trial 1, episode 9: td_error is 77.0 there, and ")


def test_a_table_with_fewer_trials_is_a_difference(folders: Path, replay: Any) -> None:
    table = folders / "run" / "episodes-small.npz"
    with np.load(table) as archive:
        np.savez(table, **{name: values[:-12] for name, values in archive.items()})
    reseal_files(folders / "run")

    assert (
        "has 3 trials of 12 episodes there, and 4 trials of 12 episodes here"
        in replay(folders / "run", 1)["difference"]
    )


def test_a_q_value_that_was_changed_is_named(folders: Path, replay: Any) -> None:
    set_value(folders / "run" / "q_tables-small.npz", "q_2", (1, 5), 0.125)

    said = replay(folders / "run", 1)["difference"]

    assert said.startswith("agent small, trial 1, loop 0: the Q-value of action 1 in state 5 is 0.125 there, and ")


@pytest.mark.parametrize("where", ["whole", "trial", "agent"])
def test_a_hash_that_was_changed_is_named(folders: Path, replay: Any, where: str) -> None:
    path = folders / ("compare" if where == "agent" else "run") / "result.json"
    with edited(path) as result:
        entry = {
            "whole": lambda: result,
            "trial": lambda: result["trials"][3],
            "agent": lambda: result["agents"]["one"],
        }
        entry[where]()["q_table_sha256"] = "0" * 64

    said = replay(path.parent, 1)["difference"]

    named = {"whole": "", "trial": ", trial 1", "agent": ", agent one"}[where]
    assert said.startswith(f"{path}{named}: q_table_sha256 is {'0' * 64} there, and ")


def test_the_folder_is_left_as_it_is(folders: Path, replay: Any) -> None:
    before = {path: path.read_bytes() for path in folders.rglob("*") if path.is_file()}

    replay(folders / "run", 0)

    assert {path: path.read_bytes() for path in folders.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(("option", "value"), [("--to", "3"), ("--loop", "0")])
def test_what_needs_a_log_is_refused(
    folders: Path, capsys: pytest.CaptureFixture[str], option: str, value: str
) -> None:
    assert main(["replay", str(folders / "run"), option, value]) == 2
    assert f"{option} needs a log, and {folders / 'run'} has only tables" in capsys.readouterr().err


def test_an_unfinished_folder_is_to_be_finished_first(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folders / "run" / "result.json").unlink()

    assert main(["replay", str(folders / "run")]) == 1
    assert f"finish it with `mapek resume {folders / 'run'}`" in capsys.readouterr().err


def test_other_versions_are_named_beside_a_difference(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    set_value(folders / "run" / "q_tables-small.npz", "q_0", (0, 0), 0.125)
    with edited(folders / "run" / "manifest.json") as manifest:
        here, manifest["versions"]["numpy"] = manifest["versions"]["numpy"], "1.0.0"
    capsys.readouterr()

    assert main(["replay", str(folders / "run"), "-q", "--workers", "1"]) == 1
    assert f"bits are equal for equal versions only: numpy 1.0.0 then, {here} now" in capsys.readouterr().out
