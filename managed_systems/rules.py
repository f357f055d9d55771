"""The compilable face of a managed system: pure functions of numbers, and what a driver must know to call them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

ALWAYS = 2**62
"""Last episode of an action that is never taken away."""

NEVER = 2**62
"""First episode of an action in reserve that nobody has enabled yet."""


class Rules(NamedTuple):
    """A managed system as pure functions of numbers.

    The environment's own `reset` and `step` call these functions, and so may any other driver, in plain Python or
    compiled: they are plain module-level functions without closures, whose only calls are to `math` and to other
    plain module-level functions by their global names. Randomness is passed in as uniforms in [0, 1). The cap on the
    steps of an episode is the driver's to keep.

    Attributes
    ----------
    params : named tuple of numbers and arrays; built once by the environment and never written again.
    phase : ``phase(params, episode) -> int``, which regime holds in an episode (1-based).
    reset : ``reset(params, phase, draws, at) -> int``, the first state; uses ``draws[at : at + reset_draws]``.
    step : ``step(params, phase, state, action, draws, at, context) -> (next_state, reward, terminated)``; uses
        ``draws[at : at + step_draws]`` and adds this step's signals to `context`, shape (len(signal_names),).
    explorable : ``explorable(params, phase, state, action) -> bool``, whether trying the action here can teach
        anything.
    n_states : number of states.
    n_actions : number of actions, available or not; their ids are ``range(n_actions)``.
    max_steps : steps after which an episode is truncated.
    reset_draws, step_draws : uniforms that a reset and a step use.
    signal_names : the system's own signals, in the order of `context`.
    windows : int64 array, shape (n_actions, 2): first and last episode (1-based, inclusive) of each action. Live:
        the environment writes it when actions are enabled.
    drifts : episodes from which a new phase holds. The truth, for evaluation; a manager must not read it.
    legal : ``legal(params, phase, state, action) -> bool``, whether the action may be taken here at all; None where
        every action that is available may.

    Examples
    --------
    An episode that always goes up, from (4, 4) in a 9x9 grid:

    >>> import numpy as np
    >>> from managed_systems.gridworld import Gridworld
    >>> rules = Gridworld().rules
    >>> draws, context = np.empty(0), np.zeros(len(rules.signal_names))
    >>> phase = rules.phase(rules.params, 1)
    >>> state, total = rules.reset(rules.params, phase, draws, 0), 0.0
    >>> for step in range(rules.max_steps):
    ...     at = rules.reset_draws + step * rules.step_draws
    ...     state, reward, terminated = rules.step(rules.params, phase, state, 0, draws, at, context)
    ...     total += reward
    ...     if terminated:
    ...         break
    >>> state, total
    (4, -37.0)
    """

    params: Any
    phase: Callable[[Any, int], int]
    reset: Callable[[Any, int, FloatArray, int], int]
    step: Callable[[Any, int, int, int, FloatArray, int, FloatArray], tuple[int, float, bool]]
    explorable: Callable[[Any, int, int, int], bool]
    n_states: int
    n_actions: int
    max_steps: int
    reset_draws: int
    step_draws: int
    signal_names: tuple[str, ...]
    windows: IntArray
    drifts: tuple[int, ...]
    legal: Callable[[Any, int, int, int], bool] | None = None

    @property
    def episode_draws(self) -> int:
        """Uniforms that an episode of full length uses."""
        return self.reset_draws + self.max_steps * self.step_draws


def phase(params: Any, episode: int) -> int:
    """Count the switches up to an episode; phase 0 holds before the first. The rule of every scheduled system.

    Parameters
    ----------
    params
        Has `switch_at`, int64 array of the episodes (1-based) from which the next phase holds.
    episode
        Number of the episode, from 1.
    """
    count = 0
    for switch in params.switch_at:
        if switch <= episode:
            count += 1
    return count


def available(windows: IntArray, episode: int) -> tuple[int, ...]:
    """Return the ids of the actions available in an episode, in rising order.

    Parameters
    ----------
    windows
        Shape (actions, 2): first and last episode of each action, 1-based and inclusive.
    episode
        Number of the episode, from 1.

    Examples
    --------
    >>> import numpy as np
    >>> available(np.array([[1, ALWAYS], [1, 299], [300, ALWAYS], [NEVER, ALWAYS]]), 300)
    (0, 2)
    """
    # An action in reserve stays so even in episode NEVER, which nobody reaches.
    return tuple(action for action, (first, last) in enumerate(windows.tolist()) if first <= episode <= last)
