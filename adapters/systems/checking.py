"""What `mapek check` needs of an environment beside the port's own checks."""

from __future__ import annotations

import contextlib
import functools
import re
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from adapters.systems import answers
from adapters.systems.gymnasium_system import GymnasiumSystem, connect, make_env, make_system, rules_of
from managed_systems import register_envs
from mape.config import BoxGrid, SystemConfig
from mape.states import faults, told
from mape.testing import Finding, check_plant, check_system
from mape.testing.systems import EPISODES

_DECORATION = re.compile(r"\x1b\[\d*m|WARN: ")  # Gymnasium's logger colours its warnings

CHECK_ENV = "passes Gymnasium's check_env"

HUGE = 1e6
"""A bound beyond it says no more of the observations than an infinite one does."""


def is_registered(name: str) -> bool:
    """Whether Gymnasium knows an environment of that id."""
    register_envs()
    return name in gymnasium.registry


def default_view(name: str, env: gymnasium.Env[Any, Any]) -> SystemConfig:
    """Return a config under which a check can drive an environment: a step cap and a grid where it has none."""
    grid = None
    space: Any = env.observation_space
    if isinstance(space, spaces.Box):
        low, high = np.ravel(space.low).tolist(), np.ravel(space.high).tolist()
        spans = [_span(float(a), float(b)) for a, b in zip(low, high, strict=True)]
        grid = BoxGrid(low=tuple(a for a, _ in spans), high=tuple(b for _, b in spans), bins=(3,) * len(spans))
    capped = env.spec is not None and env.spec.max_episode_steps is not None
    has_own = rules_of(env) is not None
    return SystemConfig(id=name, max_steps=None if capped or has_own else 200, discretise=grid)


def check_managed(config: SystemConfig, episodes: int | None = None, *, by_name: bool = False) -> list[Finding]:
    """Hold a system against its contract.

    Parameters
    ----------
    config
        The system.
    episodes
        How many each clause drives; None for `EPISODES`, and for none of a plant, of which one object is made, and
        which is reset for nothing else.
    by_name
        Whether only its id is given, and how it is seen is found out.

    Raises
    ------
    ConfigError
        It cannot be made.
    """
    env = make_env(config)
    try:
        if by_name:
            config = default_view(config.id, env)
        redrivable = config.redrivable if config.redrivable is not None else getattr(env.unwrapped, "redrivable", True)
        if not redrivable:
            unasked = Finding(CHECK_ENV, "note", "left out, for it resets as it likes")
            return [unasked, *check_plant(GymnasiumSystem(env, config), episodes or 0)]
    finally:
        env.close()
    episodes = EPISODES if episodes is None else episodes
    first = (
        check_environment(config) if episodes else Finding(CHECK_ENV, "note", "left out, as nothing is to be driven")
    )
    return [first, *check_system(lambda: make_system(config), episodes)]


def _span(low: float, high: float) -> tuple[float, float]:
    """Return the bounds of a dimension, with others for those that are infinite, or as good as that, or equal."""
    if low < -HUGE:
        low = min(-10.0, high - 20.0)
    if high > HUGE:
        high = max(10.0, low + 20.0)
    return (low, high) if low < high else (low - abs(low) - 1.0, high + abs(high) + 1.0)


@contextlib.contextmanager
def _legally(env: Any) -> Iterator[None]:
    """Let no step of an environment take an action that its ``info["legal_actions"]`` bars: a legal one is taken."""
    name, reset, step = type(env).__name__, env.reset, env.step
    legal: list[int] = []

    def look(info: Any) -> None:
        legal.clear()
        if isinstance(info, Mapping) and "legal_actions" in info:
            space = env.action_space
            actions = range(int(space.start), int(space.start + space.n))
            legal.extend(sorted(answers.legal(name, info["legal_actions"], actions)))

    @functools.wraps(reset)
    def looked_at_reset(*arguments: Any, **options: Any) -> Any:
        answer = reset(*arguments, **options)
        look(answer[1] if isinstance(answer, tuple) and len(answer) == 2 else None)
        return answer

    @functools.wraps(step)
    def legal_step(action: Any) -> Any:
        answer = step(action if not legal or action in legal else legal[int(action) % len(legal)])
        look(answer[-1] if isinstance(answer, tuple) else None)
        return answer

    env.reset, env.step = looked_at_reset, legal_step
    try:
        yield
    finally:
        del env.reset, env.step


def check_environment(config: SystemConfig) -> Finding:
    """Run Gymnasium's own checker over the environment, and return what it says as a finding."""
    if {*config.reset_takes} != {"seed", "options"}:
        return Finding(
            CHECK_ENV, "note", f"not asked, as its reset takes {list(config.reset_takes)} (system.reset_takes)"
        )
    env = make_env(config)
    try:
        with warnings.catch_warnings(record=True) as said, _legally(env.unwrapped):
            warnings.simplefilter("always")
            connect(env)
            check_env(env.unwrapped, skip_render_check=True)
    except faults() as error:
        return Finding(CHECK_ENV, "failed", told(error))
    finally:
        env.close()
    remarks = "; ".join(sorted({_DECORATION.sub("", str(warning.message).splitlines()[0]) for warning in said}))
    return Finding(CHECK_ENV, "note" if remarks else "ok", remarks)
