"""What agents are called in figures, and what is said of loops, and of a grid by another name."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from adapters.experiments import pictures
from adapters.experiments.runner import run_agents
from adapters.results import RunFolder
from mape.config import Config, from_table, load

Run = Callable[..., RunFolder]
EXAMPLES = Path(__file__).parents[2] / "examples"
GRID = {
    "id": "mapek/Gridworld-v0",
    "options": {"size": [3, 3], "start": [0, 0], "goals": [[2, 2], [0, 2]], "switch_at": [3], "max_steps": 8},
}


def grid(**over: Any) -> Config:
    return from_table({"name": "grid", "episodes": 5, "system": GRID, **over})


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Arguments with which each kind of figure is drawn, the first positional one as ``data``."""
    seen: dict[str, Any] = {}
    for name in ("learning_curve", "q_heatmaps", "comparison", "internal_dynamics"):
        draw = getattr(pictures, name)

        def recorded(*given: Any, draw: Any = draw, name: str = name, **options: Any) -> Any:
            seen[name] = {"data": given[0], **options}
            return draw(*given, **options)

        monkeypatch.setattr(pictures, name, recorded)
    return seen


@pytest.fixture
def ran(tmp_path: Path) -> Iterator[Run]:
    """Run configs into a folder, and return it."""
    opened: list[RunFolder] = []

    def run(configs: dict[str, Config], **options: Any) -> RunFolder:
        opened.append(RunFolder(tmp_path / f"out{len(opened)}", "compare", configs, options.get("trace")))
        run_agents(configs, opened[-1], workers=1, quiet=True, **options)
        return opened[-1]

    yield run
    for folder in opened:
        folder.close()


def compared(folder: RunFolder) -> list[Path]:
    returns = {agent: folder.episodes(agent, "return")["return"].sum(axis=1) for agent in folder.configs}
    return pictures.pictures_of_compare(folder, returns, dict.fromkeys(returns), dict.fromkeys([*returns][1:]))


def names(ran: Run, drawn: dict[str, Any], configs: dict[str, Config]) -> dict[str, str]:
    """What each agent is called, in all figures of a comparison."""
    compared(ran(configs))
    called = list(drawn["comparison"]["data"])
    assert list(drawn["learning_curve"]["data"]) == called
    return dict(zip(configs, called, strict=True))


def test_no_agent_is_lost_to_another_of_the_same_name(ran: Run, drawn: dict[str, Any]) -> None:
    plain = grid(plan={"name": "q_learning"})
    configs = {"morphin": grid(), "MORPHIN": grid(), "q_learning": plain, "Q-learning": plain, "no_detector": plain}
    assert names(ran, drawn, configs) == {
        "morphin": "morphin",
        "MORPHIN": "MORPHIN",
        "q_learning": "q_learning",
        "Q-learning": "Q-learning",
        "no_detector": "no detector",
    }


def test_a_name_says_the_learning_rate_of_its_config(ran: Run, drawn: dict[str, Any]) -> None:
    goals = EXAMPLES / "gridworld_goals.toml"
    agents = ("q_learning", "q_learning_alpha_09", "fixed_alpha", "fixed_alpha_09")
    for overrides, called in (
        ([], ("Q-learning", "Q-learning, alpha 0.9", "fixed alpha 0.1", "fixed alpha 0.9")),
        # MORPHIN's rate is fixed only where alpha is alpha_max.
        (["plan.alpha=0.05"], ("Q-learning", "Q-learning, alpha 0.05", "fixed_alpha", "fixed_alpha_09")),
    ):
        configs = {agent: load(goals, agent=agent, overrides=["episodes=5", *overrides]) for agent in agents}
        assert tuple(names(ran, drawn, configs).values()) == called
    fixed = grid(plan={"name": "morphin", "alpha": 0.3, "alpha_max": 0.3})
    assert names(ran, drawn, {"fixed_alpha": fixed, "fixed_alpha_09": fixed}) == {
        "fixed_alpha": "fixed_alpha",
        "fixed_alpha_09": "fixed_alpha_09",
    }
    swapped = grid(plan=fixed.plan.model_dump(), swap=[{"pass": 2, "part": "plan", "to": "q_learning"}])
    assert names(ran, drawn, {"fixed_alpha": swapped, "morphin": fixed})["fixed_alpha"] == "fixed_alpha"


def test_no_name_says_a_number_of_actions(ran: Run, drawn: dict[str, Any]) -> None:
    configs = {"same_actions": grid(), "three_actions": grid()}
    assert not any(sign.isdigit() for name in names(ran, drawn, configs).values() for sign in name)


@pytest.mark.parametrize(
    ("loops", "unit", "of"),
    [(1, "trial", "trial 0"), pytest.param(2, "loop", "trial 0, loop 0", marks=pytest.mark.long)],
)
def test_figures_say_trial_or_loop_as_it_is(ran: Run, drawn: dict[str, Any], loops: int, unit: str, of: str) -> None:
    folder = ran({"morphin": grid(loops=loops), "other": grid(loops=loops)}, trace=(1, 5))
    compared(folder)
    assert drawn["comparison"]["xlabel"] == f"total return of a {unit} (units of reward)"
    assert drawn["learning_curve"]["unit"] == unit
    pictures.pictures_of_run(folder, "morphin")
    assert drawn["q_heatmaps"]["of"] == of
    assert drawn["internal_dynamics"]["title"] == f"MORPHIN, {of}"


def test_a_grid_is_drawn_too_where_the_module_that_registers_it_stands_in_front(ran: Run) -> None:
    named = ran({"a": grid(system={**GRID, "id": "managed_systems:mapek/Gridworld-v0"})})
    assert {path.stem for path in pictures.pictures_of_run(named, "a")} == {"learning_curve", "q_heatmap"}
