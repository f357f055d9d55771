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
    """What one trial came to, or one loop of it.

    `alarms` are the episodes at whose end a detector alarmed; `handed_over` says of each swap that was made whether
    the new part took over the state of the old one. `dropped` is the number of passes of a free-running loop of which
    there is no record. `aborted` are the attempts at episodes that the system broke off, each as the episode and why.
    """

    trial: int
    passes: int
    total_steps: int
    alarms: tuple[int, ...]
    log_sha256: str
    q_table_sha256: str
    loop: int = 0
    handed_over: tuple[bool, ...] = ()
    dropped: int = 0
    aborted: tuple[tuple[int, str], ...] = ()


def run_trial(
    config: Config,
    trial: int,
    make_system: Callable[[SystemConfig], ManagedSystem],
    *,
    loop: int = 0,
    on_rows: RowListener | None = None,
    prepare: Callable[[Loop], object] | None = None,
) -> TrialResult:
    """Run one loop of one trial from its first episode to its last.

    Parameters
    ----------
    config, trial
        What runs, and the number of the trial.
    make_system
        Gives a fresh managed system.
    loop
        Which of the trial's loops; with the trial and the config's seed it fixes all randomness.
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
        running = Loop(config, system, trial, loop)
        steps = 0
        alarms: list[int] = []
        handed_over: list[bool] = []

        def count(rows: npt.NDArray[np.void]) -> None:
            nonlocal steps
            more, alarmed = steps_and_alarms(rows)
            steps += more
            alarms.extend(alarmed)

        aborted: list[tuple[int, str]] = []
        running.execute.attempts.on_abort = lambda number, why: aborted.append((number, why))
        running.log.on_rows(count)
        running.on_swap(lambda swap, kept: handed_over.append(kept))
        if on_rows is not None:
            running.log.on_rows(on_rows)
        if prepare is not None:
            prepare(running)
        try:
            running.run(config.episodes)
        finally:
            running.log.flush()  # what is finished is heard of, whatever happened then
        result = TrialResult(
            trial,
            running.log.passes,
            steps,
            tuple(alarms),
            running.log.sha256(),
            running.execute.q_table.sha256(),
            loop,
            tuple(handed_over),
            aborted=tuple(aborted),
        )
        running.close()
        return result
    except MapekError as error:
        if config.units > 1 and not str(error).startswith("trial "):
            error.args = (f"{config.unit_name(trial, loop)}: {error}",)
        raise
    finally:
        system.close()


def steps_and_alarms(rows: npt.NDArray[np.void]) -> tuple[int, list[int]]:
    """Return the number of steps of some of the log's rows, and the episodes at whose end a detector alarmed."""
    return int(rows["steps"].sum()), rows["pass"][rows["alarm"].any(axis=1)].tolist()


def combined_hash(hashes: Iterable[str]) -> str:
    """Return one hash for all units, the loops of all trials: of several, that of their hashes, in order."""
    each = list(hashes)
    return each[0] if len(each) == 1 else hashlib.sha256("".join(each).encode()).hexdigest()


def chunks(units: Sequence[int], size: int) -> list[tuple[int, int]]:
    """Cut numbers of units, increasing, into runs of neighbours of at most `size`: (first, count).

    >>> chunks([0, 1, 2, 5, 6], 2)
    [(0, 2), (2, 1), (5, 2)]
    """
    found: list[tuple[int, int]] = []
    for unit in units:
        if found and found[-1][0] + found[-1][1] == unit and found[-1][1] < size:
            found[-1] = (found[-1][0], found[-1][1] + 1)
        else:
            found.append((unit, 1))
    return found


def each_completed(
    executor: Executor,
    work: Callable[..., Any],
    tasks: Iterable[tuple[Any, ...]],
    in_flight: int,
    *,
    here: Callable[..., Any] | None = None,
) -> Iterator[Any]:
    """Submit `tasks` and yield results as they come, with at most `in_flight` of them submitted at a time.

    What `work` raises is raised here, after the tasks that are running have ended; the others are not begun. With
    `here`, who asks for the next result does that with a task too, as long as there is one, and does not just wait.
    """
    waiting: set[Future[Any]] = set()
    pending = iter(tasks)
    try:
        while True:
            # Taken first: else the last tasks would all queue up for the others, with nobody at work here.
            at_hand = None if here is None else next(pending, None)
            while len(waiting) < in_flight and (task := next(pending, None)) is not None:
                waiting.add(executor.submit(work, *task))
            if at_hand is not None and here is not None:
                yield here(*at_hand)
            elif not waiting:
                return
            done, waiting = wait(waiting, timeout=None if at_hand is None else 0.0, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    finally:
        for future in waiting:
            future.cancel()
