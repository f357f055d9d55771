"""Rules of learners and systems with one fault each; at module level, so that they can be compiled."""

from typing import NamedTuple

import numpy as np


def writes_q(q, rows, count, state, best, epsilon):
    q[rows[0], state] += 1.0
    return q[rows[0], state]


def infinite(q, rows, count, state, best, epsilon):
    return np.inf


def overflows(q, rows, count, state, best, epsilon):
    return float((state + 1) * 4_000_000_000 * 4_000_000_000)


CALLS = [0]


def counts(td_error, rate):
    CALLS[0] += 1
    return 1.0 / CALLS[0]


def no_rule_of_numbers(td_error, rate):
    return float("".join(sorted({"0", ".", "5"}, key=str)[::-1]).replace("5.0", "0.5").replace("50.", "0.5"))


class WalkParams(NamedTuple):
    size: int


def phase(params, episode):
    return 0


def reset(params, phase, draws, at):
    return 0


def step(params, phase, state, action, draws, at, context):
    landed = min(max(state + (1 if action else -1), 0), params.size - 1)
    return landed, -1.0, landed == params.size - 1


def step_with_another_reward(params, phase, state, action, draws, at, context):
    landed, reward, ended = step(params, phase, state, action, draws, at, context)
    return landed, reward + 1e-9 * state, ended


def overflowing_step(params, phase, state, action, draws, at, context):
    landed = min(max(state + (1 if action else -1), 0), params.size - 1)
    return landed, float((landed + 3) * 4_000_000_000 * 4_000_000_000), landed == params.size - 1


def explorable(params, phase, state, action):
    return True
