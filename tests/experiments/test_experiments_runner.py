"""How trials are cut into chunks, and which figures are made of them."""

from pathlib import Path

import numpy as np
import pytest

from adapters.experiments import pictures
from adapters.experiments.runner import Checked, check, chunk_size, run_agents
from adapters.results import RunFolder
from mape.config import from_table

GRID = {
    "id": "mapek/Gridworld-v0",
    "options": {"size": [3, 3], "start": [0, 0], "goals": [[2, 2], [0, 2]], "max_steps": 8},
}


def grid(switch_at=(), **over):
    system = {**GRID, "options": {**GRID["options"], "switch_at": list(switch_at)}}
    return from_table({"name": "grid", "episodes": 5, "system": system, "plan": {"name": "morphin"}, **over})


def test_a_trial_costs_something_however_short_it_is() -> None:
    assert 50 <= chunk_size(grid(), Checked(True, 288)) <= 200
    assert chunk_size(grid(episodes=1000), Checked(True, 288)) == 32
    assert chunk_size(grid(episodes=10**9), Checked(True, 288)) == 1


def test_the_q_tables_of_a_chunk_fit_into_a_worker() -> None:
    assert chunk_size(grid(), Checked(True, 4_000_000)) == 4
    assert chunk_size(grid(), Checked(True, 400_000_000)) == 1


def test_making_the_parts_tells_how_large_a_table_is() -> None:
    assert check(grid()) == Checked(compiled=True, table_bytes=4 * 9 * 8)
    assert not check(grid(execute={"engine": "python"})).compiled


@pytest.fixture
def drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Arguments with which figures are drawn of a run of two agents that share one drift."""
    seen = {}
    for name in ("learning_curve", "q_heatmaps"):
        draw = getattr(pictures, name)
        monkeypatch.setattr(
            pictures, name, lambda *a, draw=draw, name=name, **k: seen.update({name: (a, k)}) or draw(*a, **k)
        )
    configs = {"morphin": grid((2, 4)), "q_learning": grid((4, 5))}
    with RunFolder(tmp_path / "out", "compare", configs) as folder:
        run_agents(configs, folder, workers=1, quiet=True)
        yield folder, seen


def test_only_drifts_that_all_agents_meet_are_marked(drawn) -> None:
    folder, seen = drawn
    assert {path.suffix for path in pictures.pictures_of_traffic(folder)} == {".png", ".pdf"}
    assert list(seen["learning_curve"][1]["drifts"]) == [4]


def test_the_heatmaps_say_whose_they_are_and_of_which_trial(drawn) -> None:
    folder, seen = drawn
    pictures.pictures_of_jump(folder)
    ((panels,), options) = seen["q_heatmaps"]
    assert [panel.title for panel in panels] == ["trial 0: MORPHIN", "trial 0: Q-learning"]
    np.testing.assert_array_equal(options["goals"], [[2, 2], [0, 2]])
