"""The trials of a config in `table1.c`: what it is compiled with, what it is told, and what it says."""

import functools
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from adapters.systems import make_system
from managed_systems import ALWAYS, gridworld
from mape.execute.rules import QLearning
from mape.parts import make
from mape.plan.constant import Constant
from mape.plan.exponential import Exponential
from mape.plan.morphin import Morphin
from mape.plan.q_learning import QLearningPlanner
from mape.plan.success import Success

SOURCE = Path(__file__).with_name("table1.c")
FLAGS = ("-std=c99", "-O3", "-ffp-contract=off")  # not of this machine alone, and without fused or reordered arithmetic
ROW = np.dtype(
    [
        ("steps", "<i4"),
        ("alarm", "<i4"),
        ("return", "<f8"),
        ("epsilon", "<f8"),
        ("td_error", "<f8"),
        ("q_change", "<f8"),
    ]
)


class Timing(NamedTuple):
    """What the program says: steps and alarms of all trials, and how long the trials took, reading left out."""

    steps: int
    alarms: int
    seconds: float
    ns_per_step: float


def compiler():
    """Return the path of a C compiler, or None."""
    return next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)


def version():
    """Return the name and version of the compiler, as it says them."""
    said = subprocess.run([compiler(), "--version"], check=True, capture_output=True, text=True).stdout
    return said.splitlines()[0]


@functools.cache
def build():
    """Compile the program, once per process; return the folder, which lives as long as this process, and the path."""
    folder = tempfile.TemporaryDirectory(prefix="mapek-table1-")
    program = Path(folder.name, "table1")
    subprocess.run([compiler(), *FLAGS, "-o", program, SOURCE, "-lm"], check=True)
    return folder, program


def command(description, *results):
    """Return the command line of a run."""
    return [str(build()[1]), str(description), *map(str, results)]


def timing(description):
    """Run a description."""
    said = subprocess.run(command(description), check=True, capture_output=True, text=True).stdout
    numbers = dict(line.split() for line in said.splitlines())
    return Timing(int(numbers["steps"]), int(numbers["alarms"]), *map(float, list(numbers.values())[2:]))


def run(description, results, shape):
    """Run a description and read what came out.

    Parameters
    ----------
    results
        A file to be written.
    shape
        Trials, episodes, states and actions.

    Returns
    -------
    rows, shape (trials, episodes); Q-tables, shape (trials, actions, states)
    """
    trials, episodes, states, actions = shape
    subprocess.run(command(description, results), check=True, capture_output=True)
    rows = np.fromfile(results, ROW, trials * episodes)
    tables = np.fromfile(results, "<f8", offset=rows.nbytes)
    return rows.reshape(trials, episodes), tables.reshape(trials, states, actions).transpose(0, 2, 1)


def describe(config, path):
    """Write for the program what a config says.

    Raises
    ------
    ValueError
        It says what the program does not do.
    """
    system = make_system(config.system)
    rules, cap = system.rules, system.max_steps
    system.close()
    learner, planner = make("learner", config.learner), make("planner", config.plan)
    detectors = [make("detector", spec) for spec in config.monitor.detectors]
    _refuse(config, rules, learner, planner, detectors)
    params = rules.params
    rate = planner.start(0).learning_rate
    watched = detectors[0].config if detectors else None
    lines = [
        (rules.n_actions, rules.n_states, cap, params.start, config.episodes, config.trials),
        (params.step_reward, params.goal_reward),
        (learner.discount, learner.bootstrap_terminal, *rate),
        _exploration(planner.schedule),
        (True, watched.delta, watched.threshold) if watched else (False, 0.0, 0.0),
        ("drift" in getattr(planner.config, "respond_to", ()),),
        (len(params.goals), *params.goals.tolist()),
        (len(params.switch_at), *params.switch_at.tolist()),
        *params.moves.tolist(),
        *(_generator(config.seed, trial) for trial in range(config.trials)),
    ]
    path.write_text("".join(" ".join(map(_text, line)) + "\n" for line in lines), encoding="ascii")
    return path


def _refuse(config, rules, learner, planner, detectors):
    asked = {
        "a system with other rules than the gridworld's": getattr(rules, "step", None) is not gridworld.step,
        "a floor that slips": rules is not None and rules.step_draws > 0,
        "actions that come or go": rules is not None and (rules.windows != (1, ALWAYS)).any(),
        "another learner than q_learning": type(learner) is not QLearning,
        "another planner than morphin and q_learning": type(planner) not in (Morphin, QLearningPlanner),
        "actions in reserve": bool(getattr(planner.config, "enable_on_drift", ())),
        "other detectors than one page_hinkley on the return": [
            (spec.name, spec.signal) for spec in config.monitor.detectors
        ]
        not in ([], [("page_hinkley", "return")]),
        "another analyzer than changes": config.analyze.name != "changes",
        "swaps or several loops": bool(config.swap) or config.loops > 1,
        "a mask on the greedy choice": config.execute.mask_greedy,
    }
    if refused := [what for what, is_asked in asked.items() if is_asked]:
        raise ValueError(f"table1.c does not do this: {', '.join(refused)}")


def _exploration(schedule):
    config, kind = schedule.config, type(schedule)
    if kind is Constant:
        return 0, config.epsilon, 0.0, 0.0, 0.0
    if kind is Exponential:
        return 1, config.eps_min, config.decay, 0.0, 0.0
    if kind is Success:
        return 2, config.eps_min, config.decay, config.on_success, config.on_failure
    raise ValueError(f"table1.c does not know the schedule {kind.__name__}; it knows constant, exponential and success")


def _generator(seed, trial):
    at = np.random.PCG64(np.random.SeedSequence(entropy=seed, spawn_key=(0, trial))).state["state"]
    words = [part for number in (at["state"], at["inc"]) for part in divmod(number, 1 << 64)]
    return tuple(f"{word:x}" for word in words)


def _text(value):
    if isinstance(value, str):
        return value
    return value.hex() if isinstance(value, float) else str(int(value))
