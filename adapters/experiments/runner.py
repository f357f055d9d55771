"""Runs the trials of one or several agents into a folder, over worker processes."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import sys
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from adapters.results import RunFolder
from adapters.results.chunk import run_chunk
from adapters.systems import make_system
from mape import compose
from mape.config import Config
from mape.errors import MapekError
from mape.loop import Loop
from mape.trials import TrialResult, chunks, each_completed

CHUNK_SECONDS = 0.8
PASS_SECONDS, STEP_SECONDS = 20e-6, 10e-6  # rough costs of a pass, and of a step that is not compiled
TRIAL_SECONDS = 5e-3  # a trial's own: its system, its components, its table
CHUNK_BYTES = 16_000_000  # of Q-tables, which a worker holds until its chunk is written


Task = tuple[str, int, int, str, tuple[int, int] | None]
"""Arguments of `run_chunk`."""


class Checked(NamedTuple):
    """What making a config's parts tells about the cost of a trial."""

    compiled: bool
    table_bytes: int


class Stopped(MapekError):
    """The user stopped the run; what is finished is kept."""


def run_agents(
    configs: Mapping[str, Config],
    folder: RunFolder,
    *,
    workers: int | None = None,
    trace: tuple[int, int] | None = None,
    quiet: bool = False,
    prepare: Callable[[Loop], object] | None = None,
) -> dict[str, list[TrialResult]]:
    """Run what is not finished yet, show how far it is, and make each agent's tables.

    Parameters
    ----------
    configs
        Agent -> config.
    folder
        Where results are stored as they come.
    workers
        Processes; None for one per core. One trial, or one worker, runs in this process.
    trace
        Episodes of unit 0, the first loop of trial 0, whose steps are kept.
    prepare
        Called with each loop before its first pass; then everything runs in this process.

    Returns
    -------
    agent -> results in the order of the units: the loops of trial 0, then those of trial 1, and so on

    Raises
    ------
    Stopped
        After Ctrl-C.
    MapekError
        A trial failed, or the disk is full.
    """
    finished = {agent: folder.finished(agent) for agent in configs}
    tasks: list[Task] = []
    for agent, config in configs.items():
        checked = check(config)
        missing = [unit for unit in range(config.units) if unit not in finished[agent]]
        for first, count in chunks(missing, chunk_size(config, checked)):
            tasks.append((config.to_json(), first, count, folder.chunk_stem(agent, first, count), trace))
    total = sum(config.units * config.episodes for config in configs.values())
    done = sum(len(finished[agent]) * config.episodes for agent, config in configs.items())
    workers = min(workers or os.cpu_count() or 1, len(tasks))
    with tqdm(
        total=total, initial=done, unit=" episodes", unit_scale=True, disable=True if quiet else None, leave=False,
        dynamic_ncols=True, smoothing=0.1,
    ) as bar:  # fmt: skip
        try:
            if workers > 1 and prepare is None:
                _run_in_workers(tasks, workers, bar)
            else:
                for task in tasks:
                    run_chunk(*task, on_rows=lambda rows: bar.update(len(rows)), prepare=prepare)
        except KeyboardInterrupt:
            kept = sum(len(folder.finished(agent)) for agent in configs)
            wanted = sum(config.units for config in configs.values())
            units = "trials" if all(config.loops == 1 for config in configs.values()) else "loops of trials"
            raise Stopped(
                f"stopped. {kept} of {wanted} {units} are finished and kept in {folder.path}; "
                f"the same command with --out {folder.path} continues."
            ) from None
    results = {agent: folder.finished(agent) for agent in configs}
    for agent in configs:
        folder.assemble(agent)
    return {agent: [found[unit] for unit in sorted(found)] for agent, found in results.items()}


def chunk_size(config: Config, checked: Checked) -> int:
    """Return how many trials make about a second of work, with Q-tables that fit into a worker's memory."""
    cap = config.system.max_steps or 200
    episode = PASS_SECONDS if checked.compiled else PASS_SECONDS + cap * STEP_SECONDS
    trials = CHUNK_SECONDS / (TRIAL_SECONDS + config.episodes * episode)
    return max(1, int(min(trials, CHUNK_BYTES / checked.table_bytes)))


def check(config: Config) -> Checked:
    """Make all that a config names, what it is to swap among it, and say what that tells about the cost of a trial.

    In this process first: what is wrong with a config is said at once, and the compiled code is in the cache before
    several workers want it.

    Raises
    ------
    MapekError
        Something cannot be made.
    """
    system = make_system(config.system)
    try:
        loop = Loop(config, system)
        for _ in config.swap:
            loop.swap()
        return Checked(loop.execute.compiled, loop.execute.q_table.values.nbytes)
    finally:
        system.close()


def _run_in_workers(tasks: list[Task], workers: int, bar: Any) -> None:
    # Spawn, never fork: a forked process inherits threads' locks.
    context = multiprocessing.get_context("spawn")
    with _Pool(workers, mp_context=context, initializer=_start_worker) as pool:
        try:
            for results in each_completed(pool, run_chunk, tasks, in_flight=2 * workers):
                bar.update(sum(result.passes for result in results))
        except BrokenProcessPool:
            raise MapekError(
                "a worker process died (killed, or out of memory?); finished trials are kept, and the same command "
                "with the same --out continues. Fewer --workers need less memory."
            ) from None


class _Pool(ProcessPoolExecutor):
    """Starts its workers deaf to Ctrl-C, which would come to them as a traceback before they can decline it."""

    def submit(self, *arguments: Any, **options: Any) -> Future[Any]:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return super().submit(*arguments, **options)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker() -> None:
    # Ctrl-C reaches the whole process group; the parent alone decides, and lets running chunks end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    # A parent that is killed can end nobody: the workers would wait for it for ever.
    threading.Thread(target=_leave_with_parent, daemon=True).start()


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    multiprocessing.connection.wait([parent.sentinel])
    os._exit(1)


def announce_compilation() -> None:
    """Say on standard error when something is compiled that is not in the cache."""
    if not compose.on_compile:
        compose.on_compile.append(lambda sentence: print(sentence, file=sys.stderr))  # noqa: T201


def experiment_config(name: str) -> Path:
    """Return the path of a ready-made config: of the checkout, or as the installed wheel carries it.

    Raises
    ------
    MapekError
        It is nowhere.
    """
    import sysconfig

    here = Path(__file__).resolve().parents[2]
    for folder in (
        here / "examples",
        here / "share" / "mapek" / "examples",
        Path(sysconfig.get_path("data"), "share", "mapek", "examples"),
    ):
        if (folder / f"{name}.toml").exists():
            return folder / f"{name}.toml"
    raise MapekError(f"the experiment {name}.toml is not installed; install mapek again")
