"""What an environment's class says of itself, read without making one: a plant is not touched to be looked at."""

from __future__ import annotations

import importlib
from typing import Any

import gymnasium
from gymnasium.envs.registration import load_env_creator

from managed_systems import register_envs
from mape import registry
from mape.config import SystemConfig
from mape.states import faults


def declared(config: SystemConfig, name: str) -> Any:
    """Return an attribute of the class of the environment that a config names; None where that tells nothing.

    Whatever is wrong with the environment is said where one is made.
    """
    register_envs()
    registry.look_here()
    module, _, env_id = config.id.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
        entry_point = gymnasium.spec(env_id).entry_point
        return getattr(load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point, name, None)
    except faults():
        return None


def is_plant(config: SystemConfig) -> bool:
    """Whether it is known beforehand that the system's episodes cannot be driven again.

    A class may leave it to its objects to say so; then only one that is made can tell.
    """
    said = declared(config, "redrivable") if config.redrivable is None else config.redrivable
    return said is False
