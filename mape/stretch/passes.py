"""Quiet passes of the loop, written once: what Execute, Monitor, Analyze and Plan do while nothing changes.

`passes` is a template: `drive`, `sense`, `changed` and `explore` are bound by `mape.compose` to the episode that
Execute drives and to the rules of the parts. It stops at the first pass that is not quiet, with everything but that
pass's episode as it was before; the components take over there. So an alarm, a new action, a refusal and an error have
one semantics, theirs.
"""

from __future__ import annotations

import math
from typing import Any

from mape.execute.episode import OK
from mape.execute.rules import Floats, Ints

# Bound by `mape.compose`.
drive: Any = None
sense: Any = None
changed: Any = None
explore: Any = None
detector: Any = None
others: Any = None

DONE, HANDED_OVER, BROKEN = 0, 1, 2
"""What ended a stretch: its length; a pass whose episode is driven and which is not quiet; an episode that failed."""

STATUS, FINISHED = 0, 1
"""Places in `told`."""


def passes(
    first: int,
    count: int,
    epsilon: float,
    at: int,
    width: int,
    told: Ints,
    numbers: Floats,
    statistics: Floats,
    directions: Ints,
    state: Floats,
    before: Floats,
    params: Floats,
    bounds: Ints,
    trace: Floats,
    system: Any,
    q: Floats,
    touched: Ints,
    journal: Ints,
    saved: Floats,
    used: Ints,
    rows: Ints,
    choices: Ints,
    actions: Ints,
    rate: Floats,
    draws: Floats,
    context: Floats,
    discount: float,
    bootstrap_terminal: bool,
    mask_greedy: bool,
    reset_draws: int,
    step_draws: int,
    max_steps: int,
) -> None:
    """Make passes, as long as they are quiet.

    Parameters
    ----------
    first, count
        Number of the first pass, and how many at most.
    epsilon
        Exploration rate of the plan in force.
    at, width
        Where the first pass's block of `draws` begins, and how long a block is.
    told
        Shape (2,), written: what ended the stretch, and the number of passes that are finished; valid even if a rule
        raised, and the status is then BROKEN.
    numbers, statistics, directions
        Written, a row for each pass: epsilon of the pass, of the next one, and the signals; what each detector reads,
        and the side it names. Shapes (at least count, 2 + signals) and (at least count, detectors).
    state, before, params
        The numbers of all parts, one after the other; `before` is working space of the same length as `state`.
    bounds
        Shape (2 + detectors, 5): of the planner, the analyzer, and each detector where its state and its params begin
        and end, and the column of the signal that it watches.

    What follows is `mape.execute.episode.episode`'s.
    """
    told[FINISHED] = 0
    for i in range(count):
        told[STATUS] = BROKEN
        for k in range(len(state)):
            before[k] = state[k]
        status, steps, total, td_error, change = drive(
            first + i, epsilon, at, trace, system, q, touched, journal, saved, used, rows, choices, actions, rate,
            draws, context, discount, bootstrap_terminal, mask_greedy, reset_draws, step_draws, max_steps,
        )  # fmt: skip
        if status != OK:
            return
        signals = numbers[i, 2:]
        signals[0] = total
        signals[1] = steps
        signals[2] = td_error
        signals[3] = change
        for k in range(len(context)):
            signals[4 + k] = context[k]
            if not math.isfinite(context[k]):
                return
        quiet = sense(2, signals, state, params, bounds, statistics[i], directions[i])
        if quiet:
            quiet = not changed(
                state[bounds[1, 0] : bounds[1, 1]], params[bounds[1, 2] : bounds[1, 3]], signals
            )  # fmt: skip
        following = epsilon
        if quiet:
            following = explore(state[bounds[0, 0] : bounds[0, 1]], params[bounds[0, 2] : bounds[0, 3]], signals)
            quiet = 0.0 <= following <= 1.0
        if not quiet:
            for k in range(len(state)):
                state[k] = before[k]
            told[STATUS] = HANDED_OVER
            return
        numbers[i, 0] = epsilon
        numbers[i, 1] = following
        epsilon = following
        at += width
        told[FINISHED] = i + 1
    told[STATUS] = DONE


def sense_none(
    k: int, signals: Floats, state: Floats, params: Floats, bounds: Ints, statistics: Floats, directions: Ints
) -> bool:
    """Say that no detector alarms, where there is none."""
    return True


def sense_each(
    k: int, signals: Floats, state: Floats, params: Floats, bounds: Ints, statistics: Floats, directions: Ints
) -> bool:
    """Feed detector number k - 2 and those after it; say whether all of them are quiet."""
    alarm, statistic, direction = detector(
        state[bounds[k, 0] : bounds[k, 1]], params[bounds[k, 2] : bounds[k, 3]], signals[bounds[k, 4]]
    )
    statistics[k - 2] = statistic
    directions[k - 2] = direction
    if alarm or math.isinf(statistic):
        return False
    quiet: bool = others(k + 1, signals, state, params, bounds, statistics, directions)
    return quiet
