"""Rules of quiet passes with one fault each, and some without; at module level, so that they can be compiled."""

import math

import numpy as np

from knowledge.rows import UNKNOWN, UP
from mape.monitor.page_hinkley import page_hinkley_alarm
from mape.plan.exponential import exponential, exponential_next


def names_no_side(state, params, x):
    alarm, statistic, _ = page_hinkley_alarm(state, params, x)
    return alarm, statistic, UNKNOWN


def names_a_side_that_there_is_not(state, params, x):
    alarm, statistic, _ = page_hinkley_alarm(state, params, x)
    return alarm, statistic, 7


def knows_no_statistic(state, params, x):
    alarm, _, direction = page_hinkley_alarm(state, params, x)
    return alarm, math.nan, direction


def gives_none(state, params, x):
    alarm, _, direction = page_hinkley_alarm(state, params, x)
    return alarm, None, direction


def never_alarms(state, params, x):
    _, statistic, direction = page_hinkley_alarm(state, params, x)
    return False, statistic, direction


def alarms_early(state, params, x):
    alarm, statistic, direction = page_hinkley_alarm(state, params, x)
    return alarm or statistic > 0.01 * params[1], statistic, direction


def counts_twice(state, params, x):
    answer = page_hinkley_alarm(state, params, x)
    state[0] += 1.0
    return answer


def makes_an_array(state, params, x):
    alarm, statistic, direction = page_hinkley_alarm(state, params, x)
    kept = np.zeros(2)
    kept[0] = statistic
    return alarm, kept[0], direction


def counts(state, params, x):
    """Count in whole numbers, far beyond those of the machine."""
    state[0] += 1.0
    return False, float(int(state[0]) * 4_000_000_000 * 4_000_000_000), UP


def grows(state, params, x):
    """Keep each value, in more and more places."""
    state.append(x)
    return False, x, UP


def stands_still(state, params, episode_return):
    return exponential(state[0], params[0], params[1])


def decays_faster(state, params, episode_return):
    return 0.999 * exponential_next(state, params, episode_return)


def decays_half_way(state, params, signals):
    return 0.5 * exponential_next(state, params, signals[0])


def is_low(state, params, signals):
    return signals[0] < params[0]


def counts_low(state, params, signals):
    state[0] += signals[0] < params[0]
    return state[0] >= 3.0
