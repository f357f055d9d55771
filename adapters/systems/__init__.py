"""Managed systems: any Gymnasium environment with discrete actions."""

from adapters.systems.gymnasium_system import GymnasiumSystem, make_system

__all__ = ["GymnasiumSystem", "make_system"]
