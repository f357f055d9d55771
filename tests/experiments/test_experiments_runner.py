"""How trials are cut into chunks, and which figures are made of them."""

from pathlib import Path

import numpy as np
import pytest

from adapters.experiments import pictures, runner
from adapters.experiments.runner import Checked, Stage, check, chunk_size, run_agents
from adapters.results import RunFolder
from mape.config import from_table
from mape.monitor.page_hinkley import PageHinkley, PageHinkleyConfig

GRID = {
    "id": "mapek/Gridworld-v0",
    "options": {"size": [3, 3], "start": [0, 0], "goals": [[2, 2], [0, 2]], "max_steps": 8},
}


def grid(switch_at=(), **over):
    system = {**GRID, "options": {**GRID["options"], "switch_at": list(switch_at)}}
    return from_table({"name": "grid", "episodes": 5, "system": system, "plan": {"name": "morphin"}, **over})


def costs(*compiled: str, max_steps: int = 8, table_bytes: int = 288) -> Checked:
    return Checked(tuple(Stage(1 + k, what) for k, what in enumerate(compiled)), max_steps, table_bytes)


def size(checked: Checked, workers: int = 2, trials: int = 10_000_000, **over) -> int:
    return chunk_size(grid(trials=trials, **over), checked, workers)


def test_a_trial_costs_something_however_short_it_is() -> None:
    assert 800 <= size(costs("passes")) <= 3000
    assert size(costs("passes"), episodes=10**9) == 1


def test_a_chunk_of_a_long_run_is_about_a_second_whatever_is_compiled() -> None:
    for what, passes_per_second in (("passes", 5e5), ("episodes", 1e5), ("nothing", 1e4)):
        seconds = size(costs(what), episodes=1000) * 1000 / passes_per_second
        assert 0.2 <= seconds <= 2.0, what


def test_a_chunk_is_as_short_as_the_slowest_of_its_passes_want_it() -> None:
    assert size(costs("passes", "nothing"), episodes=1000) == size(costs("nothing"), episodes=1000)
    assert size(costs("nothing", max_steps=100), episodes=1000) < size(costs("nothing"), episodes=1000)


def test_each_worker_gets_several_chunks_unless_they_would_be_tiny() -> None:
    fast = costs("passes")
    for workers in (1, 2, 16):
        assert 2000 / size(fast, workers, trials=2000, episodes=1500) >= min(8 * workers, 10)
    assert size(fast, 16, trials=2000) == size(fast, 16, trials=200) > 100


def test_the_q_tables_of_a_chunk_fit_into_a_worker() -> None:
    assert size(costs("passes", table_bytes=4_000_000)) == 4
    assert size(costs("passes", table_bytes=400_000_000)) == 1


def test_making_the_parts_tells_how_large_a_table_is_and_how_long_an_episode() -> None:
    assert check(grid()) == Checked((Stage(1, "passes"),), max_steps=8, table_bytes=4 * 9 * 8)


class Plain(PageHinkley):
    """A detector that declares no rule."""

    Config = None

    def __init__(self):
        super().__init__(PageHinkleyConfig())


def test_making_the_parts_tells_what_is_compiled_and_why_no_more() -> None:
    plain = {"detectors": [{"name": "page_hinkley"}, {"name": f"{__name__}:Plain"}]}
    swap = {"pass": 3, "part": "monitor.1", "to": "oracle"}
    assert check(grid(execute={"engine": "python"})).stages == (Stage(1, "nothing", ("the engine is python",)),)
    assert check(grid(monitor=plain, swap=[swap])).stages == (
        Stage(1, "episodes", ("detector monitor.1 Plain declares no rule",)),
        Stage(3, "passes"),
    )
    assert check(grid(monitor=plain, swap=[swap | {"pass": 1}])).stages == (Stage(1, "passes"),)


def test_in_processes_only_episodes_are_compiled() -> None:
    (stage,) = check(grid(), in_processes=True).stages
    assert stage.compiled == "episodes"


@pytest.mark.parametrize(("workers", "started"), [(None, False), (2, True)])
def test_no_process_is_started_for_work_that_ends_before_it_would_begin(
    tmp_path, monkeypatch, workers, started
) -> None:
    pools = []
    run_in_workers = runner._run_in_workers
    monkeypatch.setattr(runner, "_run_in_workers", lambda *given: pools.append(given[2]) or run_in_workers(*given))
    monkeypatch.setattr(runner.os, "cpu_count", lambda: 2)
    configs = {"one": grid(), "other": grid()}
    with RunFolder(tmp_path / "out", "compare", configs) as folder:
        results = run_agents(configs, folder, workers=workers, quiet=True)
    assert pools == [2] * started
    assert [len(found) for found in results.values()] == [1, 1]


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


def test_each_agent_has_the_drifts_that_it_meets(drawn) -> None:
    folder, seen = drawn
    assert {path.suffix for path in pictures.pictures_of_traffic(folder)} == {".png", ".pdf"}
    assert seen["learning_curve"][1]["drifts"] == {"MORPHIN": (2, 4), "Q-learning": (4, 5)}


def test_the_heatmaps_say_whose_they_are_and_of_which_trial(drawn) -> None:
    folder, seen = drawn
    pictures.pictures_of_jump(folder)
    ((panels,), options) = seen["q_heatmaps"]
    assert [panel.title for panel in panels] == ["MORPHIN", "Q-learning"]
    assert options["of"] == "trial 0"
    np.testing.assert_array_equal(options["goals"], [[2, 2], [0, 2]])
