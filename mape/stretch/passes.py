"""Quiet passes of the loop, written once: what Execute, Monitor, Analyze and Plan do while nothing changes.

`passes` is a template: `drive`, `sense`, `changed` and `explore` are bound by `mape.compose` to the episode that
Execute drives and to the rules of the parts. It stops at the first pass that is not quiet, with everything but that
pass's episode as it was before; the components take over there. So an alarm, a new action, a refusal and an error have
one semantics, theirs.
"""

from __future__ import annotations

import math
from typing import Any

from knowledge.rows import DOWN, EPSILON, NEXT_EPSILON, PASS, PLAN, SIGNALS, STEPS, UNKNOWN
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
    heads: Floats,
    integers: Ints,
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
    legal: Ints,
    choices: Ints,
    actions: Ints,
    rate: Floats,
    draws: Floats,
    context: Floats,
    discount: float,
    bootstrap_terminal: bool,
    on_policy: bool,
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
    heads, integers
        Written: for each pass the head of its row in the log (`knowledge.rows`), shape (more than count, width); the
        latter is the same memory, seen as integers. Behind the passes that are finished stands that which ended them.
        The last row is given: in it stands which detectors have a statistic before the first pass, NaN for none.
    directions
        Written: the side that each detector names, shape (at least count, detectors).
    state, before, params
        The numbers of all parts, one after the other; `before` is working space of the same length as `state`.
    bounds
        Shape (2 + detectors, 5): of the planner, the analyzer, and each detector where its state and its params begin
        and end, and the column of the signal that it watches.

    What follows is `mape.execute.episode.episode`'s.
    """
    told[FINISHED] = 0
    after_signals = SIGNALS + 4 + len(context)
    detectors = directions.shape[1]
    for i in range(count):
        told[STATUS] = BROKEN
        for k in range(len(state)):
            before[k] = state[k]
        status, steps, total, td_error, change = drive(
            first + i, epsilon, at, trace, system, q, touched, journal, saved, used, rows, legal, choices, actions,
            rate, draws, context, discount, bootstrap_terminal, on_policy, mask_greedy, reset_draws, step_draws,
            max_steps,
        )  # fmt: skip
        if status != OK:
            return
        signals = heads[i, SIGNALS:after_signals]
        signals[0] = total
        signals[1] = steps
        signals[2] = td_error
        signals[3] = change
        for k in range(len(context)):
            signals[4 + k] = context[k]
            if not math.isfinite(context[k]):
                return
        last, readings = heads[i - 1, after_signals:], heads[i, after_signals:]
        quiet = sense(0, detectors, signals, state, params, bounds, last, readings, directions[i])
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
        integers[i, PASS] = first + i
        integers[i, PLAN] = first + i - 1
        integers[i, STEPS] = steps
        heads[i, EPSILON] = epsilon
        heads[i, NEXT_EPSILON] = following
        epsilon = following
        at += width
        told[FINISHED] = i + 1
    told[STATUS] = DONE


def sense_none(
    k: int,
    count: int,
    signals: Floats,
    state: Floats,
    params: Floats,
    bounds: Ints,
    last: Floats,
    readings: Floats,
    directions: Ints,
) -> bool:
    """Say that no detector alarms, where there is none."""
    return True


def sense_each(
    k: int,
    count: int,
    signals: Floats,
    state: Floats,
    params: Floats,
    bounds: Ints,
    last: Floats,
    readings: Floats,
    directions: Ints,
) -> bool:
    """Feed detector number `k` of `count`, and those after it; say whether all of them are quiet.

    Their values and then their statistics are written to `readings`, as those of the pass before stand in `last`. One
    that loses its statistic is not quiet: whether it has none from then on, or NaN by a fault, its own methods tell.
    """
    begin, end, begin_params, end_params, column = bounds[2 + k]
    x = signals[column]
    alarm, statistic, direction = detector(state[begin:end], params[begin_params:end_params], x)
    readings[k] = x
    readings[count + k] = math.nan if math.isnan(statistic) else statistic  # of all that are NaN, one
    directions[k] = direction
    if alarm or math.isinf(statistic) or not DOWN <= direction <= UNKNOWN:
        return False
    if math.isnan(statistic) and not math.isnan(last[count + k]):
        return False
    quiet: bool = others(k + 1, count, signals, state, params, bounds, last, readings, directions)
    return quiet
