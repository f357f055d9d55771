"""Runs the trials of one or several agents into a folder, over worker processes."""

from __future__ import annotations

import atexit
import functools
import gc
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import FrameType
from typing import Any, Literal, NamedTuple

from tqdm import tqdm

from adapters.results import RunFolder
from adapters.results.chunk import run_chunk
from adapters.results.folder import assemble
from adapters.systems import make_system
from adapters.systems.declared import declared, is_plant
from adapters.systems.lending import Lender
from mape import ctrl_c
from mape.config import Config
from mape.errors import MapekError
from mape.loop import Loop
from mape.trials import TrialResult, chunks, each_completed

CHUNK_SECONDS = 0.8
LEAST_SECONDS = 0.1  # of a chunk of a short run: in less time its files would weigh
CHUNKS_PER_WORKER = 8  # at least, in a run that is long enough: so they end nearly together, and progress is seen
CHUNK_BYTES = 16_000_000  # of Q-tables, which a worker holds until its chunk is written
# Rough costs, in seconds.
START_SECONDS = 1.0  # until a worker's process has loaded what it needs
TRIAL_SECONDS = 0.5e-3  # a trial's own: its system, its components, its table
PASS_SECONDS = {"passes": 0.5e-6, "episodes": 8e-6, "nothing": 20e-6}  # of a pass, by what is compiled
STEP_SECONDS = {"passes": 25e-9, "episodes": 25e-9, "nothing": 10e-6}  # of a step of the longest episode


Task = tuple[str, int, int, str, tuple[int, int] | None]
"""Arguments of `run_chunk`."""


class Stage(NamedTuple):
    """What is compiled of the passes from number `first` on.

    `compiled` is ``"passes"``, whole stretches of them; ``"episodes"`` alone; or ``"nothing"``. `obstacles` says in
    clauses what keeps it from more.
    """

    first: int
    compiled: Literal["passes", "episodes", "nothing"]
    obstacles: tuple[str, ...] = ()

    def __str__(self) -> str:
        what = {"passes": "whole stretches of passes are", "episodes": "only episodes are", "nothing": "nothing is"}
        because = f", because {' and '.join(self.obstacles)}" if self.obstacles else ""
        return f"{what[self.compiled]} compiled{because}"


class Checked(NamedTuple):
    """What making a config's parts tells about the cost of a trial.

    `stages` has one more entry for each planned swap after which something else is compiled than before; `max_steps`
    is the longest episode.
    """

    stages: tuple[Stage, ...]
    max_steps: int
    table_bytes: int

    def __str__(self) -> str:
        first, *later = self.stages
        return "; ".join([str(first), *(f"from pass {stage.first} on {stage}" for stage in later)])


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
    lend: Lender | None = None,
) -> dict[str, list[TrialResult]]:
    """Run what is not finished yet, show how far it is, and make each agent's tables.

    Parameters
    ----------
    configs
        Agent -> config.
    folder
        Where results are stored as they come.
    workers
        Processes, of which this one is the first; None for one per core, where the work is worth their start.
    trace
        Episodes of unit 0, the first loop of trial 0, whose steps are kept.
    prepare
        Called with each loop before its first pass; then everything runs in this process.
    lend
        Makes the systems that this process drives: that which was looked at before is the first of them.

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
    if lend is None:
        with Lender() as lend:
            return run_agents(configs, folder, workers=workers, trace=trace, quiet=quiet, prepare=prepare, lend=lend)
    most = workers or os.cpu_count() or 1
    seconds = 0.0
    finished = {agent: folder.finished(agent) for agent in configs}
    tasks: list[Task] = []
    plants: list[str] = []
    for agent, config in configs.items():
        checked = check(config, lend=lend)
        if not lend.look(config.system).redrivable and not finished[agent]:
            plants.append(agent)
            continue
        missing = [unit for unit in range(config.units) if unit not in finished[agent]]
        seconds += len(missing) * trial_seconds(config, checked)
        for first, count in chunks(missing, chunk_size(config, checked, most)):
            tasks.append((config.to_json(), first, count, folder.chunk_stem(agent, first, count), trace))
    total = sum(config.units * config.episodes for config in configs.values())
    done = sum(len(finished[agent]) * config.episodes for agent, config in configs.items())
    if workers is None:
        most = min(most, 1 + int(seconds / START_SECONDS))
    workers = min(most, len(tasks))
    with tqdm(
        total=total, initial=done, unit=" episodes", unit_scale=True, disable=True if quiet else None, leave=False,
        dynamic_ncols=True, smoothing=0.1,
    ) as bar:  # fmt: skip
        try:
            for agent in plants:
                _run_plant(configs[agent], agent, folder, lend, trace, prepare, bar)
            if workers > 1 and prepare is None:
                _run_in_workers(tasks, list(map(folder.assembly, configs)), workers, bar, lend)
            else:
                for task in tasks:
                    run_chunk(*task, on_rows=lambda rows: bar.update(len(rows)), prepare=prepare, lend=lend)
                for agent in configs:
                    folder.assemble(agent)
        except KeyboardInterrupt:
            raise Stopped(f"stopped. {folder.kept()}") from None
    results = {agent: folder.finished(agent) for agent in configs}
    return {agent: [found[unit] for unit in sorted(found)] for agent, found in results.items()}


def _run_plant(
    config: Config,
    agent: str,
    folder: RunFolder,
    lend: Lender,
    trace: tuple[int, int] | None,
    prepare: Callable[[Loop], object] | None,
    bar: Any,
) -> None:
    """Run what cannot be driven again: in this process, one unit after the other, into a log."""
    from adapters.experiments.logged import run_logged  # stores are of no use to others

    stem = Path(folder.chunk_stem(agent, 0, config.units))
    try:
        run_logged(config, folder.log_path(agent), stem, lend=lend, trace=trace, prepare=prepare, on_passes=bar.update)
    except MapekError as error:
        error.args = (f"{error} {folder.kept()}",)
        raise


def chunk_size(config: Config, checked: Checked, workers: int) -> int:
    """Return how many trials make a chunk.

    It is about a second of work, and less where the run would else have only few chunks for each worker; its Q-tables
    fit into a worker's memory.
    """
    trial = trial_seconds(config, checked)
    share = config.units * trial / (workers * CHUNKS_PER_WORKER)
    seconds = min(CHUNK_SECONDS, max(LEAST_SECONDS, share))
    return max(1, int(min(seconds / trial, CHUNK_BYTES / checked.table_bytes)))


def trial_seconds(config: Config, checked: Checked) -> float:
    """Return roughly how long a trial takes, or one loop of it; rather too long than too short."""
    costs = ((PASS_SECONDS[stage.compiled], STEP_SECONDS[stage.compiled]) for stage in checked.stages)
    return TRIAL_SECONDS + config.episodes * max(one + checked.max_steps * step for one, step in costs)


def check(config: Config, *, in_processes: bool = False, lend: Lender | None = None) -> Checked:
    """Make all that a config names, what it is to swap among it, and say what that tells about the cost of a trial.

    In this process first: what is wrong with a config is said at once, and the compiled code is in the cache before
    several workers want it. Nothing is done to the system.

    Parameters
    ----------
    config
        Of a run that waits for its plans.
    in_processes
        Whether each component is to be a process of its own: then episodes are all that can be compiled.
    lend
        Makes the system that is looked at, and lends it to whoever drives one next.

    Raises
    ------
    MapekError
        Something cannot be made or compiled.
    """
    if lend is None:
        with Lender() as lend:
            return check(config, in_processes=in_processes, lend=lend)
    system = lend.look(config.system)
    loop = Loop(config, system)
    stages: list[Stage] = []
    for first in sorted({1, *(swap.pass_no for swap in config.swap)}):
        for _ in (swap for swap in config.swap if swap.pass_no == first):
            loop.swap()
        stage = _stage(loop, first, in_processes)
        if not stages or stage[1:] != stages[-1][1:]:
            stages.append(stage)
    return Checked(tuple(stages), system.max_steps, 8 * system.n_states * system.n_actions)


def _stage(loop: Loop, first: int, in_processes: bool) -> Stage:
    if not in_processes and loop.stretches() is not None:
        return Stage(first, "passes")
    obstacles = ("each component is a process of its own",) if in_processes else tuple(loop.obstacles())
    return Stage(first, "episodes" if loop.execute.compiled else "nothing", obstacles)


def _run_in_workers(tasks: list[Task], assemblies: list[tuple[Any, ...]], workers: int, bar: Any, lend: Lender) -> None:
    # This process is the first of the workers: it is there already, with all that is compiled. Spawn the others, never
    # fork: a forked process inherits threads' locks. And processes, not threads: what is not compiled of a trial takes
    # as long as what is, and holds the lock of the interpreter.
    context = multiprocessing.get_context("spawn")
    others = workers - 1
    before = signal.getsignal(signal.SIGINT)
    waits: threading.Timer | None = None
    try:
        try:
            made = _Pool(others, mp_context=context, initializer=_start_worker)
        except OSError as error:
            raise MapekError(
                f"no worker process can be started ({error.strerror or error}): they are kept in step by shared memory "
                "(/dev/shm), and by files. --workers 1 does without"
            ) from error
        with made as pool:
            try:
                for results in each_completed(
                    pool, run_chunk, tasks, in_flight=2 * others, here=functools.partial(run_chunk, lend=lend)
                ):
                    bar.update(sum(result.passes for result in results))
                for _ in each_completed(pool, assemble, assemblies, in_flight=others, here=assemble):
                    pass
            except BrokenProcessPool:
                raise MapekError(
                    "a worker process died (killed, or out of memory?); finished trials are kept, and the same command "
                    "with the same --out continues. Fewer --workers need less memory."
                ) from None
            except KeyboardInterrupt:
                # The others end what they are at. Another Ctrl-C ends them at once; as an exception it would break in
                # on the pool's end, which then would be waited for in vain.
                signal.signal(signal.SIGINT, _kill_workers)
                waits = threading.Timer(ctrl_c.SAID_AFTER, _tell_waiting)
                waits.daemon = True
                waits.start()
                raise
    finally:
        if waits is not None:
            waits.cancel()
            signal.signal(signal.SIGINT, before)


def _tell_waiting() -> None:
    busy = len(multiprocessing.active_children())
    for tell in ctrl_c.on_wait:
        tell(f"waiting for what {busy} worker processes are at; Ctrl-C again ends them at once")


def _kill_workers(number: int, frame: FrameType | None) -> None:
    for worker in multiprocessing.active_children():
        worker.kill()


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
    atexit.register(gc.freeze)  # as in every process of ours: at its end nothing is looked through for garbage
    # A parent that is killed can end nobody: the workers would wait for it for ever.
    threading.Thread(target=_leave_with_parent, daemon=True).start()


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    multiprocessing.connection.wait([parent.sentinel])
    os._exit(1)


def drifts_of(config: Config) -> tuple[int, ...]:
    """Return the episodes of a run of `config` from which a new regime holds, where its system knows them.

    A plant is not made for that: its class may say.
    """
    drifts = declared(config.system, "drifts")
    if not is_plant(config.system):
        system = make_system(config.system)
        system.close()
        drifts = system.drifts
    return tuple(drift for drift in drifts if drift <= config.episodes) if isinstance(drifts, tuple) else ()
