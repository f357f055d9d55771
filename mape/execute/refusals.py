"""What is said of an episode that cannot be driven, or that was broken off and not learnt from."""

from __future__ import annotations

from math import isfinite

from mape.errors import ManagedSystemError, NonFiniteError
from mape.execute import episode
from mape.ports import ManagedSystem


def refused(
    status: int, system: ManagedSystem, number: int, steps: int, fault: tuple[float, float, float]
) -> ManagedSystemError:
    """Turn a status of `episode.episode` other than OK, and the three numbers it came with, into an error."""
    first, action, last = fault
    where = f"in episode {number} at step {steps}"
    kept = f"Nothing of that episode was learnt; the {number - 1} passes before it stand in the log."
    if status == episode.OFF_TABLE:
        return ManagedSystemError(
            f"{system.name} went to state {int(first)} {where}; its states are 0 .. {system.n_states - 1}. {kept}"
        )
    if status == episode.OVERFLOW:
        return NonFiniteError(
            f"the return of episode {number} became {first}, its mean absolute TD error {action}, its largest "
            f"change of Q {last}: too large for a float. {kept} Scale the rewards down."
        )
    if isfinite(first):
        return NonFiniteError(
            f"the TD error became {last} {where} (reward {first}, action {int(action)}): the Q-values diverge. {kept} "
            "Lower discount, alpha or the rewards."
        )
    return NonFiniteError(
        f"{system.name} gave reward {first} for action {int(action)} {where}; rewards are finite numbers. {kept}"
    )


def check_offer(available: tuple[int, ...], system: ManagedSystem, number: int, max_actions: int) -> None:
    """Look at the actions that a system offers in episode `number`.

    Raises
    ------
    ManagedSystemError
        There is none, one is named twice, or one is outside ``0 .. max_actions - 1``.
    """
    if not available:
        raise ManagedSystemError(
            f"{system.name} offers no action in episode {number}; a managed system has at least one available"
        )
    if len(set(available)) != len(available):
        raise ManagedSystemError(f"{system.name} offers actions {available} in episode {number}; name each action once")
    for action in available:
        if not 0 <= action < max_actions:
            raise ManagedSystemError(
                f"{system.name} offers action {action} in episode {number}; ids are integers from 0 to "
                f"{max_actions - 1}. Raise system.max_actions if it has more."
            )
