"""Trials: independent repetitions of a run, on any `concurrent.futures.Executor`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mape.config import Config, SystemConfig
from mape.errors import MapekError
from mape.loop import Loop
from mape.ports import ManagedSystem

RowListener = Callable[[npt.NDArray[np.void]], object]


class TrialResult(NamedTuple):
    """What one trial came to; `alarms` are the episodes at whose end a detector alarmed."""

    trial: int
    passes: int
    total_steps: int
    alarms: tuple[int, ...]
    log_sha256: str
    q_table_sha256: str


def run_trial(
    config: Config,
    trial: int,
    make_system: Callable[[SystemConfig], ManagedSystem],
    *,
    on_rows: RowListener | None = None,
    prepare: Callable[[Loop], object] | None = None,
) -> TrialResult:
    """Run one trial from its first episode to its last.

    Parameters
    ----------
    config, trial
        What runs, and the number of the trial; with the config's seed it fixes all randomness.
    make_system
        Gives a fresh managed system.
    on_rows
        Gets the log's rows, segment by segment, so that memory does not grow with the number of episodes.
    prepare
        Called with the loop before its first pass, to subscribe or to trace.

    Raises
    ------
    MapekError
        With the number of the trial in front.
    """
    system = make_system(config.system)
    try:
        loop = Loop(config, system, trial)
        steps = 0
        alarms: list[int] = []

        def count(rows: npt.NDArray[np.void]) -> None:
            nonlocal steps
            steps += int(rows["steps"].sum())
            alarms.extend(rows["pass"][rows["alarm"].any(axis=1)].tolist())

        loop.log.on_rows(count)
        if on_rows is not None:
            loop.log.on_rows(on_rows)
        if prepare is not None:
            prepare(loop)
        try:
            loop.run(config.episodes)
        finally:
            loop.log.flush()  # what is finished is heard of, whatever happened then
        return TrialResult(
            trial, loop.log.passes, steps, tuple(alarms), loop.log.sha256(), loop.execute.q_table.sha256()
        )
    except MapekError as error:
        if config.trials > 1 and not str(error).startswith("trial "):
            error.args = (f"trial {trial}: {error}",)
        raise
    finally:
        system.close()


def combined_hash(hashes: Iterable[str]) -> str:
    """Hash the hashes of all trials, in the order of their numbers."""
    return hashlib.sha256("".join(hashes).encode()).hexdigest()


def chunks(trials: Sequence[int], size: int) -> list[tuple[int, int]]:
    """Cut trial numbers, increasing, into runs of neighbours of at most `size`: (first, count).

    >>> chunks([0, 1, 2, 5, 6], 2)
    [(0, 2), (2, 1), (5, 2)]
    """
    found: list[tuple[int, int]] = []
    for trial in trials:
        if found and found[-1][0] + found[-1][1] == trial and found[-1][1] < size:
            found[-1] = (found[-1][0], found[-1][1] + 1)
        else:
            found.append((trial, 1))
    return found


def each_completed(
    executor: Executor, work: Callable[..., Any], tasks: Iterable[tuple[Any, ...]], in_flight: int
) -> Iterator[Any]:
    """Submit `tasks` and yield results as they come, with at most `in_flight` of them submitted at a time.

    What `work` raises is raised here, after the tasks that are running have ended; the others are not begun.
    """
    waiting: set[Future[Any]] = set()
    pending = iter(tasks)
    try:
        while True:
            while len(waiting) < in_flight and (task := next(pending, None)) is not None:
                waiting.add(executor.submit(work, *task))
            if not waiting:
                return
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    finally:
        for future in waiting:
            future.cancel()
