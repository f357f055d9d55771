"""The world: managed systems as Gymnasium environments, which do not know who manages them.

Importing this package registers ``mapek/Gridworld-v0`` and ``mapek/TrafficJunction-v0`` with Gymnasium, and
``gymnasium.make("managed_systems:mapek/Gridworld-v0")`` imports it by itself. (Gymnasium 1.0 gave up the entry points
by which it once found the environments of installed packages, so one of the two is needed.)

Examples
--------
>>> import gymnasium
>>> gymnasium.make("managed_systems:mapek/Gridworld-v0").observation_space
Discrete(81)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from gymnasium.envs.registration import register, registry

if TYPE_CHECKING:
    from managed_systems.environment import RulesEnvironment, UnavailableAction
    from managed_systems.gridworld import Gridworld
    from managed_systems.rules import ALWAYS, NEVER, Rules, available
    from managed_systems.traffic import TrafficJunction

__all__ = [
    "ALWAYS",
    "NEVER",
    "Gridworld",
    "Rules",
    "RulesEnvironment",
    "TrafficJunction",
    "UnavailableAction",
    "available",
    "register_envs",
]

_HOME = {
    "ALWAYS": "rules",
    "NEVER": "rules",
    "Gridworld": "gridworld",
    "Rules": "rules",
    "RulesEnvironment": "environment",
    "TrafficJunction": "traffic",
    "UnavailableAction": "environment",
    "available": "rules",
}

_ENVIRONMENTS = {
    "mapek/Gridworld-v0": "managed_systems.gridworld:Gridworld",
    "mapek/TrafficJunction-v0": "managed_systems.traffic:TrafficJunction",
}


def __getattr__(name: str) -> object:
    """Import a public name when it is first asked for.

    Whoever registers the environments, or wants one of them, does not load the others.
    """
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)


def register_envs() -> None:
    """Register the environments with Gymnasium; a second call changes nothing.

    Importing this package has done so already; a program that says it nevertheless tells its reader, and its linter,
    what the import is for.
    """
    for name, entry_point in _ENVIRONMENTS.items():
        if name not in registry:
            register(id=name, entry_point=entry_point)


register_envs()
