"""Swaps in the running loop, and several loops in one run, by the command line."""

import io
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import EXAMPLES, Mapek

from adapters.results import COLUMNS, read_episodes
from adapters.systems import make_system
from mape.config import load
from mape.trials import combined_hash, run_trial

GOALS = EXAMPLES / "gridworld_goals.toml"
QUIETLY = ("--no-figures", "-q", "--workers", 1)
PIPED = (*QUIETLY, "--json", "-")
SWAPS = (
    "--set",
    'swap=[{pass=4, part="plan", to={name="morphin", alpha=0.4}}, {pass=7, part="monitor", to="two_window"},'
    ' {pass=7, part="learner", to="expected_sarsa"}]',
)
SENTENCES = [
    "pass 4: plan is now morphin (alpha = 0.4), with the state of the one before",
    "pass 7: monitor is now two_window, without the state of the one before",
    "pass 7: learner is now expected_sarsa, and the Q-table goes on",
]


def test_run_says_each_swap_once_however_many_trials_and_workers_there_are(mapek: Mapek) -> None:
    for workers in (1, 2):
        outcome = mapek("run", GOALS, "--set", "episodes=9", *SWAPS, "--trials", 4, *QUIETLY[:2], "--workers", workers)
        assert outcome.code == 0, outcome.err
        assert [line for line in outcome.out.splitlines() if line.startswith("pass ")] == SENTENCES


def test_json_tells_the_swaps_that_were_made(mapek: Mapek) -> None:
    swapped = mapek("run", GOALS, "--set", "episodes=9", *SWAPS, *PIPED).json
    plain = mapek("run", GOALS, "--set", "episodes=9", *PIPED).json

    assert swapped["swaps"] == [
        {"pass": 4, "part": "plan", "to": {"name": "morphin", "alpha": 0.4}, "handed_over": True},
        {"pass": 7, "part": "monitor", "to": {"name": "two_window"}, "handed_over": False},
        {"pass": 7, "part": "learner", "to": {"name": "expected_sarsa"}, "handed_over": False},
    ]
    assert "swaps" not in plain
    assert swapped["log_sha256"] != plain["log_sha256"]


def test_step_says_a_swap_before_the_pass_that_it_serves(mapek: Mapek, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n" * 60))
    outcome = mapek("step", GOALS, "--set", "episodes=9", *SWAPS)
    whole = mapek("run", GOALS, "--set", "episodes=9", *SWAPS, *PIPED).json

    said = [line.rpartition("] ")[2] for line in outcome.out.splitlines()]
    for number, sentence in zip((4, 7, 7), SENTENCES, strict=True):
        assert said.index(f"--- pass {number - 1}") < said.index(sentence) < said.index(f"--- pass {number}")
    assert said[-1].endswith(f"log {whole['trials'][0]['log_sha256']}")


@pytest.mark.parametrize("command", ["run", "compare"])
def test_a_swap_that_cannot_be_made_is_said_before_anything_runs(mapek: Mapek, here: Path, command: str) -> None:
    (here / "narrow.py").write_text(
        "from mape.execute.rules import QLearning\n\nclass Narrow(QLearning):\n    rate_names = ('alpha',)\n"
    )
    swap = 'swap=[{pass=8, part="learner", to="narrow:Narrow"}]'
    outcome = mapek(command, GOALS, "--set", "episodes=9", "--set", swap, "--trials", 1, *QUIETLY, "--out", "out")

    assert outcome.code == 1
    assert "learner Narrow takes 1 learning-rate parameters (alpha), the one before it 3" in outcome.err
    assert not Path("out").exists()


def test_a_swap_of_a_detector_to_a_signal_that_is_not_there_is_a_matter_of_the_config(mapek: Mapek) -> None:
    swap = 'swap=[{pass=8, part="monitor", to={name="two_window", signal="noise"}}]'
    outcome = mapek("run", GOALS, "--set", "episodes=9", "--set", swap, *QUIETLY)

    assert outcome.code == 2
    assert "watches signal 'noise'; the run has return, steps, td_error, q_change" in outcome.err


@pytest.mark.parametrize("command", ["run", "compare", "step"])
def test_a_free_running_config_is_refused_where_there_are_no_processes(mapek: Mapek, command: str) -> None:
    outcome = mapek(command, GOALS, "--set", "execute={mode='free', rate=10.0}")

    assert outcome.code == 2
    assert "free-running needs processes: mapek up" in outcome.err
    assert not Path("results").exists()


LOOPS = ("--set", "episodes=12", "--set", "loops=3", "--trials", 2)


def test_json_lists_every_loop_of_every_trial_in_order(mapek: Mapek) -> None:
    found = mapek("run", GOALS, *LOOPS, *PIPED).json

    assert found["loops"] == 3
    assert [(one["trial"], one["loop"]) for one in found["trials"]] == [(t, k) for t in range(2) for k in range(3)]
    config = load(GOALS, overrides=["episodes=12", "loops=3", "trials=2"])
    for one in found["trials"]:
        alone = run_trial(config, one["trial"], make_system, loop=one["loop"])
        assert (one["log_sha256"], one["total_steps"]) == (alone.log_sha256, alone.total_steps)
    assert len({one["log_sha256"] for one in found["trials"]}) == 6
    assert found["log_sha256"] == combined_hash(one["log_sha256"] for one in found["trials"])
    assert found["q_table_sha256"] == combined_hash(one["q_table_sha256"] for one in found["trials"])


def test_a_run_of_one_loop_has_one_hash(mapek: Mapek) -> None:
    found = mapek("run", GOALS, "--set", "episodes=12", *PIPED).json

    (only,) = found["trials"]
    assert (found["log_sha256"], found["q_table_sha256"]) == (only["log_sha256"], only["q_table_sha256"])


def test_the_loops_of_a_run_are_the_same_however_they_are_divided_among_workers(mapek: Mapek) -> None:
    one, two = (
        mapek("run", GOALS, *LOOPS, "--no-figures", "-q", "--workers", workers, "--json", "-").json
        for workers in (1, 2)
    )

    assert one == two


def test_run_says_how_many_loops_there_were(mapek: Mapek) -> None:
    outcome = mapek("run", GOALS, *LOOPS, "--show", "1:1", *QUIETLY)

    assert "episodes: 12, trials: 2, loops of each: 3, seed: 0" in outcome.out
    assert "per loop" in outcome.out
    assert "(of all loops of all trials)" in outcome.out
    assert outcome.out.count("--- pass 1") == 1


def test_the_table_has_a_row_for_each_loop_and_says_which(mapek: Mapek) -> None:
    found = mapek("run", GOALS, *LOOPS, *PIPED, "--out", "out").json
    table = read_episodes("out/episodes-gridworld_goals.npz", (*COLUMNS, "loop"))

    assert {column.shape for column in table.values()} == {(6, 12)}
    np.testing.assert_array_equal(table["trial"][:, 0], [0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(table["loop"][:, -1], [0, 1, 2, 0, 1, 2])
    np.testing.assert_array_equal(table["episode"], [range(1, 13)] * 6)
    assert table["steps"].sum(axis=1).tolist() == [one["total_steps"] for one in found["trials"]]
    with np.load("out/q_tables-gridworld_goals.npz") as tables:
        assert {name for name in tables if name.startswith("q_")} == {f"q_{unit}" for unit in range(6)}


def test_a_run_of_one_loop_has_a_table_without_their_numbers(mapek: Mapek) -> None:
    mapek("run", GOALS, "--set", "episodes=5", *PIPED, "--out", "out")
    with np.load("out/episodes-gridworld_goals.npz") as table:
        assert tuple(table.files) == COLUMNS
        assert "loop" not in COLUMNS


@pytest.mark.long
def test_figures_are_drawn_of_all_loops(mapek: Mapek) -> None:
    outcome = mapek("run", GOALS, *LOOPS, "--trace", "1:12", "-q", "--out", "out")

    assert outcome.code == 0, outcome.err
    assert {path.stem for path in Path("out/figures").iterdir()} == {"learning_curve", "internal_dynamics", "q_heatmap"}


def test_compare_pairs_loop_by_loop(mapek: Mapek) -> None:
    agents = ("--agents", "morphin,no_detector")
    outcome = mapek("compare", GOALS, *agents, *LOOPS, *PIPED)
    run = mapek("run", GOALS, "--agent", "morphin", *LOOPS, *PIPED).json

    found = outcome.json["agents"]
    assert found["morphin"]["log_sha256"] == run["log_sha256"]
    assert found["morphin"]["total_steps"]["n"] == 6
    assert found["no_detector"]["against_first"]["difference"] == 0
    assert "2 agents, 2 trials with 3 loops of 12 episodes each" in outcome.err
    assert "paired by loop of a trial" in outcome.err


def test_compare_wants_one_number_of_loops(mapek: Mapek, here: Path) -> None:
    (here / "more.toml").write_text(f'extends = "{GOALS}"\nname = "more"\nloops = 2\n')
    outcome = mapek("compare", GOALS, "more.toml", *QUIETLY)

    assert outcome.code == 2
    assert "one number of loops for all: gridworld_goals 1, more 2. Give --set loops=N." in outcome.err


def test_reproduce_counts_trials_and_no_loops(mapek: Mapek) -> None:
    outcome = mapek("reproduce", "table1", "--set", "loops=2", "--trials", 1, *QUIETLY)

    assert outcome.code == 2
    assert "loops = 2 would count each trial several times" in outcome.err


def test_a_swap_to_a_part_with_an_infinite_option_is_refused_before_anybody_is_asked(mapek: Mapek) -> None:
    outcome = mapek("swap", "monitor", '{name = "own:Floor", floor = -inf}', "--connect", "tcp/127.0.0.1:9")

    assert outcome.code == 2
    assert "floor = -inf is no finite number" in outcome.err
    assert "JSON" in outcome.err
