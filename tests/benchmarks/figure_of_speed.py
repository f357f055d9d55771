"""Draw the loop's speed beside a plain C program's: over the number of trials, of states and of actions.

    python tests/benchmarks/figure_of_speed.py --out speed.pdf [--quick]

writes speed.pdf, speed.png, and the numbers as speed.json. The lines of the figure:

- "mapek, run_trial": trials one after the other in one process, where all is compiled already; log and hashes in it.
- "mapek run": the command from start to end, with a process per core, its results on disk, without figures. Over the
  number of trials only, as that is what its start is spread over.
- "C": `table1.c` on one core, told the same; the time of its trials, without start and reading.

Each does the same steps, which is checked. They are measured in turn; the figure shows the median of the rounds, and
the numbers hold them all.
"""

import argparse
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import c_reference
import numba
import numpy as np
from matplotlib.ticker import FuncFormatter, NullLocator
from tqdm import tqdm

from adapters.figures import save, style
from adapters.systems.lending import Lender
from mape import load, run_trial

CONFIG = Path(__file__).parents[2] / "examples" / "gridworld_goals.toml"
SIDE, CAP = 9, 37  # of Table 1's grid; a larger one has as many more steps as it is wider
WIDE = 33  # for up to 64 actions, of which the longest go 16 cells: from the start to the border
SERIES = ("mapek, run_trial", "mapek run", "C")
TITLES = {"trials": "number of trials", "states": "number of states", "actions": "number of actions"}


class Sweep(NamedTuple):
    """What is measured: the points of each panel, and how often.

    `few` are the trials of the panels of states and actions; `command` says whether the command is run, too.
    """

    trials: tuple[int, ...]
    sides: tuple[int, ...]
    actions: tuple[int, ...]
    episodes: int
    few: int
    rounds: int
    command: bool = True


WHOLE = Sweep((10, 30, 100, 300, 1000, 3000, 10_000), (9, 14, 20, 32, 50, 71, 100), (4, 8, 16, 32, 64), 1500, 10, 3)
QUICK = Sweep((10, 100), (9, 30, 100), (4, 16, 64), 300, 3, 1)


def points(sweep):
    """Yield panel, where on its axis, config, and whether the command is measured there too."""
    for trials in sweep.trials:
        yield "trials", trials, _config(sweep.episodes, trials), sweep.command
    for side in sweep.sides:
        yield "states", side * side, _config(sweep.episodes, sweep.few, _grid(side)), False
    for n_actions in sweep.actions:
        wide = 'id="wide_gridworld:WideGridworld-v0", ' + _grid(WIDE, f"n_actions={n_actions}, ")
        yield "actions", n_actions, _config(sweep.episodes, sweep.few, wide), False


def _config(episodes, trials, system=None):
    lines = [f"episodes={episodes}", f"trials={trials}"]
    return load(CONFIG, overrides=lines if system is None else [*lines, f"system={{{system}}}"])


def _grid(side, more=""):
    last, cap = side - 1, round(CAP * side / SIDE)
    return (
        f"options={{{more}size=[{side}, {side}], start=[{side // 2}, {side // 2}], goals=[[0, 0], [{last}, {last}]], "
        f"switch_at=[301, 601, 901, 1201], max_steps={cap}}}"
    )


def in_the_loop(config):
    """Run the trials of a config in this process; return steps and seconds."""
    with Lender() as lend:
        lend(config.system).close()  # made once for all trials, as a run does; C's tables are read untimed, too
        begun = time.perf_counter()
        steps = sum(run_trial(config, trial, lend).total_steps for trial in range(config.trials))
        return steps, time.perf_counter() - begun


def by_command(config, folder):
    """Run `mapek run` with a process per core; return steps and seconds."""
    path, result = folder / "config.json", folder / "result.json"
    path.write_text(config.to_json(), encoding="utf-8")
    with tempfile.TemporaryDirectory(dir=folder) as out:
        command = [sys.executable, "-m", "mape", "run", str(path), "--no-figures", "-q", "--json", str(result)]
        begun = time.perf_counter()
        subprocess.run(
            [*command, "--workers", str(os.cpu_count()), "--out", str(Path(out, "run"))],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        seconds = time.perf_counter() - begun
    trials = json.loads(result.read_text(encoding="utf-8"))["trials"]
    return sum(trial["total_steps"] for trial in trials), seconds


def measure(sweep, show=False):
    """Measure every point, all lines in turn.

    Returns
    -------
    A list of points: panel, at, steps, and `seconds`, line -> those of each round.

    Raises
    ------
    RuntimeError
        Two lines do not do the same steps.
    """
    found = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for panel, at, config, command in tqdm(list(points(sweep)), unit="point", disable=not show):
            description = c_reference.describe(config, folder / "description.txt")
            lines = {
                "mapek, run_trial": lambda config=config: in_the_loop(config),
                "C": lambda description=description: c_reference.timing(description)[::2],
            }
            if command:
                lines["mapek run"] = lambda config=config: by_command(config, folder)
            in_the_loop(config.model_copy(update={"trials": 1}))  # compiles
            rounds = [{line: once() for line, once in lines.items()} for _ in range(sweep.rounds)]
            steps = {one[line][0] for one in rounds for line in lines}
            if len(steps) > 1:
                raise RuntimeError(f"not the same work at {at} {panel}: {sorted(steps)} steps")
            seconds = {line: [one[line][1] for one in rounds] for line in lines}
            found.append({"panel": panel, "at": at, "steps": steps.pop(), "seconds": seconds})
    return found


def draw(found):
    """Draw the points that `measure` gives: a panel each for trials, states and actions, on one scale of speed."""
    figure = style.new_figure(style.PAGE, 2.5)
    panels = figure.subplots(1, 3, sharey=True)
    entries = {}
    for axes, (panel, title) in zip(panels, TITLES.items(), strict=True):
        style.dress(axes, xlabel=title, ylabel="million steps per second" if axes is panels[0] else "")
        axes.set_xscale("log")
        axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))
            axis.set_minor_locator(NullLocator())
        for i, line in enumerate(SERIES):
            there = [one for one in found if one["panel"] == panel and line in one["seconds"]]
            if there:
                (drawn,) = axes.plot(
                    [one["at"] for one in there],
                    [speed(one, line) for one in there],
                    color=style.colour(i),
                    linestyle=style.dashes(i),
                    linewidth=1.2,
                    marker="os^"[i],
                    markersize=3.0,
                )
                entries.setdefault(line, drawn)
    speeds = [speed(one, line) for one in found for line in one["seconds"]]
    panels[0].set_ylim(10.0 ** math.floor(math.log10(min(speeds))), 10.0 ** math.ceil(math.log10(max(speeds))))
    panels[2].set_xticks([one["at"] for one in found if one["panel"] == "actions"])
    labels = {
        "mapek, run_trial": "mapek: run_trial, one process",
        "mapek run": f"mapek run: start to end, {os.cpu_count()} processes",
        "C": "C: trials only, one core",
    }
    style.legend(figure, [(entries[line], labels[line]) for line in entries], loc="outside upper center", ncols=3)
    return figure


def speed(one, line):
    """Return the million steps per second of a line at a point, of the median round."""
    return one["steps"] / statistics.median(one["seconds"][line]) / 1e6


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("speed.pdf"), help="figure; .pdf, .png and .json are written")
    parser.add_argument("--quick", action="store_true", help="few points, one round")
    chosen = parser.parse_args(arguments)
    if c_reference.compiler() is None:
        parser.error("there is no C compiler; install cc, gcc or clang")
    found = measure(QUICK if chosen.quick else WHOLE, show=sys.stderr.isatty())
    folder, name = chosen.out.parent, chosen.out.stem
    written = save(draw(found), folder, name)
    numbers = {
        "versions": {"python": platform.python_version(), "numpy": np.__version__, "numba": numba.__version__},
        "machine": {"architecture": platform.machine(), "cores": os.cpu_count()},
        "c": {"compiler": c_reference.version(), "flags": c_reference.FLAGS},
        "points": [one | {"million_steps_per_s": {line: speed(one, line) for line in one["seconds"]}} for one in found],
    }
    written.append(folder / f"{name}.json")
    written[-1].write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
    print("\n".join(map(str, written)))


if __name__ == "__main__":
    main()
