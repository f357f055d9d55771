"""What Execute needs, beside the Q-table, to go on elsewhere."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

from knowledge import ChangePlan, from_json, to_json
from mape.errors import ManagedSystemError, PartError
from mape.ports import Json, ManagedSystem
from mape.states import faults, told


class Checkpoint(NamedTuple):
    """Where Execute is between two episodes.

    Attributes
    ----------
    passes : finished episodes.
    plan : the plan in force, or None before plan 0.
    available : actions that the last episode offered, and those enabled since.
    enabled : actions that plans have enabled so far.
    system : what the managed system carries, or None where it does not say.
    """

    passes: int
    plan: ChangePlan | None
    available: tuple[int, ...]
    enabled: tuple[int, ...]
    system: Json

    def as_json(self) -> Json:
        """Return it as plain JSON."""
        return {
            "passes": self.passes,
            "plan": None if self.plan is None else json.loads(to_json(self.plan)),
            "available": list(self.available),
            "enabled": list(self.enabled),
            "system": self.system,
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
            return cls(state["passes"], plan, tuple(state["available"]), tuple(state["enabled"]), state["system"])
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
