"""What Execute needs, beside the Q-table, to go on elsewhere."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

from knowledge import ChangePlan, from_json, to_json
from mape.errors import ManagedSystemError, PartError
from mape.ports import Json, ManagedSystem
from mape.states import faults, told

Held = tuple[int, dict[str, str]]

SHARED = "shared "
"""Begins the name of what all systems of a process hold together: another one, freshly made, does not begin without."""


class Checkpoint(NamedTuple):
    """Where Execute is between two episodes.

    Attributes
    ----------
    passes : finished episodes.
    plan : the plan in force, or None before plan 0.
    available : actions that the last episode offered, and those enabled since.
    enabled : actions that plans have enabled so far.
    system : what the managed system carries, or None where it does not say.
    held : number of an episode, and what the system held after its reset (`held_by`); None where nobody looked.
    """

    passes: int
    plan: ChangePlan | None
    available: tuple[int, ...]
    enabled: tuple[int, ...]
    system: Json
    held: Held | None = None

    def as_json(self) -> Json:
        """Return it as plain JSON."""
        return {
            "passes": self.passes,
            "plan": None if self.plan is None else json.loads(to_json(self.plan)),
            "available": list(self.available),
            "enabled": list(self.enabled),
            "system": self.system,
            "held": None if self.held is None else list(self.held),
        }

    @classmethod
    def of(cls, state: Json) -> Checkpoint:
        """Read what `as_json` gave.

        Raises
        ------
        PartError
            It is something else.
        """
        try:
            plan: Any = None if state["plan"] is None else from_json(json.dumps(state["plan"]))
            if type(state["passes"]) is not int or not (plan is None or type(plan) is ChangePlan):
                raise ValueError(f"passes {state['passes']!r} under plan {plan}")
            held = None if state.get("held") is None else (int(state["held"][0]), dict(state["held"][1]))
            return cls(state["passes"], plan, tuple(state["available"]), tuple(state["enabled"]), state["system"], held)
        except (KeyError, TypeError, ValueError) as error:
            raise PartError(
                f"Execute cannot go on from {state!r}: {type(error).__name__}: {error}; give what state() gave for the "
                "same config"
            ) from error


def carried_by(system: ManagedSystem) -> Json:
    """Return what the system carries from one episode to the next, as plain JSON; None where it says nothing.

    Raises
    ------
    ManagedSystemError
        The system raised.
    """
    try:
        return system.get_state()
    except faults() as error:
        raise ManagedSystemError(f"{system.name} raised {told(error)}, when it was asked for its state") from error


def held_by(system: ManagedSystem, *, stated: bool = False) -> dict[str, str]:
    """Return a fingerprint of everything that a system holds, by name; nothing where there is nothing to look into.

    Of a system that cannot be driven again, or whose episodes are rules, there is not. What `get_state` speaks for is
    left out, unless it is to be `stated` too.
    """
    look = getattr(system, "held", None)
    if look is None or system.rules is not None or not system.redrivable:
        return {}
    found: dict[str, str] = look(stated=stated)
    return found


def differing(one: dict[str, str], other: dict[str, str]) -> list[str]:
    """Return the names of what two systems do not hold alike.

    >>> differing({"a": "1", "b": "2"}, {"b": "3"})
    ['a', 'b']
    """
    return sorted(name for name in {*one, *other} if one.get(name) != other.get(name))


def take_up(system: ManagedSystem, carried: Json, enabled: tuple[int, ...]) -> None:
    """Have a fresh system go on from what another one carried; one that says nothing is told what was enabled.

    Raises
    ------
    ManagedSystemError
        The system raised, or takes no such state.
    """
    try:
        if carried is not None:
            system.set_state(carried)
        elif enabled:
            system.enable(enabled)
    except faults() as error:
        raise ManagedSystemError(
            f"{system.name} raised {told(error)}, when it was to go on from the state {carried} with "
            f"the actions {enabled} enabled; give it the state of a system of the same config"
        ) from error
