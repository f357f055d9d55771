"""What stands around a Gymnasium environment: which wrappers leave it as it is, and when its episodes end."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gymnasium
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

from mape.errors import ConfigError

_TRANSPARENT = (OrderEnforcing, PassiveEnvChecker, TimeLimit)


def altering_wrapper(env: gymnasium.Env[Any, Any]) -> str | None:
    """Return the class name of the outermost wrapper that may change more than the number of steps, or None.

    Rules and tables are those of the innermost environment: whatever a wrapper does to observations, actions or
    rewards is not in them.
    """
    while isinstance(env, gymnasium.Wrapper):
        if type(env) not in _TRANSPARENT:  # a subclass may do anything
            return type(env).__name__
        env = env.env
    return None


def step_caps(env: gymnasium.Env[Any, Any]) -> list[int | None]:
    """Return the step cap that the spec names, and those of time limits that the outermost one hides."""
    caps = [None if env.spec is None else env.spec.max_episode_steps]
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, TimeLimit) and env.spec is not None:
            caps.append(env.spec.max_episode_steps)
        env = env.env
    return caps


def step_cap(name: str, asked: int | None, own: Iterable[int | None]) -> int:
    """Return the longest episode that is asked for, or else the least of the caps that the environment has.

    Raises
    ------
    ConfigError
        There is none; or more steps are asked for than the environment's own cap lets be.
    """
    found = [cap for cap in own if cap is not None]
    if asked is not None and found and asked > min(found):
        raise ConfigError(
            f"system.max_steps = {asked}, and the episodes of {name} end after {min(found)} steps by a cap of its own. "
            f"Give at most {min(found)}, or leave it out; the environment's cap is raised where it stands: by "
            f"system.options.max_episode_steps where Gymnasium registers it, or by an option of the environment"
        )
    if asked is None and not found:
        raise ConfigError(
            f"{name} has no step cap of its own, and an episode must end; set system.max_steps, such as 200"
        )
    return int(min(found)) if asked is None else asked
