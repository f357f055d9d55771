"""The per-episode table says what the log says."""

import json
from pathlib import Path

import numpy as np
import pytest

from adapters.cli.main import main
from adapters.results import COLUMNS, read_episodes
from adapters.systems import make_system
from mape.config import load
from mape.loop import Loop

EXAMPLES = Path(__file__).parents[2] / "examples"
EPISODES, TRIALS = 330, 2


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that meets one drift."""
    folder = tmp_path_factory.mktemp("table") / "out"
    arguments = [
        "run",
        str(EXAMPLES / "gridworld_goals.toml"),
        "--set",
        f"episodes={EPISODES}",
        "--trials",
        str(TRIALS),
    ]
    assert main([*arguments, "--workers", "1", "--no-figures", "-q", "--out", str(folder)]) == 0
    return folder


def test_every_column_has_a_number_for_each_trial_and_episode(out: Path) -> None:
    table = read_episodes(out / "episodes-gridworld_goals.npz")

    assert tuple(table) == COLUMNS
    assert {column.shape for column in table.values()} == {(TRIALS, EPISODES)}
    assert all(np.isfinite(column).all() for column in table.values())
    np.testing.assert_array_equal(table["trial"], [[trial] * EPISODES for trial in range(TRIALS)])
    np.testing.assert_array_equal(table["episode"], [range(1, EPISODES + 1)] * TRIALS)


def test_sums_and_alarms_are_those_of_the_result(out: Path) -> None:
    table = read_episodes(out / "episodes-gridworld_goals.npz")
    trials = json.loads((out / "result.json").read_text())["trials"]

    assert [trial["total_steps"] for trial in trials] == table["steps"].sum(axis=1).tolist()
    for trial, alarm in zip(trials, table["alarm"], strict=True):
        assert trial["alarms"] == (np.flatnonzero(alarm) + 1).tolist()
        assert trial["alarms"] != []


def test_each_row_is_the_pass_of_the_log(out: Path) -> None:
    table = read_episodes(out / "episodes-gridworld_goals.npz")
    config = load(EXAMPLES / "gridworld_goals.toml", overrides=[f"episodes={EPISODES}", "trials=2"])
    for trial in range(TRIALS):
        loop = Loop(config, make_system(config.system), trial)
        for episode in range(EPISODES):
            loop.run(1)
            seen, symptom, _, _ = loop.log.window[-1]
            row = {name: column[trial, episode] for name, column in table.items()}
            assert (row["episode"], row["steps"], row["epsilon"]) == (seen.pass_no, seen.steps, seen.epsilon)
            assert (row["return"], row["td_error"], row["q_change"]) == (
                seen.signals["return"], seen.signals["td_error"], seen.signals["q_change"],
            ), f"trial {trial}, episode {episode + 1}"  # fmt: skip
            assert row["alarm"] == any(reading.alarm for reading in symptom.readings)
            assert row["actions"] == len(seen.available)


def test_exploration_begins_at_1_and_again_after_each_alarm(out: Path) -> None:
    table = read_episodes(out / "episodes-gridworld_goals.npz", ["epsilon", "alarm"])

    assert table["epsilon"][:, 0].tolist() == [1.0] * TRIALS
    assert (np.diff(table["epsilon"][:, :100]) < 0).all()
    after = table["epsilon"][:, 1:][table["alarm"][:, :-1]]
    assert len(after) >= TRIALS
    assert (after == 1.0).all()


def test_the_return_follows_from_the_steps_where_the_rewards_are_known(out: Path) -> None:
    table = read_episodes(out / "episodes-gridworld_goals.npz", ["steps", "return"])

    found = table["return"] > 0
    np.testing.assert_array_equal(table["return"][found], 101.0 - table["steps"][found])
    np.testing.assert_array_equal(table["return"][~found], -37.0)
    assert table["steps"].min() == 8


def test_actions_are_counted_as_they_come(tmp_path: Path) -> None:
    arguments = ["run", str(EXAMPLES / "jump.toml"), "--set", "episodes=6", "--set", "system.options.jump_from=4"]
    assert main([*arguments, "--no-figures", "-q", "--out", str(tmp_path / "out")]) == 0

    actions = read_episodes(tmp_path / "out" / "episodes-jump.npz", ["actions"])["actions"]
    assert actions.tolist() == [[4, 4, 4, 8, 8, 8]]


def test_the_table_is_written_in_blocks_whatever_the_number_of_episodes(tmp_path):
    import tracemalloc

    from adapters.results.table import BLOCK, DTYPE, write_npz

    chunk = tmp_path / "c.rows"
    rows = 8 * BLOCK
    with open(chunk, "wb") as file:
        for first in range(1, rows, BLOCK):
            block = np.zeros(BLOCK, DTYPE)
            block["episode"] = np.arange(first, first + BLOCK)
            file.write(block.tobytes())
    tracemalloc.start()
    write_npz(tmp_path / "t.npz", [chunk], rows)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * BLOCK * DTYPE.itemsize
    assert read_episodes(tmp_path / "t.npz", ["steps"])["steps"].shape == (1, rows)
