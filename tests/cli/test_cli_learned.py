"""A run that learned nothing says so, and one that learned does not."""

from pathlib import Path

import pytest
from command_line import EXAMPLES, Mapek

LAKE = EXAMPLES / "frozen_lake.toml"
QUIETLY = ("-q", "--workers", 1, "--no-figures")
NEVER = ("--set", "plan.schedule={name='constant', epsilon=0.0}", "--set", "episodes=5")


@pytest.mark.parametrize(
    ("trials", "says"),
    [(1, "learned:  nothing: no reward but 0 was met"), (3, "learned:  nothing in 3 of 3 trials: no reward but 0")],
)
def test_a_lake_on_which_nobody_finds_the_goal_teaches_nothing(trials: int, says: str, mapek: Mapek) -> None:
    outcome = mapek("run", LAKE, *NEVER, "--trials", trials, *QUIETLY)

    assert outcome.code == 0, outcome.err
    assert says in outcome.out


def test_compare_names_the_agents_that_learned_nothing(here: Path, mapek: Mapek) -> None:
    (here / "two.toml").write_text(
        f"extends = '{LAKE}'\nname = 'two'\nepisodes = 60\nsystem = {{ id = 'FrozenLake-v1', options = "
        "{ is_slippery = false } }\n[agents.still.plan.schedule]\nname = 'constant'\nepsilon = 0.0\n"
        "[agents.moving.plan.schedule]\nname = 'constant'\nepsilon = 1.0\n"
    )
    outcome = mapek("compare", "two.toml", "--agents", "still,moving", "--trials", 2, *QUIETLY)

    assert outcome.code == 0, outcome.err
    (line,) = (line for line in outcome.out.splitlines() if line.startswith("learned:"))
    assert line.startswith("learned:  nothing in 2 of 2 trials")
    assert "the Q-table of still" in line


def test_a_run_that_learned_says_nothing_of_it(mapek: Mapek) -> None:
    outcome = mapek("run", EXAMPLES / "gridworld_goals.toml", "--set", "episodes=2", *QUIETLY)

    assert "learned:" not in outcome.out
