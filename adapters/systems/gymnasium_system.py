"""A Gymnasium environment as a managed system: unmodified, or played from its transition table."""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from adapters.systems import answers
from adapters.systems.held import held
from adapters.systems.refusals import refusal
from adapters.systems.state_index import state_index
from adapters.systems.tabulated import Tabulated
from adapters.systems.wrappers import altering_wrapper, step_cap, step_caps
from managed_systems import register_envs
from managed_systems.rules import available
from mape import registry
from mape.config import SystemConfig
from mape.errors import ConfigError, ManagedSystemError, UnknownName
from mape.ports import Episode, StepRules
from mape.states import faults, told
from mape.values import ids, shown, truth

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
    registry.look_here()
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
        self.config = config
        self.name = config.id
        self._base: Any = env.unwrapped
        if not isinstance(env.action_space, spaces.Discrete):
            raise ConfigError(f"{self.name} has actions {env.action_space}; the loop needs Discrete actions")
        if env.action_space.n < 1:
            raise ConfigError(f"{self.name} has no action; a managed system has at least one")
        self.n_states, self._index = state_index(env.observation_space, config.discretise, self.name)
        self.rules: StepRules | None = rules_of(env)
        rules: Any = _own_rules(self._base)  # what they declare holds below any wrapper
        self.max_steps = step_cap(self.name, config.max_steps, [getattr(rules, "max_steps", None), *step_caps(env)])
        self.signal_names = _names(self.name, getattr(rules, "signal_names", getattr(self._base, "signal_names", ())))
        self.drifts = _episodes(self.name, getattr(rules, "drifts", getattr(self._base, "drifts", ())))
        self.draws: tuple[int, int] = (0, 0)
        if self.rules is not None:
            self.draws = (self.rules.reset_draws, self.rules.step_draws)
        self._takes = config.reset_takes
        _give_reset(self.name, self._base, self._takes, rules is not None)
        said = getattr(self._base, "redrivable", "seed" in self._takes)
        declared_redrivable = truth(said)
        if declared_redrivable is None:
            raise ConfigError(f"{self.name} says redrivable = {said!r}; it is True or False")
        self.redrivable = declared_redrivable if config.redrivable is None else config.redrivable
        self._block = getattr(self.rules, "episode_draws", 0)
        self.legal_actions: frozenset[int] | None = None
        self.taken: int | None = None
        self._hard = False  # whether this episode says which actions are legal
        self._teaches_nothing = rules is not None  # a mask of zeros is then no more than that, in both engines
        self._mask: Any = None
        self._actions = self._action_range()
        self._windows: tuple[int, int, tuple[int, ...]] | None = None
        self._connected = False
        self._due: list[Callable[[], object]] = []  # what is to be done to a plant once it is connected

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
            It cannot be connected, or returned something else than a reset does, or what it returned is outside of
            what it declares: its observation, the actions that it offers, or those that are legal.
        """
        if not self._connected:
            self._connect(episode.number)
        options: dict[str, Any] = {"episode": episode.number}
        if self.rules is not None:
            # Where the config's step cap is below the system's own, the rest of the block is never reached.
            uniforms = np.zeros(max(self._block, len(episode.uniforms)))
            uniforms[: len(episode.uniforms)] = episode.uniforms
            options["uniforms"] = uniforms
        try:
            answer: Any = self.env.reset(seed=episode.seed, options=options)
        except faults() as error:
            answers.refuse_old_api(self.name, error)
            if (strict := self._strict(error)) is None:
                raise
            raise strict from error
        seen, info = answers.reset_answer(self.name, answer)
        self._actions = self._action_range()
        self._hard = "legal_actions" in info
        self.taken = None
        self._see(info, terminated=False)
        state = self._index(seen)
        if "available_actions" not in info:
            return state, tuple(self._actions)
        of = f" of episode {episode.number}"
        return state, answers.action_ids(self.name, "available_actions", info["available_actions"], self._actions, of)

    def step(self, action: int, context: npt.NDArray[np.float64]) -> tuple[int, float, bool, bool]:
        """Act; return next state, reward, terminated, truncated.

        Raises
        ------
        ManagedSystemError
            It returned something else than a step does, or what it returned is outside of what it declares: its
            observation, reward, signals, mask, or the actions that are legal.
        """
        try:
            answer: Any = self.env.step(action)
        except faults() as error:
            answers.refuse_old_api(self.name, error)
            raise
        seen, reward, terminated, truncated, info = answers.step_answer(self.name, answer)
        self._see(info, terminated)
        taken = info.get("action_taken")
        self.taken = None if taken is None else answers.taken(self.name, taken, self._actions)
        if self.signal_names:
            answers.signals(self.name, self.signal_names, info, context)
        return self._index(seen), reward, terminated, truncated

    def explorable(self, action: int) -> bool:
        """Look the action up in the present state's ``info["action_mask"]``; without one, all may be tried."""
        return self._mask is None or answers.marked(self.name, self._mask, action - self._actions.start)

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
        self._once_connected(lambda: self._base.enable_actions(actions))
        self._windows = None

    def get_state(self) -> Any:
        """Return what the environment carries from one episode to the next, or None where it does not say.

        One that cannot be driven again is not asked before it is connected.
        """
        return self._base.get_state() if self.says_state and (self.redrivable or self._connected) else None

    def set_state(self, state: Any) -> None:
        """Let the environment take up what `get_state` returned.

        Raises
        ------
        ValueError
            The environment does not take a state, or not this one.
        """
        if self.says_state:
            self._once_connected(lambda: self._base.set_state(state))
        elif state is not None:
            raise ValueError(f"{self.name} takes no state (no get_state and set_state); give None")
        self._windows = None

    def held(self, *, stated: bool = False) -> dict[str, str]:
        """Return a fingerprint of everything that it holds, by name; see `adapters.systems.held`.

        What the environment says itself, by `get_state`, is left out unless it is to be `stated` too.
        """
        return held(self.env, base=stated or not self.says_state)

    def renew(self) -> None:
        """Close the environment, and make another one.

        Raises
        ------
        ConfigError
            There is none any more.
        """
        try:
            self.env.close()
        except faults():
            pass  # it has failed already
        self.env = make_env(self.config)
        self._base = self.env.unwrapped
        self._connected = False
        self._due.clear()
        self._windows = None

    def _once_connected(self, do: Callable[[], object]) -> None:
        """Do something to the environment; to a plant that is not connected yet, once it is."""
        if self.redrivable or self._connected:
            do()
        else:
            self._due.append(do)

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
            for do in self._due:
                do()
        except faults() as error:
            going_on = ", and to go on from where it was," if self._due else ""
            raise ManagedSystemError(
                f"{self.name} raised {told(error)}, when it was to connect{going_on} before episode {number}. The "
                f"{number - 1} passes before it stand in the log."
            ) from error
        self._connected = True
        self._due.clear()

    def _action_range(self) -> range:
        # Asked at each reset: an environment may reassign its action space.
        space: Any = self.env.action_space
        return range(int(space.start), int(space.start + space.n))

    def _see(self, info: answers.Info, terminated: bool) -> None:
        self._mask = marks = info.get("action_mask")
        if marks is not None:
            answers.mask(self.name, marks, self._actions)
            if not terminated and not self._teaches_nothing:
                answers.refuse_empty_mask(self.name, marks, self._actions)
        if "legal_actions" not in info and (terminated or not self._hard):
            self.legal_actions = None
            return
        if not self._hard or "legal_actions" not in info:
            here, there = ("a step", "the reset") if "legal_actions" in info else ("the reset", "a step")
            raise ManagedSystemError(
                f"{self.name} gave info['legal_actions'] at {here} and none at {there} of the same episode; what is "
                "legal is said at the reset and at each step, or never"
            )
        self.legal_actions = answers.legal(self.name, info["legal_actions"], self._actions)
        if not self.legal_actions and not terminated:
            raise ManagedSystemError(
                f"{self.name} gave info['legal_actions'] = {shown(info['legal_actions'])} in a state that is not "
                "terminal; one action at least is legal there, such as one that waits"
            )

    def _strict(self, error: BaseException) -> ManagedSystemError | None:
        """Return an error with the way out where what the reset raised may be about what it was given, or None."""
        if not any(word in str(error) for word in ("option", "episode", "uniforms", "seed", "keyword")):
            return None
        return ManagedSystemError(
            f"{self.name} raised {told(error)} from reset(), which was given {' and '.join(self._takes) or 'nothing'}. "
            "If it takes less, name what it takes: system.reset_takes = ['seed'], or []"
        )


def _reset_with(reset: Any, takes: tuple[str, ...], *, seed: int | None = None, options: Any = None) -> Any:
    given = {"seed": seed, "options": options}
    return reset(**{name: given[name] for name in takes})


def _give_reset(name: str, base: Any, takes: tuple[str, ...], needs_uniforms: bool) -> None:
    """Let an environment's reset be given no more than it takes.

    Raises
    ------
    ConfigError
        It takes less than that, or its rules need what would be kept from them.
    """
    _check_reset(name, base.reset, takes, needs_uniforms)
    if {*takes} != {"seed", "options"}:
        # Below the wrappers, which hand on both.
        base.reset = functools.partial(_reset_with, base.reset, takes)


def _check_reset(name: str, reset: Any, takes: tuple[str, ...], needs_uniforms: bool) -> None:
    if needs_uniforms and "options" not in takes:
        raise ConfigError(
            f"system.reset_takes = {list(takes)} leaves out options, by which {name} is given its randomness; leave it "
            "as it is by default"
        )
    try:
        parameters = inspect.signature(reset).parameters
    except (TypeError, ValueError):  # one that is not written in Python
        return
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
        return
    missing = [word for word in takes if word not in parameters]
    if missing:
        known = [word for word in takes if word in parameters]
        raise ConfigError(
            f"the reset of {name} takes no {' and no '.join(missing)}. Set system.reset_takes = {known}, which gives "
            "it no more than it takes, or let it have them, as Gymnasium's reset(*, seed=None, options=None)"
        )


def _names(name: str, declared: Any) -> tuple[str, ...]:
    names = None if isinstance(declared, str) else tuple(declared)
    if names is None or not all(isinstance(signal, str) for signal in names):
        raise ConfigError(f"{name} declares signal_names = {declared!r}; it is a tuple of names, such as ('load',)")
    return names


def _episodes(name: str, declared: Any) -> tuple[int, ...]:
    episodes = ids(declared)
    if episodes is None:
        raise ConfigError(f"{name} declares drifts = {declared!r}; it is a tuple of episodes, such as (301,)")
    return episodes
