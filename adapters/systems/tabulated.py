"""A Gymnasium environment that shows its transition table, as a system of rules.

Gymnasium's toy texts keep all that they do in ``P[state][action]``, a list of outcomes (probability, next state,
reward, terminated), and in `initial_state_distrib`. Their own `step` draws an outcome from their own generator; the
rules here draw it from the pass's block of uniforms, so that an episode can be compiled.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Discrete

from adapters.systems.wrappers import altering_wrapper, step_cap, step_caps
from managed_systems import drawing
from managed_systems.environment import RulesEnvironment
from managed_systems.rules import ALWAYS, FloatArray, IntArray, Rules
from mape.errors import ConfigError
from mape.states import faults, told
from mape.values import number, shown, truth, whole

WITH_TABLE = ("CliffWalking-v1", "CliffWalkingSlippery-v1", "FrozenLake-v1", "FrozenLake8x8-v1", "Taxi-v4")
"""Gymnasium's own ids that show their table."""

_BEYOND = ("fickle_passenger", "signal_names", "drifts", "enable_actions")
"""Members by which an environment says that it does what no table tells."""

_ROUNDING = 1e-6
"""How far from 1 the probabilities of one draw may add up."""


class TableParams(NamedTuple):
    """What the rules of a table need. An outcome of probability 0 is left out.

    Attributes
    ----------
    starts, start_below : int64 and float64 arrays, shape (starts,): states in which an episode may start, and the
        probability of each and of those before it.
    first : int64 array, shape (states * actions + 1,): the outcomes of an action in a state are
        ``first[pair] : first[pair + 1]``, where pair is ``state * actions + action``.
    below : float64 array, shape (outcomes,): probability of an outcome and of those before it of the same pair.
    next_states, rewards, terminated : int64, float64 and bool arrays, shape (outcomes,).
    mask : bool array, shape (states, actions): whether trying the action there can teach anything.
    """

    starts: IntArray
    start_below: FloatArray
    first: IntArray
    below: FloatArray
    next_states: IntArray
    rewards: FloatArray
    terminated: npt.NDArray[np.bool_]
    mask: npt.NDArray[np.bool_]


def draw(below: FloatArray, first: int, last: int, u: float) -> int:
    """Return the first index in ``first..last`` whose entry of `below` exceeds `u`, found by halving.

    As `gymnasium.envs.toy_text.utils.categorical_sample`, but for a `u` that no entry exceeds, as the rounded sum may
    stop short of 1: that takes the last index, where Gymnasium takes the first.

    Parameters
    ----------
    below
        Cumulative probabilities, not falling within ``first..last``.
    u
        Uniform in [0, 1).

    Examples
    --------
    >>> below = np.array([0.25, 0.5, 0.999])
    >>> [draw(below, 0, 2, u) for u in (0.0, 0.25, 0.5, 0.9995)]
    [0, 1, 2, 2]
    """
    while first < last:
        middle = (first + last) // 2
        if below[middle] > u:
            last = middle
        else:
            first = middle + 1
    return first


def phase(params: TableParams, episode: int) -> int:
    """Return 0: one table holds throughout."""
    return 0


def reset(params: TableParams, phase: int, draws: FloatArray, at: int) -> int:
    """Draw the first state. Uses one draw."""
    return int(params.starts[draw(params.start_below, 0, len(params.starts) - 1, float(draws[at]))])


def step(
    params: TableParams, phase: int, state: int, action: int, draws: FloatArray, at: int, context: FloatArray
) -> tuple[int, float, bool]:
    """Draw one of the outcomes of the action in this state. Uses one draw, even where there is but one outcome."""
    pair = state * params.mask.shape[1] + action
    k = draw(params.below, int(params.first[pair]), int(params.first[pair + 1]) - 1, float(draws[at]))
    return int(params.next_states[k]), float(params.rewards[k]), bool(params.terminated[k])


def explorable(params: TableParams, phase: int, state: int, action: int) -> bool:
    """Look the action up in the mask of the state."""
    return bool(params.mask[state, action])


class Tabulated(RulesEnvironment[int]):
    """A Gymnasium environment played from its transition table, which is read once.

    The unwrapped environment has ``P[state][action]``, a list of (probability, next state, reward, terminated), and
    `initial_state_distrib`, shape (states,); both spaces are Discrete from 0. Where it has `action_mask(state)`, as
    Taxi has, the mask of every state is read too; else everything is worth exploring. The environment itself is
    neither stepped nor kept: what it does beside its table does not happen here.

    Parameters
    ----------
    env
        The environment, bare or with wrappers that change nothing but the number of steps.
    max_steps
        Steps after which an episode is truncated: at most the environment's own cap, which holds by default.
    render_mode
        ``"ansi"``, ``"rgb_array"`` or None.

    Raises
    ------
    ConfigError
        The environment shows no table, or a malformed one, or does more than that says; or no step cap is known, or
        one that is less than `max_steps`.
    ValueError
        `render_mode` is not one of those.

    Examples
    --------
    >>> env = Tabulated(gymnasium.make("FrozenLake-v1"), render_mode="ansi")
    >>> state, info = env.reset(options={"uniforms": np.full(101, 0.5)})
    >>> state, env.step(2)[:3], env.render()  # right: one of down, right and up, of which 0.5 draws the second
    (0, (1, 0.0, False), 'state 1 of 0..15, 4 actions')
    """

    def __init__(
        self, env: gymnasium.Env[Any, Any], max_steps: int | None = None, render_mode: str | None = None
    ) -> None:
        base: Any = env.unwrapped
        name = type(base).__name__ if env.spec is None else env.spec.id
        _check_playable(env, name)
        params = _read(base, name)
        n_states, n_actions = params.mask.shape
        rules = Rules(
            params=params,
            phase=phase,
            reset=reset,
            step=step,
            explorable=explorable,
            n_states=n_states,
            n_actions=n_actions,
            max_steps=step_cap(name, max_steps, step_caps(env)),
            reset_draws=1,
            step_draws=1,
            signal_names=(),
            windows=np.array([(1, ALWAYS)] * n_actions, np.int64),
            drifts=(),
        )
        super().__init__(rules, Discrete(n_states), render_mode)

    def _observe(self, state: int) -> int:
        return state

    def _as_text(self) -> str:
        """Say the state, and how large the table is."""
        return f"state {self._state} of 0..{self._rules.n_states - 1}, {self._rules.n_actions} actions"

    def _as_image(self) -> drawing.Image:
        """Draw the states as squares, row by row, the present one in blue."""
        n_states = self._rules.n_states
        columns = math.isqrt(n_states - 1) + 1
        squares = drawing.blank(-(-n_states // columns), columns)
        of_state = squares.reshape(-1, 3)
        of_state[:n_states] = drawing.LINE
        of_state[self._state] = drawing.BLUE
        side = max(1, 400 // columns)
        return squares.repeat(side, axis=0).repeat(side, axis=1)


def _check_playable(env: gymnasium.Env[Any, Any], name: str) -> None:
    """Refuse an environment that has no table, or that its table does not say all of."""
    base: Any = env.unwrapped
    if getattr(base, "P", None) is None or getattr(base, "initial_state_distrib", None) is None:
        raise ConfigError(
            f"system.tabulated needs an environment with a transition table, P and initial_state_distrib, and {name} "
            f"has none. Of Gymnasium's these have one: {', '.join(WITH_TABLE)}. Leave it out for another one."
        )
    altering = altering_wrapper(env)
    if altering is not None:
        raise ConfigError(
            f"system.tabulated plays the table of the innermost environment, and {name} is wrapped in {altering}, "
            "which may change what that says. Leave it out, or the wrapper."
        )
    beyond = [member for member in _BEYOND if getattr(base, member, None)]
    if beyond:
        raise ConfigError(
            f"system.tabulated plays a table and nothing else, and {name} does more than its table says: it has "
            f"{', '.join(beyond)}. Leave system.tabulated out, or that."
        )
    for what, space in (("observations", base.observation_space), ("actions", base.action_space)):
        if not isinstance(space, Discrete) or space.start != 0:
            raise ConfigError(
                f"system.tabulated needs Discrete {what} that begin at 0, the indices of P; {name} has {space}"
            )


def _read(base: Any, name: str) -> TableParams:
    """Read and check the table of an environment."""
    n_states, n_actions = int(base.observation_space.n), int(base.action_space.n)
    first = [0]
    found: list[tuple[float, int, float, bool]] = []
    row: list[Any]
    for state, action in itertools.product(range(n_states), range(n_actions)):
        where = f"P[{state}][{action}] of {name}"
        try:
            row = [(number(p), whole(s), number(r), truth(ends)) for p, s, r, ends in base.P[state][action]]
        except (LookupError, TypeError, ValueError):
            row = []
        if not row or any(None in outcome for outcome in row):
            raise ConfigError(
                f"{where} is no list of outcomes (probability, next state, reward, terminated); each of {n_states} "
                f"states has one for each of {n_actions} actions"
            )
        sums = _running_sums([outcome[0] for outcome in row], where)
        for upto, (probability, landed, reward, ends) in zip(sums, row, strict=True):
            if not 0 <= landed < n_states:
                raise ConfigError(f"{where} leads to state {landed}; states are 0..{n_states - 1}")
            if not math.isfinite(reward):
                raise ConfigError(f"{where} has reward {reward}; rewards are finite numbers")
            if probability > 0.0:
                found.append((upto, landed, reward, ends))
        first.append(len(found))
    starts, start_below = _starts(base, n_states, name)
    below, next_states, rewards, terminated = zip(*found, strict=True)
    return TableParams(
        starts=starts,
        start_below=start_below,
        first=np.array(first, np.int64),
        below=np.array(below, np.float64),
        next_states=np.array(next_states, np.int64),
        rewards=np.array(rewards, np.float64),
        terminated=np.array(terminated, np.bool_),
        mask=_mask(base, n_states, n_actions, name),
    )


def _running_sums(probabilities: list[float], where: str) -> list[float]:
    """Add the probabilities of one draw up, in the order and with the rounding of `numpy.cumsum`."""
    sums = list(itertools.accumulate(probabilities))
    if not (min(probabilities) >= 0.0 and abs(sums[-1] - 1.0) <= _ROUNDING):
        raise ConfigError(
            f"the probabilities in {where} are {probabilities[:8]}{' and more' * (len(probabilities) > 8)}, in sum "
            f"{sums[-1]}; each is at least 0, and their sum is 1"
        )
    return sums


def _starts(base: Any, n_states: int, name: str) -> tuple[IntArray, FloatArray]:
    where = f"initial_state_distrib of {name}"
    try:
        probabilities = np.asarray(base.initial_state_distrib, np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{where} is no array of probabilities: {error}") from error
    if probabilities.shape != (n_states,):
        raise ConfigError(f"{where} has shape {probabilities.shape}; give a probability for each of {n_states} states")
    sums = np.array(_running_sums(probabilities.tolist(), where))
    starts = np.flatnonzero(probabilities > 0.0).astype(np.int64)
    return starts, sums[starts]


def _mask(base: Any, n_states: int, n_actions: int, name: str) -> npt.NDArray[np.bool_]:
    if not callable(getattr(base, "action_mask", None)):
        return np.ones((n_states, n_actions), np.bool_)
    try:
        mask = np.array([base.action_mask(state) for state in range(n_states)])
    except faults() as error:  # whatever it is that somebody else calls so
        raise ConfigError(f"action_mask(state) of {name} gives no marks: {told(error)}") from error
    if mask.shape != (n_states, n_actions):
        raise ConfigError(
            f"action_mask of {name} gives {mask.shape[1:]} marks for a state; give one for each of {n_actions} actions"
        )
    if mask.dtype.kind not in "biu" or not np.isin(mask, (0, 1)).all():
        raise ConfigError(f"action_mask of {name} gives marks such as {shown(mask.flat[0])}; a mark is 0 or 1")
    return mask.astype(np.bool_)
