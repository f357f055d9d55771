"""`table1.c`, against which the loop's speed is measured, does what the loop does: the same bits."""

from pathlib import Path

import c_reference
import numpy as np
import pytest

from adapters.systems import make_system
from knowledge import QTable
from mape import load, run_trial

CONFIG = Path(__file__).parents[2] / "examples" / "gridworld_goals.toml"
WIDE = (
    'system={id="wide_gridworld:WideGridworld-v0", options={n_actions=14, size=[7, 12], start=[3, 5], '
    "goals=[[0, 0], [6, 11], [0, 11]], switch_at=[31, 61], walls=[[3, 4], [2, 5]], max_steps=29}}"
)
pytestmark = pytest.mark.skipif(c_reference.compiler() is None, reason="there is no C compiler")


@pytest.mark.parametrize(
    ("agent", "lines"),
    [
        ("morphin", ["episodes=400"]),
        ("q_learning", ["episodes=400"]),
        ("morphin", ["episodes=90", WIDE, "monitor.detectors=[{name='page_hinkley', threshold=40.0}]"]),
        ("fixed_alpha", ["episodes=90", WIDE, "learner.bootstrap_terminal=false", "plan.schedule.name=exponential"]),
        ("no_detector", ["episodes=400", "seed=7", "plan.schedule={name='constant', epsilon=0.3}"]),
        ("morphin", ["episodes=400", "plan.respond_to=['added']"]),
    ],
)
def test_every_episode_and_the_q_table_are_the_loops_bit_by_bit(agent, lines, tmp_path):
    config = load(CONFIG, agent=agent, overrides=["trials=3", *lines])
    system = make_system(config.system)
    n_actions, n_states = system.rules.n_actions, system.n_states
    description = c_reference.describe(config, tmp_path / "description.txt")
    shape = (config.trials, config.episodes, n_states, n_actions)
    rows, tables = c_reference.run(description, tmp_path / "results", shape)
    for trial in range(config.trials):
        result, expected = in_the_loop(config, trial)
        for column in c_reference.ROW.names:
            np.testing.assert_array_equal(rows[trial][column], expected[column], f"{column} of trial {trial}")
        table = QTable(range(n_actions), n_states)
        table.values[:] = tables[trial]
        assert table.sha256() == result.q_table_sha256


def in_the_loop(config, trial):
    """Return the result of a trial, and what the program keeps of its rows, by column."""
    segments = []
    result = run_trial(config, trial, make_system, on_rows=lambda rows: segments.append(rows.copy()))
    rows = np.concatenate(segments)
    total, _, td_error, change = rows["signals"].T
    columns = {"steps": rows["steps"], "alarm": rows["alarm"].any(axis=1), "return": total, "epsilon": rows["epsilon"]}
    return result, columns | {"td_error": td_error, "q_change": change}


def test_it_says_the_steps_and_alarms_of_all_trials(tmp_path):
    config = load(CONFIG, overrides=["trials=2", "episodes=350"])
    said = c_reference.timing(c_reference.describe(config, tmp_path / "description.txt"))
    expected = [run_trial(config, trial, make_system) for trial in range(2)]
    assert said.steps == sum(result.total_steps for result in expected)
    assert said.alarms == sum(len(result.alarms) for result in expected)
    assert said.ns_per_step == pytest.approx(1e9 * said.seconds / said.steps, rel=1e-3)


@pytest.mark.parametrize(
    ("line", "refused"),
    [
        ("system.options.slip=0.1", "a floor that slips"),
        ("system.options.jump_from=300", "actions that come or go"),
        ("learner.name=expected_sarsa", "another learner"),
        ("monitor.detectors=[{name='page_hinkley', signal='td_error'}]", "other detectors"),
        ("plan.schedule={name='geometric'}", "the schedule Geometric"),
        ("loops=2", "several loops"),
    ],
)
def test_what_it_does_not_do_is_refused(line, refused, tmp_path):
    with pytest.raises(ValueError, match=f"table1.c does not .*{refused}"):
        c_reference.describe(load(CONFIG, overrides=[line]), tmp_path / "description.txt")
