"""A Gymnasium environment as a managed system: unmodified, or played from its transition table."""

from __future__ import annotations

import difflib
import inspect
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from adapters.systems.held import held
from adapters.systems.refusals import refusal
from adapters.systems.state_index import state_index
from adapters.systems.tabulated import Tabulated
from adapters.systems.wrappers import altering_wrapper, least_cap, step_caps
from managed_systems import register_envs
from managed_systems.rules import available
from mape.config import SystemConfig
from mape.errors import ConfigError, ManagedSystemError, UnknownName
from mape.ports import Episode, StepRules
from mape.states import faults, told

_RULES = tuple(name for name in vars(StepRules) if not name.startswith("_"))


def make_system(config: SystemConfig) -> GymnasiumSystem:
    """Make the managed system that a config names.

    Raises
    ------
    ConfigError
        There is no such environment, it refuses its options, or it is no table of states and actions.
    """
    return GymnasiumSystem(make_env(config), config)


def make_env(config: SystemConfig) -> gymnasium.Env[Any, Any]:
    """Make the environment that a config names, or another one of its transition table where the config asks for that.

    Raises
    ------
    ConfigError
        There is no such environment, it refuses its options, or it has no table that could be played.
    """
    env = _make_by_id(config)
    if not config.tabulated:
        return env
    try:
        return Tabulated(env, config.max_steps)
    finally:
        env.close()


def _make_by_id(config: SystemConfig) -> gymnasium.Env[Any, Any]:
    register_envs()
    try:
        # Gymnasium's passive checker would cost every step, and warn at every reset; `mapek check` looks once.
        return gymnasium.make(config.id, disable_env_checker=True, **config.options)
    except gymnasium.error.NameNotFound:
        from adapters.systems import SYSTEMS

        # Of the many ids that Gymnasium knows, those with an example and those that may have been meant.
        known = {*SYSTEMS, *difflib.get_close_matches(config.id, gymnasium.registry, n=3)}
        raise UnknownName("system", config.id, known, "Any other registered Gymnasium id serves too.") from None
    except gymnasium.error.Error as error:
        raise ConfigError(f"system {config.id!r}: {error}") from None
    except ModuleNotFoundError as error:
        # Where the id is "module:Id", Gymnasium raises another error than the import did.
        name = getattr(error.__cause__, "name", None) or error.name
        raise ConfigError(
            f"system {config.id!r} needs the module {name!r}, which is neither installed nor in this folder"
        ) from error
    except faults() as error:
        raise refusal(config, error) from error


def rules_of(env: gymnasium.Env[Any, Any]) -> StepRules | None:
    """Return the rules that equal the environment's steps, or None where it has none, or a wrapper may alter them."""
    return None if altering_wrapper(env) is not None else _own_rules(env.unwrapped)


def _own_rules(base: Any) -> StepRules | None:
    rules = getattr(base, "rules", None)  # the name is a common one
    return rules if all(hasattr(rules, name) for name in _RULES) else None


def connect(env: gymnasium.Env[Any, Any]) -> None:
    """Connect an environment that has a `connect`; one that wants arguments is another thing than ours."""
    method: Any = getattr(env.unwrapped, "connect", None)
    try:
        inspect.signature(method).bind()  # what is no function is refused as well
    except (TypeError, ValueError):
        return
    method()


class GymnasiumSystem:
    """The managed-system port over one environment.

    Parameters
    ----------
    env
        A Gymnasium environment with discrete actions.
    config
        How it is seen: step cap, discretiser, whether its episodes can be driven again.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], config: SystemConfig) -> None:
        self.env = env
        self.name = config.id
        self._base: Any = env.unwrapped
        if not isinstance(env.action_space, spaces.Discrete):
            raise ConfigError(f"{self.name} has actions {env.action_space}; the loop needs Discrete actions")
        if env.action_space.n < 1:
            raise ConfigError(f"{self.name} has no action; a managed system has at least one")
        self.n_states, self._index = state_index(env.observation_space, config.discretise, self.name)
        self.rules: StepRules | None = rules_of(env)
        rules: Any = _own_rules(self._base)  # what they declare holds below any wrapper
        self.max_steps = least_cap(self.name, [config.max_steps, getattr(rules, "max_steps", None), *step_caps(env)])
        self.signal_names: tuple[str, ...] = tuple(
            getattr(rules, "signal_names", getattr(self._base, "signal_names", ()))
        )
        self.drifts: tuple[int, ...] = tuple(getattr(rules, "drifts", getattr(self._base, "drifts", ())))
        self.draws: tuple[int, int] = (0, 0)
        if self.rules is not None:
            self.draws = (self.rules.reset_draws, self.rules.step_draws)
        declared_redrivable = getattr(self._base, "redrivable", True)  # every reset is seeded
        self.redrivable = bool(declared_redrivable if config.redrivable is None else config.redrivable)
        self._block = getattr(self.rules, "episode_draws", 0)
        self._mask: npt.NDArray[np.int8] | None = None
        self._actions = self._action_range()
        self._windows: tuple[int, int, tuple[int, ...]] | None = None
        self._connected = False

    @property
    def n_actions(self) -> int:
        """Number of actions of its action space."""
        return len(self._actions)

    def available(self, episode: int) -> tuple[int, ...] | None:
        """Return the actions of episode `episode` from the rules' windows, or None where only a reset can tell."""
        if self.rules is None:
            return None
        if self._windows is None or not self._windows[0] <= episode < self._windows[1]:
            first, last = self.rules.windows.T
            edges = (*first.tolist(), *(last + 1).tolist())
            begun = max((edge for edge in edges if edge <= episode), default=0)
            ended = min((edge for edge in edges if edge > episode), default=2**63)
            self._windows = (begun, ended, available(self.rules.windows, episode))
        return self._windows[2]

    def begin(self, episode: Episode) -> tuple[int, tuple[int, ...]]:
        """Reset the environment for an episode; return the first state and the available actions.

        Before its first reset, and not before, it is connected: by its `connect`, where it has one that takes nothing.

        Raises
        ------
        ManagedSystemError
            It cannot be connected, offers an action that its action space does not have, or a mask of another length.
        """
        if not self._connected:
            self._connect(episode.number)
        options: dict[str, Any] = {"episode": episode.number}
        if self.rules is not None:
            # Where the config's step cap is below the system's own, the rest of the block is never reached.
            uniforms = np.zeros(max(self._block, len(episode.uniforms)))
            uniforms[: len(episode.uniforms)] = episode.uniforms
            options["uniforms"] = uniforms
        seen, info = self.env.reset(seed=episode.seed, options=options)
        self._actions = self._action_range()
        self._see_mask(info)
        state = self._index(seen)
        if "available_actions" not in info:
            return state, tuple(self._actions)
        offered = tuple(int(action) for action in info["available_actions"])
        for action in offered:
            if action not in self._actions:
                raise ManagedSystemError(
                    f"{self.name} offers action {action} in info['available_actions'] = {offered} of episode "
                    f"{episode.number}; its action space has {self._actions[0]} .. {self._actions[-1]}"
                )
        return state, offered

    def step(self, action: int, context: npt.NDArray[np.float64]) -> tuple[int, float, bool, bool]:
        """Act; return next state, reward, terminated, truncated.

        Raises
        ------
        ManagedSystemError
            A signal that it declares is missing, or its mask is of another length than its action space.
        """
        seen, reward, terminated, truncated, info = self.env.step(action)
        self._see_mask(info)
        if self.signal_names:
            signals = info.get("signals", {})
            for k, name in enumerate(self.signal_names):
                if name not in signals:
                    raise ManagedSystemError(
                        f"{self.name} declares signal {name!r} and did not put it into info['signals']; got "
                        f"{', '.join(signals) or 'none'}"
                    )
                context[k] += float(signals[name])
        return self._index(seen), float(reward), bool(terminated), bool(truncated)

    def explorable(self, action: int) -> bool:
        """Look the action up in the present state's ``info["action_mask"]``; without one, all may be tried."""
        return self._mask is None or bool(self._mask[action - self._actions.start])

    def enable(self, actions: tuple[int, ...]) -> None:
        """Switch reserve actions on.

        Raises
        ------
        ValueError
            The environment has no reserve, or not these.
        """
        if not hasattr(self._base, "enable_actions"):
            raise ValueError(
                f"{self.name} has no actions in reserve (no enable_actions), so {actions} cannot be enabled"
            )
        self._base.enable_actions(actions)
        self._windows = None

    def get_state(self) -> Any:
        """Return what the environment carries from one episode to the next, or None where it does not say."""
        return self._base.get_state() if self.says_state else None

    def set_state(self, state: Any) -> None:
        """Let the environment take up what `get_state` returned.

        Raises
        ------
        ValueError
            The environment does not take a state, or not this one.
        """
        if self.says_state:
            self._base.set_state(state)
        elif state is not None:
            raise ValueError(f"{self.name} takes no state (no get_state and set_state); give None")
        self._windows = None

    def held(self, *, stated: bool = False) -> dict[str, str]:
        """Return a fingerprint of everything that it holds, by name; see `adapters.systems.held`.

        What the environment says itself, by `get_state`, is left out unless it is to be `stated` too.
        """
        return held(self.env, base=stated or not self.says_state)

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    @property
    def says_state(self) -> bool:
        """Whether the environment says what it carries from one episode to the next."""
        return hasattr(self._base, "get_state") and hasattr(self._base, "set_state")

    def _connect(self, number: int) -> None:
        try:
            connect(self.env)
        except faults() as error:
            raise ManagedSystemError(
                f"{self.name} raised {told(error)}, when it was to connect before episode {number}. The {number - 1} "
                "passes before it stand in the log."
            ) from error
        self._connected = True

    def _action_range(self) -> range:
        # Asked at each reset: an environment may reassign its action space.
        space: Any = self.env.action_space
        return range(int(space.start), int(space.start + space.n))

    def _see_mask(self, info: dict[str, Any]) -> None:
        self._mask = mask = info.get("action_mask")
        # An array is asked itself: NumPy's function takes a while, in each step.
        if mask is not None and getattr(mask, "shape", None) != (len(self._actions),) != np.shape(mask):
            raise ManagedSystemError(
                f"{self.name} gave an info['action_mask'] of shape {np.shape(mask)}; it has a mark for each of "
                f"{len(self._actions)} actions, shape ({len(self._actions)},)"
            )
