"""Managed systems: any Gymnasium environment with discrete actions."""

from adapters.systems.gymnasium_system import GymnasiumSystem, make_system
from adapters.systems.tabulated import Tabulated

__all__ = ["SYSTEMS", "GymnasiumSystem", "Tabulated", "make_system"]

SYSTEMS = {
    "mapek/Gridworld-v0": "goals that move, walls, slip, actions that come and go",
    "mapek/TrafficJunction-v0": "two-lane junction, arrival rates that shift, green phases in reserve",
    "FrozenLake-v1": "Gymnasium's; as every Gymnasium id with discrete actions, unmodified",
    "CliffWalking-v1": "Gymnasium's; needs system.max_steps",
    "Taxi-v4": "Gymnasium's; with an action mask per state",
    "CartPole-v1": "Gymnasium's; real observations, through system.discretise",
}
"""Gymnasium ids that have an example, and what each is; any other one serves too."""
