"""What every managed system of ours shares: a Gymnasium environment made of `Rules`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Generic, SupportsInt, TypeVar

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.spaces import Discrete, Space

from managed_systems import checks
from managed_systems.rules import FloatArray, Rules, available

Observation = TypeVar("Observation")


class UnavailableAction(InvalidAction, ValueError):
    """An action was taken that the system does not offer in this episode."""


class AvailableActions(Discrete[np.int64]):
    """All action ids of a system, of which `sample` draws only those that are available now.

    An id means the same action for the whole run, so the space cannot shrink when an action goes; yet code that
    knows nothing of availability, Gymnasium's own `check_env` among it, takes whatever `sample` returns.

    Attributes
    ----------
    available : ids of the actions available now, in rising order.

    Examples
    --------
    >>> space = AvailableActions(5, available=(0, 3))
    >>> {int(space.sample()) for _ in range(100)} == {0, 3}
    True
    """

    def __init__(self, n: int, available: tuple[int, ...]) -> None:
        super().__init__(n)
        self.available = available

    def sample(
        self, mask: npt.NDArray[np.int8] | None = None, probability: npt.NDArray[np.int8] | None = None
    ) -> np.int64:
        """Draw one action uniformly from those available; by `mask` or `probability` instead, where one is given.

        Gymnasium annotates `probability` as int8 too; it is a float64 array, as its documentation says.
        """
        if mask is None and probability is None:
            mask = np.zeros(int(self.n), dtype=np.int8)
            mask[list(self.available)] = 1
        return super().sample(mask, probability)


class RulesEnvironment(gymnasium.Env[Observation, SupportsInt], ABC, Generic[Observation]):
    """A Gymnasium environment that plays its `rules`.

    Parameters
    ----------
    rules
        The system as pure functions.
    observation_space
        Space of what `_observe` makes of a state.
    render_mode
        One of ``metadata["render_modes"]``, or None.

    Notes
    -----
    `reset` and `step` return in `info`:

    - ``available_actions``: ids of the actions that this episode offers, a tuple of int;
    - ``action_mask``: int8 array, shape (n_actions,): available, and worth exploring in this state;
    - ``legal_actions``: ids of those that may be taken in this state, of rules that say so;
    - ``signals``: dict of this step's own signals, from `step` of a system that has any.

    An action that is not available, or not legal, raises instead of doing something else in silence: a learner that
    takes one would otherwise learn the value of an action that never happened. `action_space.sample` never draws one.

    A reset without options counts: the first is episode 1, the next one more than the last, whether counted or given.

    Raises
    ------
    ValueError
        `render_mode` is not one of those.
    """

    metadata: dict[str, Any] = {"render_modes": ["ansi", "rgb_array"], "render_fps": 8}  # noqa: RUF012 (typed so by gymnasium.Env)

    def __init__(self, rules: Rules, observation_space: Space[Any], render_mode: str | None) -> None:
        checks.one_of("render_mode", render_mode, (None, *self.metadata["render_modes"]))
        self.render_mode = render_mode
        self.observation_space = observation_space
        self._rules = rules
        self._episode = 0
        self._phase = 0
        self._state = 0
        self._steps = 0
        self._was_reset = False
        self._running = False
        self._draws: FloatArray = np.empty(0)
        self._actions = AvailableActions(rules.n_actions, available(rules.windows, 1))
        self.action_space = self._actions

    @property
    def rules(self) -> Rules:
        """The pure functions behind this environment; `windows` is shared with it."""
        return self._rules

    @abstractmethod
    def _observe(self, state: int) -> Observation:
        """Return the observation of a state."""

    @abstractmethod
    def _as_text(self) -> str:
        """Draw the present state as text."""

    @abstractmethod
    def _as_image(self) -> npt.NDArray[np.uint8]:
        """Draw the present state, shape (height, width, 3)."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Parameters
        ----------
        seed
            Seeds the environment's own generator, as in every Gymnasium environment.
        options
            May hold ``"episode"``, the number of this episode from 1; and ``"uniforms"``, a float64 array in [0, 1)
            of shape (at least ``rules.episode_draws``,), from which the episode takes all its randomness: first
            the reset's, then `step_draws` for each step. Without it they come, as one block of that size, from
            the environment's generator. Other keys are left to wrappers.

        Raises
        ------
        ValueError
            The episode is not an integer of at least 1, or the uniforms are too few, not in one dimension, or
            outside [0, 1).
        """
        options = options or {}
        # All is checked before anything is written: a refused reset leaves the environment, its generator too, as is.
        episode = checks.whole("options['episode']", options.get("episode", self._episode + 1), 1)
        given = None if options.get("uniforms") is None else self._block(options["uniforms"])
        super().reset(seed=seed)
        draws = self.np_random.random(self._rules.episode_draws) if given is None else given
        self._episode = episode
        self._draws = draws
        self._phase = self._rules.phase(self._rules.params, episode)
        self._state = self._rules.reset(self._rules.params, self._phase, draws, 0)
        self._steps = 0
        self._was_reset = self._running = True
        self._renew_availability()
        return self._observe(self._state), self._info()

    def step(self, action: SupportsInt) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take one step.

        Raises
        ------
        gymnasium.error.ResetNeeded
            No episode is under way.
        UnavailableAction
            The action is not available in this episode, or not legal in this state. It is a ValueError, and
            Gymnasium's InvalidAction.
        """
        if not self._running:
            raise ResetNeeded("no episode is under way; call reset() before the first step and after each episode")
        if action not in self._actions.available:
            raise UnavailableAction(
                f"action {action!r} is not available in episode {self._episode}; available are "
                f"{self._actions.available} (info['available_actions'])"
            )
        rules = self._rules
        if action not in self._legal():
            raise UnavailableAction(
                f"action {action!r} is not legal in state {self._state} of episode {self._episode}; legal are "
                f"{self._legal()} (info['legal_actions'])"
            )
        context = np.zeros(len(rules.signal_names))
        at = rules.reset_draws + self._steps * rules.step_draws
        self._state, reward, terminated = rules.step(
            rules.params, self._phase, self._state, int(action), self._draws, at, context
        )
        self._steps += 1
        truncated = not terminated and self._steps >= rules.max_steps
        self._running = not (terminated or truncated)
        info = self._info()
        if rules.signal_names:
            info["signals"] = dict(zip(rules.signal_names, context.tolist(), strict=True))
        return self._observe(self._state), reward, terminated, truncated, info

    def render(self) -> Any:
        """Return the present state as text (``"ansi"``), as an image (``"rgb_array"``), or None without a mode.

        Returns
        -------
        str or uint8 array of shape (height, width, 3) or None

        Raises
        ------
        gymnasium.error.ResetNeeded
            There has been no reset yet.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() draws nothing: give render_mode='ansi' or 'rgb_array' to the constructor")
            return None
        if not self._was_reset:
            raise ResetNeeded("there is nothing to draw yet; call reset() first")
        return self._as_text() if self.render_mode == "ansi" else self._as_image()

    def _renew_availability(self) -> None:
        """Read from the windows what is available in this episode, or in the first before any."""
        self._actions.available = available(self._rules.windows, max(self._episode, 1))

    def _info(self) -> dict[str, Any]:
        rules = self._rules
        mask = np.zeros(rules.n_actions, dtype=np.int8)
        for action in self._actions.available:
            mask[action] = rules.explorable(rules.params, self._phase, self._state, action)
        told: dict[str, Any] = {"available_actions": self._actions.available, "action_mask": mask}
        if rules.legal is not None:
            told["legal_actions"] = self._legal()
        return told

    def _legal(self) -> tuple[int, ...]:
        rules, available = self._rules, self._actions.available
        if rules.legal is None:
            return available
        return tuple(action for action in available if rules.legal(rules.params, self._phase, self._state, action))

    def _block(self, uniforms: object) -> FloatArray:
        """Check and copy the uniforms of one episode, shape (at least `episode_draws`,)."""
        needed = self._rules.episode_draws
        # A copy: the caller may fill its buffer anew before the episode is over.
        block = np.array(uniforms, dtype=np.float64)
        if block.ndim != 1 or len(block) < needed:
            raise ValueError(
                f"options['uniforms'] has shape {block.shape}; give one dimension of at least {needed} numbers: "
                f"{self._rules.reset_draws} for the reset and {self._rules.step_draws} for each of "
                f"{self._rules.max_steps} steps"
            )
        if needed and not (block.min() >= 0.0 and block.max() < 1.0):
            raise ValueError(
                f"options['uniforms'] goes from {block.min()} to {block.max()}; give numbers in [0, 1), such as "
                "numpy.random.Generator.random draws"
            )
        return block
