"""What `mapek check` needs of an environment beside the port's own checks."""

from __future__ import annotations

import re
import warnings
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from adapters.systems.gymnasium_system import make_env, rules_of
from managed_systems import register_envs
from mape.config import BoxGrid, SystemConfig
from mape.testing import Finding

_DECORATION = re.compile(r"\x1b\[\d*m|WARN: ")  # Gymnasium's logger colours its warnings


def is_registered(name: str) -> bool:
    """Whether Gymnasium knows an environment of that id."""
    register_envs()
    return name in gymnasium.registry


def default_view(name: str) -> SystemConfig:
    """Return a config under which a check can drive the environment: a step cap and a grid where it has none."""
    env = make_env(SystemConfig(id=name))
    try:
        grid = None
        space: Any = env.observation_space
        if isinstance(space, spaces.Box):
            size = int(np.prod(space.shape))
            low = np.clip(np.ravel(space.low), -10.0, 10.0).tolist()
            high = np.clip(np.ravel(space.high), -10.0, 10.0).tolist()
            grid = BoxGrid(low=tuple(low), high=tuple(high), bins=(3,) * size)
        capped = env.spec is not None and env.spec.max_episode_steps is not None
        has_own = rules_of(env) is not None
        return SystemConfig(id=name, max_steps=None if capped or has_own else 200, discretise=grid)
    finally:
        env.close()


def check_environment(config: SystemConfig) -> Finding:
    """Run Gymnasium's own checker over the environment, and return what it says as a finding."""
    clause = "passes Gymnasium's check_env"
    env = make_env(config)
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            check_env(env.unwrapped, skip_render_check=True)
    except Exception as error:
        return Finding(clause, "failed", f"{type(error).__name__}: {error}")
    finally:
        env.close()
    remarks = "; ".join(sorted({_DECORATION.sub("", str(warning.message).splitlines()[0]) for warning in said}))
    return Finding(clause, "note" if remarks else "ok", remarks)
