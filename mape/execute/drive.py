"""The bindings that fit a system to the episode: compilable rules, or any object with `begin` and `step`."""

from __future__ import annotations

from typing import Any

from mape.execute.rules import Floats
from mape.ports import ManagedSystem

# Bound by `mape.compose`.
phase_rule: Any = None
reset_rule: Any = None
step_rule: Any = None


def begin_by_rules(params: Any, number: int, draws: Floats, at: int) -> tuple[int, int]:
    """Begin an episode of a system that offers its rules; return phase and state."""
    phase = phase_rule(params, number)
    return phase, reset_rule(params, phase, draws, at)


def act_by_rules(
    params: Any, phase: int, state: int, action: int, draws: Floats, at: int, context: Floats
) -> tuple[int, float, bool, bool]:
    """Take a step of a system that offers its rules; the step cap alone truncates."""
    next_state, reward, terminated = step_rule(params, phase, state, action, draws, at, context)
    return next_state, reward, terminated, False


class Called:
    """A system that is driven by calls: its methods, and the state that its last reset gave."""

    def __init__(self, system: ManagedSystem) -> None:
        self.state = 0
        self.step = system.step
        self.explorable = system.explorable


def begin_by_calls(called: Called, number: int, draws: Floats, at: int) -> tuple[int, int]:
    """Hand on the state that the system's reset gave; calls know no phase."""
    return 0, called.state


def act_by_calls(
    called: Called, phase: int, state: int, action: int, draws: Floats, at: int, context: Floats
) -> tuple[int, float, bool, bool]:
    """Call the system's step."""
    return called.step(int(action), context)


def explorable_by_calls(called: Called, phase: int, state: int, action: int) -> bool:
    """Ask the system, whose mask is that of the present state."""
    return called.explorable(int(action))
