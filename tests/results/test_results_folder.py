"""The folder of a run: whose it is, what may be written there, and what a damaged file is answered with."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from real_runs import contents, leftovers
from replay_logs import SMALL, edited

from adapters.cli.main import main
from adapters.results import COLUMNS, RunFolder, read_episodes
from adapters.results.chunk import read_arrays, read_chunk, run_chunk
from adapters.results.files import read_json
from mape.config import Config, from_table, load
from mape.errors import ResultsError

CONFIG = """\
name = "small"
episodes = 6

[system]
id = "mapek/Gridworld-v0"
options = { size = [3, 3], start = [0, 0], goals = [[2, 2]], max_steps = 10 }

[monitor]
detectors = [{ name = "page_hinkley", threshold = 3.0 }]

[execute]
engine = "python"
"""


@pytest.fixture
def config_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "small.toml"
    path.write_text(CONFIG)
    return path


def mapek_run(*more: str) -> int:
    return main(["run", "small.toml", "--no-figures", "-q", "--workers", "1", "--trials", "3", *more])


@pytest.fixture
def finished(config_file: Path) -> Path:
    assert mapek_run("--out", "out") == 0
    return Path("out")


@pytest.fixture
def unfinished(config_file: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a run whose chunks are all there, and whose tables are not made yet."""

    def stop(folder: RunFolder, agent: str) -> None:
        raise ResultsError("stopped here")

    with monkeypatch.context() as context:
        context.setattr(RunFolder, "assemble", stop)
        assert mapek_run("--out", "out") == 1
    return Path("out")


def complaint(capsys: pytest.CaptureFixture[str], code: int, *more: str) -> str:
    capsys.readouterr()
    assert mapek_run(*more) == code
    said = capsys.readouterr().err
    assert said.startswith("mapek: ")
    return said.removeprefix("mapek: ").rstrip("\n")


def test_a_finished_folder_is_refused_and_stays_as_it_is(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(finished)

    said = complaint(capsys, 1, "--out", "out")

    assert said == "out holds a finished run, which is left as it is; choose another --out"
    assert contents(finished) == before
    assert set(before) == {
        ".lock", "manifest.json", "config-small.json", "episodes-small.npz", "q_tables-small.npz", "result.json",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("override", "difference"),
    [
        ("seed=3", "agents.small.seed = 0, not 3"),
        ("plan.alpha=0.2", "agents.small.plan.alpha = nothing, not 0.2"),
        ("system.options.max_steps=9", "agents.small.system.options.max_steps = 10, not 9"),
    ],
)
def test_an_unfinished_folder_of_another_config_is_refused_by_the_first_difference(
    unfinished: Path, capsys: pytest.CaptureFixture[str], override: str, difference: str
) -> None:
    before = contents(unfinished)
    more = ("--set", "plan.name=morphin") if override.startswith("plan") else ()

    said = complaint(capsys, 1, "--out", "out", *more, "--set", override)

    assert said.startswith(f"out holds an unfinished run with {difference}; give the same command to continue it")
    assert contents(unfinished) == before


def test_an_unfinished_folder_of_another_command_is_refused(
    unfinished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("other.toml").write_text(CONFIG.replace("small", "other"))

    capsys.readouterr()
    assert main(["compare", "small.toml", "other.toml", "-q", "--no-figures", "--workers", "1", "--out", "out"]) == 1
    assert "an unfinished run with kind = 'run', not 'compare'" in capsys.readouterr().err


def test_an_unfinished_folder_of_other_versions_is_refused(
    unfinished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with edited(unfinished / "manifest.json") as manifest:
        here, manifest["versions"]["numpy"] = manifest["versions"]["numpy"], "1.0.0"

    assert f"versions.numpy = '1.0.0', not '{here}'" in complaint(capsys, 1, "--out", "out")


@pytest.mark.parametrize("name", ["letter.txt", "manifest.txt", "draft.part", ".hidden", "chunks/one.rows"])
def test_a_folder_that_is_not_ours_is_refused_and_nothing_is_put_into_it(
    config_file: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    file = Path("theirs", name)
    file.parent.mkdir(parents=True)
    file.write_text("dear diary")
    before = contents(Path("theirs"))

    said = complaint(capsys, 1, "--out", "theirs")

    assert said == f"theirs is not empty ({name.split('/')[0]}) and holds no run of ours; choose another --out"
    assert contents(Path("theirs")) == before


@pytest.mark.parametrize("text", ["[1, 2]", '{"name": "an extension"}', "3"])
def test_a_manifest_that_is_not_ours_is_refused(
    config_file: Path, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    Path("theirs").mkdir()
    Path("theirs/manifest.json").write_text(text)

    assert complaint(capsys, 1, "--out", "theirs") == "theirs/manifest.json is of no run of ours; choose another --out"
    assert Path("theirs/manifest.json").read_text() == text


def test_an_empty_folder_is_taken_and_so_is_what_a_run_left_that_was_killed_at_once(config_file: Path) -> None:
    Path("out").mkdir()
    Path("out/.lock").touch()
    Path("out/config-small.json").write_text("{}")
    Path("out/manifest.json.4711.part").write_text("{")

    assert mapek_run("--out", "out") == 0
    assert leftovers(Path("out")) == []
    assert load("out/config-small.json").name == "small"


def test_an_unfinished_run_is_continued_without_doing_anything_twice(
    unfinished: Path, finished_elsewhere: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(unfinished)
    capsys.readouterr()

    assert mapek_run("--out", "out") == 0

    assert "continuing in out: 3 trials are finished already" in capsys.readouterr().out
    assert before.keys() - contents(unfinished).keys() == {name for name in before if name.startswith("chunks/")}
    found = json.loads((unfinished / "result.json").read_text())
    assert {key: found[key] for key in finished_elsewhere} == finished_elsewhere


def test_a_run_of_several_loops_is_continued_with_those_that_are_missing(
    config_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config_file.write_text("loops = 4\n" + CONFIG)
    assert mapek_run("--out", "elsewhere") == 0

    def stop(*task: object, **listeners: object) -> None:
        if task[1] == 5:
            raise ResultsError("stopped here")
        run_chunk(*task, **listeners)

    monkeypatch.setattr("adapters.experiments.runner.CHUNK_SECONDS", 1e-9)  # a chunk of each unit
    with monkeypatch.context() as context:
        context.setattr("adapters.experiments.runner.run_chunk", stop)
        assert mapek_run("--out", "out") == 1
    with RunFolder(Path("out"), "run", config_of(Path("out"))) as begun:
        assert sorted(begun.finished("small")) == [0, 1, 2, 3, 4]
    capsys.readouterr()
    assert mapek_run("--out", "out") == 0

    assert "continuing in out: 5 trials are finished already" in capsys.readouterr().out
    found, wanted = (json.loads(Path(folder, "result.json").read_text()) for folder in ("out", "elsewhere"))
    assert [found[name] for name in ("trials", "log_sha256")] == [wanted[name] for name in ("trials", "log_sha256")]
    assert [(one["trial"], one["loop"]) for one in found["trials"]] == [divmod(unit, 4) for unit in range(12)]
    table, other = (
        read_episodes(f"{folder}/episodes-small.npz", (*COLUMNS, "loop")) for folder in ("out", "elsewhere")
    )
    for name, column in table.items():
        np.testing.assert_array_equal(column, other[name], err_msg=name)


@pytest.fixture
def finished_elsewhere(config_file: Path) -> dict[str, object]:
    assert mapek_run("--out", "elsewhere") == 0
    found = json.loads(Path("elsewhere/result.json").read_text())
    return {key: found[key] for key in ("trials", "log_sha256", "q_table_sha256")}


def the_chunk(folder: Path, ending: str) -> Path:
    (path,) = folder.glob(f"chunks/small/*{ending}")
    return path


@pytest.mark.parametrize(
    ("ending", "says"),
    [(".json", "is damaged"), (".rows", "is cut short"), (".npz", "was changed after it was written")],
)
@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_chunk_that_is_cut_short_is_named_and_runs_again_once_it_is_deleted(
    unfinished: Path,
    finished_elsewhere: dict[str, object],
    capsys: pytest.CaptureFixture[str],
    ending: str,
    says: str,
    share: float,
) -> None:
    chunk = the_chunk(unfinished, ending)
    os.truncate(chunk, int(chunk.stat().st_size * share))

    said = complaint(capsys, 1, "--out", "out")

    assert f"{chunk} {says}" in said
    assert "elete" in said
    for file in unfinished.glob("chunks/small/*"):
        file.unlink()
    assert mapek_run("--out", "out") == 0
    found = json.loads((unfinished / "result.json").read_text())
    assert {key: found[key] for key in finished_elsewhere} == finished_elsewhere


@pytest.mark.parametrize("ending", [".rows", ".npz"])
def test_a_chunk_with_a_file_missing_is_said(unfinished: Path, capsys: pytest.CaptureFixture[str], ending: str) -> None:
    chunk = the_chunk(unfinished, ending)
    chunk.unlink()

    said = complaint(capsys, 1, "--out", "out")

    assert str(chunk) in said
    assert "delete it to have these trials run again" in said


def test_a_chunk_whose_end_was_never_written_runs_again(
    unfinished: Path, finished_elsewhere: dict[str, object]
) -> None:
    the_chunk(unfinished, ".json").unlink()

    assert mapek_run("--out", "out") == 0
    found = json.loads((unfinished / "result.json").read_text())
    assert {key: found[key] for key in finished_elsewhere} == finished_elsewhere


@pytest.mark.parametrize("ending", [".rows", ".npz"])
def test_a_bit_that_changed_on_disk_is_noticed(
    unfinished: Path, capsys: pytest.CaptureFixture[str], ending: str
) -> None:
    chunk = the_chunk(unfinished, ending)
    data = bytearray(chunk.read_bytes())
    data[len(data) // 3] ^= 1
    chunk.write_bytes(data)

    assert str(chunk) in complaint(capsys, 1, "--out", "out")
    assert not (unfinished / "result.json").exists()


@pytest.mark.parametrize("text", ["", "{", '{"format": 1, "ki'])
def test_a_manifest_that_is_cut_short_is_named(unfinished: Path, capsys: pytest.CaptureFixture[str], text: str) -> None:
    (unfinished / "manifest.json").write_text(text)

    said = complaint(capsys, 1, "--out", "out")

    assert said.startswith("out/manifest.json is damaged (")
    assert said.endswith("choose another --out")


def test_a_result_that_is_cut_short_is_named_by_who_reads_it_and_still_counts_as_finished(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.truncate(finished / "result.json", 30)

    with pytest.raises(ResultsError, match=r"out/result\.json is damaged"):
        read_json(finished / "result.json")
    assert "out holds a finished run" in complaint(capsys, 1, "--out", "out")


def test_a_table_is_read_whole_or_not_at_all_wherever_it_is_cut(finished: Path) -> None:
    table = finished / "episodes-small.npz"
    data = table.read_bytes()
    for length in range(0, len(data), 97):
        table.write_bytes(data[:length])
        with pytest.raises(ResultsError, match=r"out/episodes-small\.npz (is no whole table|was changed)"):
            read_episodes(table)
    table.write_bytes(data)
    assert set(read_episodes(table)) == set(COLUMNS)


def config_of(folder: Path) -> dict[str, Config]:
    return {"small": load(folder / "config-small.json")}


def test_q_tables_that_are_cut_short_are_named(unfinished: Path) -> None:
    with RunFolder(unfinished, "run", config_of(unfinished)) as folder:
        folder.assemble("small")
        tables = folder.q_tables("small")
        assert [tables[trial][0].shape for trial in range(3)] == [(4, 9)] * 3
        os.truncate(unfinished / "q_tables-small.npz", 500)
        with pytest.raises(ResultsError, match=r"out/q_tables-small\.npz (is damaged|was changed)"):
            folder.q_tables("small")


def test_a_column_that_there_is_not_is_refused_with_those_there_are(finished: Path) -> None:
    with pytest.raises(ResultsError, match=r"no column 'rewards'; it has trial, episode, steps, return"):
        read_episodes(finished / "episodes-small.npz", ["rewards"])


def test_a_table_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match=r"gone\.npz"):
        read_episodes(tmp_path / "gone.npz")


def test_a_chunk_that_is_not_there_is_none(tmp_path: Path) -> None:
    assert read_chunk(tmp_path / "00000000-00000000", from_table(SMALL)) is None


def test_a_chunk_gives_the_arrays_that_were_written(unfinished: Path) -> None:
    arrays = read_arrays(the_chunk(unfinished, ".json").with_suffix(""))

    assert {name: array.shape for name, array in arrays.items()} == {
        name: shape for trial in range(3) for name, shape in ((f"q_{trial}", (4, 9)), (f"actions_{trial}", (4,)))
    }


def test_a_folder_can_be_moved_and_continued_under_its_new_name(unfinished: Path) -> None:
    shutil.move("out", "moved")

    assert mapek_run("--out", "moved") == 0


def test_two_folders_in_one_process_exclude_each_other(unfinished: Path) -> None:
    with RunFolder(unfinished, "run", config_of(unfinished)) as folder:
        assert folder.resumed == 3
        with pytest.raises(ResultsError, match="another run is writing to out"):
            RunFolder(unfinished, "run", config_of(unfinished))
    RunFolder(unfinished, "run", config_of(unfinished)).close()


def test_a_trace_holds_each_step_of_the_traced_episodes_of_trial_0(config_file: Path) -> None:
    assert mapek_run("--out", "out", "--trace", "2:4") == 0

    trace = np.load("out/trace-small.npy")
    assert trace.dtype.names == ("episode", "state", "action", "exploratory", "q", "td_error", "alpha")
    steps = read_episodes("out/episodes-small.npz", ["steps"])["steps"][0]
    assert np.bincount(trace["episode"]).tolist() == [0, 0, *steps[1:4]]
    assert np.isfinite(trace["td_error"]).all()
    assert set(trace["action"]) <= {0, 1, 2, 3}
