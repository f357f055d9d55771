"""A system of random tables, in whose states some actions are not legal, and some not worth exploring."""

from typing import NamedTuple

import numpy as np
from gymnasium.spaces import Discrete

from managed_systems.environment import RulesEnvironment
from managed_systems.rules import ALWAYS, Rules

STATES, ACTIONS = 5, 4


class Tables(NamedTuple):
    """Shape (states, actions) each; `ends` is of states."""

    next_states: np.ndarray
    rewards: np.ndarray
    ends: np.ndarray
    legal: np.ndarray
    worth: np.ndarray


def phase(params, episode):
    return 0


def reset(params, phase, draws, at):
    return 0


def step(params, phase, state, action, draws, at, context):
    landed = params.next_states[state, action]
    return int(landed), float(params.rewards[state, action]), bool(params.ends[landed])


def explorable(params, phase, state, action):
    return bool(params.worth[state, action])


def legal(params, phase, state, action):
    return bool(params.legal[state, action])


def tables(seed, barred=0.5):
    """Random tables; an action is legal in each state that is not terminal."""
    rng = np.random.default_rng(seed)
    shape = (STATES, ACTIONS)
    may = rng.random(shape) >= barred
    may[np.arange(STATES), rng.integers(0, ACTIONS, STATES)] = True
    ends = np.zeros(STATES, np.bool_)
    ends[-1] = True
    may[-1] = rng.random() < 0.5
    return Tables(rng.integers(0, STATES, shape), rng.normal(0.0, 9.0, shape), ends, may, rng.random(shape) >= 0.5)


class Barred(RulesEnvironment):
    """The tables as an environment, which an illegal action would kill."""

    def __init__(self, seed=0, barred=0.5, hard=True, max_steps=12):
        made = tables(seed, barred)
        rules = Rules(
            params=made,
            phase=phase,
            reset=reset,
            step=step,
            explorable=explorable,
            n_states=STATES,
            n_actions=ACTIONS,
            max_steps=max_steps,
            reset_draws=0,
            step_draws=0,
            signal_names=(),
            windows=np.array([(1, ALWAYS)] * ACTIONS, np.int64),
            drifts=(),
            legal=legal if hard else None,
        )
        super().__init__(rules, Discrete(STATES), None)

    def _observe(self, state):
        return state

    def _as_text(self):
        return str(self._state)

    def _as_image(self):
        return np.zeros((1, 1, 3), np.uint8)
