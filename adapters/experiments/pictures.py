"""Which figures a command makes of its results."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from adapters.experiments.metrics import convergence as stages_of
from adapters.figures.comparison import Compared, comparison
from adapters.figures.convergence import convergence
from adapters.figures.internal_dynamics import internal_dynamics
from adapters.figures.learning_curve import learning_curve
from adapters.figures.q_heatmaps import Panel, q_heatmaps
from adapters.figures.style import save
from adapters.results import RunFolder
from adapters.results.files import cannot_write
from adapters.systems import make_system
from mape.config import Config

NAMES = {
    "morphin": "MORPHIN",
    "q_learning": "Q-learning",
    "success_rule": "MORPHIN, success rule",
    "tuned_q_learning": "Q-learning, tuned",
    "q_learning_alpha_09": "Q-learning, alpha 0.9",
    "fixed_alpha": "fixed alpha 0.1",
    "fixed_alpha_09": "fixed alpha 0.9",
    "no_detector": "no detector",
    "oracle_detector": "oracle detector",
    "two_window": "two-window test",
    "same_actions": "Q-learning, 5 actions",
    "three_actions": "MORPHIN, 3 actions",
}


def pictures_of_run(folder: RunFolder, agent: str) -> list[Path]:
    """Draw the learning curve, the internal dynamics where steps were traced, and Q where the system is a grid."""
    config = folder.configs[agent]
    made = _put(folder, _curve(folder, (agent,), window=min(50, config.episodes)), "learning_curve")
    if (steps := folder.trace(agent)) is not None and len(steps):
        made += _put(folder, _dynamics(folder, agent, steps), "internal_dynamics")
    if _is_grid(config):
        made += _put(folder, _heatmaps(folder, (agent,)), "q_heatmap")
    return made


def pictures_of_table1(folder: RunFolder) -> list[Path]:
    """Draw the internal dynamics of trial 0, both agents' Q, and convergence per stage."""
    drifts = _drifts(folder.configs["morphin"])
    found = {_name(a): stages_of(folder.episodes(a, "q_change")["q_change"], drifts) for a in folder.configs}
    made = _put(folder, convergence(found), "convergence")
    made += _put(folder, _heatmaps(folder, tuple(folder.configs)), "q_heatmaps")
    steps = folder.trace("morphin")
    if steps is not None:
        made += _put(folder, _dynamics(folder, "morphin", steps), "internal_dynamics")
    return made


def pictures_of_jump(folder: RunFolder) -> list[Path]:
    """Draw the agents' Q with the jumps, and the steps per episode."""
    made = _put(folder, _heatmaps(folder, tuple(folder.configs)), "q_heatmaps")
    jump_from = folder.configs["morphin"].system.options.get("jump_from")
    events = [int(jump_from)] if jump_from is not None else []
    steps = {_name(agent): folder.episodes(agent, "steps")["steps"].astype(float) for agent in folder.configs}
    figure = learning_curve(steps, drifts=events, detections={}, window=20, ylabel="steps per episode (mean of 20)")
    return made + _put(folder, figure, "steps")


def pictures_of_traffic(folder: RunFolder) -> list[Path]:
    """Draw the learning curves with drifts and detections."""
    return _put(folder, _curve(folder, tuple(folder.configs), window=500), "learning_curve")


def pictures_of_compare(
    folder: RunFolder, returns: Mapping[str, npt.NDArray[Any]], intervals: Mapping[str, Any]
) -> list[Path]:
    """Draw each agent's totals and the learning curves."""
    table = {_name(agent): Compared(values, intervals[agent]) for agent, values in returns.items()}
    made = _put(folder, comparison(table, xlabel="total return of a trial (units of reward)"), "comparison")
    episodes = min(config.episodes for config in folder.configs.values())
    return made + _put(
        folder, _curve(folder, tuple(folder.configs), window=max(1, min(500, episodes // 20))), "learning_curve"
    )


def _put(folder: RunFolder, figure: Figure, name: str) -> list[Path]:
    target = folder.path / "figures"
    try:
        return save(figure, target, name)
    except OSError as error:
        raise cannot_write(target, error) from error


def _name(agent: str) -> str:
    return NAMES.get(agent, agent.replace("_", " "))


def _drifts(config: Config) -> tuple[int, ...]:
    system = make_system(config.system)
    system.close()
    return tuple(drift for drift in system.drifts if drift <= config.episodes)


def _is_grid(config: Config) -> bool:
    return config.system.id == "mapek/Gridworld-v0"


def _curve(folder: RunFolder, agents: tuple[str, ...], window: int) -> Figure:
    curves, detections = {}, {}
    for agent in agents:
        columns = folder.episodes(agent, "return", "alarm")
        curves[_name(agent)] = columns["return"]
        if folder.configs[agent].monitor.detectors:
            detections[_name(agent)] = (np.nonzero(columns["alarm"])[1] + 1).tolist()
    ylabel = f"return (mean of {window} episodes)" if window > 1 else "return"
    shared = set.intersection(*({*_drifts(folder.configs[agent])} for agent in agents))
    return learning_curve(curves, drifts=sorted(shared), detections=detections, window=window, ylabel=ylabel)


def _dynamics(folder: RunFolder, agent: str, steps: npt.NDArray[np.void]) -> Figure:
    columns = folder.episodes(agent, "episode", "epsilon", "return", "alarm")
    first = {name: values[0] for name, values in columns.items()}
    alarms = first["episode"][first["alarm"]].tolist()
    drifts = _drifts(folder.configs[agent])
    spans = (int(steps["episode"][0]), int(steps["episode"][-1]))
    inside = (first["episode"] >= spans[0]) & (first["episode"] <= spans[1])
    return internal_dynamics(
        steps,
        {name: first[name][inside] for name in ("episode", "epsilon", "return")},
        alarms=[a for a in alarms if spans[0] <= a <= spans[1]],
        drifts=[d for d in drifts if spans[0] <= d <= spans[1]],
        title=f"{_name(agent)}, trial 0",
    )


def _heatmaps(folder: RunFolder, agents: tuple[str, ...]) -> Figure:
    config = folder.configs[agents[0]]
    system = make_system(config.system)
    try:
        base: Any = system.env.unwrapped
        rules = system.rules
        assert rules is not None
        phase = rules.phase(rules.params, config.episodes)
        panels = []
        for agent in agents:
            values, actions = folder.q_table(agent, 0)
            panels.append(Panel(_name(agent), values, actions, phase % len(base.goals)))
        rows, columns = base.size
        return q_heatmaps(
            panels, rows=rows, columns=columns, walls=base.walls, goals=base.goals, start=base.start, of="trial 0"
        )
    finally:
        system.close()
