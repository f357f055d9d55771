"""Which figures a command makes of its results."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from adapters.experiments import paper
from adapters.experiments.metrics import convergence as stages_of
from adapters.experiments.runner import drifts_of
from adapters.figures.comparison import Compared, comparison
from adapters.figures.convergence import convergence
from adapters.figures.files import save
from adapters.figures.internal_dynamics import Watch, internal_dynamics
from adapters.figures.learning_curve import learning_curve
from adapters.figures.q_heatmaps import Panel, q_heatmaps
from adapters.results import RunFolder
from adapters.results.files import cannot_write
from adapters.systems import make_system
from mape import registry
from mape.config import Config
from mape.parts import config_at, make
from mape.trials import combined_hash

NAMES = {
    "morphin": "MORPHIN",
    "q_learning": "Q-learning",
    "success_rule": "MORPHIN, success rule",
    "tuned_q_learning": "Q-learning, tuned",
    "q_learning_alpha_09": "Q-learning, alpha {alpha:g}",
    "fixed_alpha": "fixed alpha {alpha:g}",
    "fixed_alpha_09": "fixed alpha {alpha:g}",
    "no_detector": "no detector",
    "oracle_detector": "oracle detector",
    "two_window": "two-window test",
    "same_actions": "Q-learning, same actions",
    "three_actions": "MORPHIN, no new actions",
}
"""What agents of the examples are called in figures; numbers are taken from the config."""

GRID = "mapek/Gridworld-v0"


def pictures_of_run(folder: RunFolder, agent: str) -> list[Path]:
    """Draw the learning curve, the internal dynamics where steps were traced, and Q where the system is a grid."""
    config = folder.configs[agent]
    made = _put(folder, _curve(folder, (agent,)), "learning_curve")
    if (steps := folder.trace(agent)) is not None and len(steps):
        made += _put(folder, _dynamics(folder, agent, steps), "internal_dynamics")
    if _is_grid(config):
        made += _put(folder, _heatmaps(folder, (agent,)), "q_heatmap")
    return made


def pictures_of_table1(folder: RunFolder) -> list[Path]:
    """Draw the internal dynamics of trial 0, both agents' Q, and convergence per stage."""
    drifts, names = drifts_of(folder.configs["morphin"]), _names(folder.configs)
    found = {names[a]: stages_of(folder.episodes(a, "q_change")["q_change"], drifts) for a in folder.configs}
    printed = {}
    for agent in folder.configs:  # the paper prints the first stages only
        means = [None if stage is None else stage.mean for stage in paper.TABLE1_STAGES[agent]]
        missing = len(found[names[agent]]) - len(means)
        printed[names[agent]] = means[:missing] if missing < 0 else means + [None] * missing
    made = _put(folder, convergence(found, printed), "convergence")
    made += _put(folder, _heatmaps(folder, tuple(folder.configs)), "q_heatmaps")
    steps = folder.trace("morphin")
    if steps is not None:
        made += _put(folder, _dynamics(folder, "morphin", steps), "internal_dynamics")
    return made


def pictures_of_jump(folder: RunFolder) -> list[Path]:
    """Draw the agents' Q with the jumps, and the steps per episode."""
    made = _put(folder, _heatmaps(folder, tuple(folder.configs)), "q_heatmaps")
    names, config = _names(folder.configs), folder.configs["morphin"]
    jump_from = config.system.options.get("jump_from")
    events = [int(jump_from)] if jump_from is not None else []
    steps = {names[agent]: folder.episodes(agent, "steps")["steps"].astype(float) for agent in folder.configs}
    figure = learning_curve(steps, drifts=events, detections={}, ylabel="steps per episode")
    return made + _put(folder, figure, "steps")


def pictures_of_traffic(folder: RunFolder) -> list[Path]:
    """Draw the learning curves with drifts and detections."""
    return _put(folder, _curve(folder, tuple(folder.configs)), "learning_curve")


def pictures_of_compare(
    folder: RunFolder,
    returns: Mapping[str, npt.NDArray[Any]],
    intervals: Mapping[str, Any],
    differences: Mapping[str, Any] | None,
) -> list[Path]:
    """Draw each agent's totals, their differences to the first within trials, and the learning curves.

    `intervals` are those of the means, by agent, and `differences` those of the differences, None where trials of the
    same number are no pairs.
    """
    names = _names(folder.configs)
    table = {names[agent]: Compared(values, intervals[agent]) for agent, values in returns.items()}
    xlabel = f"total return of a {_unit(folder)} (units of reward)"
    paired = None if differences is None else {names[agent]: interval for agent, interval in differences.items()}
    made = _put(folder, comparison(table, xlabel=xlabel, differences=paired), "comparison")
    return made + _put(folder, _curve(folder, tuple(folder.configs)), "learning_curve")


def _put(folder: RunFolder, figure: Figure, name: str) -> list[Path]:
    target = folder.path / "figures"
    try:
        return save(figure, target, name, title=_title(folder, name), about=_about(folder))
    except OSError as error:
        raise cannot_write(target, error) from error


def _title(folder: RunFolder, name: str) -> str:
    named = list(dict.fromkeys(config.name for config in folder.configs.values()))
    return f"{name.replace('_', ' ')} of {', '.join(named)}"


def _about(folder: RunFolder) -> str:
    """Return what a file of a figure says of its run: enough to find the config, and the log, that it was drawn of."""
    told = []
    for agent, config in folder.configs.items():
        results = folder.finished(agent).values()
        log = "" if config.execute.mode == "free" else f", log {combined_hash(r.log_sha256 for r in results)}"
        told.append(f"{agent}: config {hashlib.sha256(config.to_json().encode()).hexdigest()}{log}")
    first = next(iter(folder.configs.values()))
    counted = f"{first.trials:,} trial{'s' * (first.trials > 1)} of {first.episodes:,} episodes, seed {first.seed}"
    return "; ".join([counted, *told])


def _names(configs: Mapping[str, Config]) -> dict[str, str]:
    """Return what each agent is called in figures, which is its own name where another would be called the same."""
    called = {agent: _name(agent, config) for agent, config in configs.items()}
    times = Counter(called.values())
    return {agent: name if times[name] == 1 else agent for agent, name in called.items()}


def _name(agent: str, config: Config) -> str:
    name = NAMES.get(agent, agent.replace("_", " "))
    if "{alpha" not in name:
        return name
    alpha = _fixed_alpha(config)
    return agent if alpha is None else name.format(alpha=alpha)


def _fixed_alpha(config: Config) -> float | None:
    """Return the learning rate, or None where it is not one and the same in the whole run."""
    _, options = registry.options_of("planner", config.plan, "plan")
    alpha: float | None = getattr(options, "alpha", None)
    return alpha if getattr(options, "alpha_max", alpha) == alpha and not config.swap else None


def _unit(folder: RunFolder) -> str:
    return "trial" if all(config.loops == 1 for config in folder.configs.values()) else "loop"


def _is_grid(config: Config) -> bool:
    return config.system.id.rpartition(":")[2] == GRID  # the module that registers it may stand in front


def _curve(folder: RunFolder, agents: tuple[str, ...]) -> Figure:
    names = _names(folder.configs)
    curves, detections = {}, {}
    for agent in agents:
        columns = folder.episodes(agent, "return", "alarm")
        curves[names[agent]] = columns["return"]
        if folder.configs[agent].monitor.detectors:
            detections[names[agent]] = (np.nonzero(columns["alarm"])[1] + 1).tolist()
    return learning_curve(
        curves,
        drifts={names[agent]: drifts_of(folder.configs[agent]) for agent in agents},
        detections=detections,
        ylabel="return",
        unit=_unit(folder),
    )


def _dynamics(folder: RunFolder, agent: str, steps: npt.NDArray[np.void]) -> Figure:
    columns = folder.episodes(agent, "episode", "epsilon", "return")
    first = {name: values[0] for name, values in columns.items()}
    spans = (int(steps["episode"][0]), int(steps["episode"][-1]))
    inside = (first["episode"] >= spans[0]) & (first["episode"] <= spans[1])
    readings = folder.readings(agent)
    return internal_dynamics(
        steps,
        {name: first[name][inside] for name in ("episode", "epsilon", "return")},
        alarms=readings["pass"][readings["alarm"].any(axis=1)].tolist(),
        drifts=[d for d in drifts_of(folder.configs[agent]) if spans[0] <= d <= spans[1]],
        watches=_watches(folder.configs[agent], readings),
        title=f"{_names(folder.configs)[agent]}, {folder.configs[agent].unit_name(0, 0)}",
    )


def _watches(config: Config, readings: Mapping[str, npt.NDArray[Any]]) -> list[Watch]:
    """Return what each detector read, held against the threshold of the one that read it."""
    numbers = readings["pass"]
    firsts = [swap.pass_no for swap in config.swap if swap.pass_no <= numbers[-1]]
    thresholds = np.full(readings["statistic"].shape, np.nan)
    names: list[dict[tuple[str, str], None]] = [{} for _ in config.monitor.detectors]  # in the order of their swaps
    for number in sorted({int(numbers[0]), *(n for n in firsts if n > numbers[0])}):
        for place, spec in enumerate(config_at(config, number).monitor.detectors):
            # A detector of somebody else's may have none; it exposes what it likes.
            threshold = getattr(make("detector", spec), "threshold", None)
            thresholds[numbers >= number, place] = np.nan if threshold is None else threshold
            names[place][spec.name.rpartition(":")[2], spec.signal] = None
    found = []
    for place, detectors in enumerate(names):
        who, what = (", ".join(dict.fromkeys(one)) for one in zip(*detectors, strict=True))
        found.append(Watch(who, what, readings["statistic"][:, place], thresholds[:, place]))
    return found


def _heatmaps(folder: RunFolder, agents: tuple[str, ...]) -> Figure:
    config, names = folder.configs[agents[0]], _names(folder.configs)
    system = make_system(config.system)
    try:
        base: Any = system.env.unwrapped
        rules = system.rules
        assert rules is not None
        phase = rules.phase(rules.params, config.episodes)
        panels = []
        for agent in agents:
            values, actions = folder.q_table(agent, 0)
            panels.append(Panel(names[agent], values, actions, phase % len(base.goals)))
        rows, columns = base.size
        return q_heatmaps(
            panels,
            rows=rows,
            columns=columns,
            walls=base.walls,
            goals=base.goals,
            start=base.start,
            of=config.unit_name(0, 0),
        )
    finally:
        system.close()
