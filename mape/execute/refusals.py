"""What is said of an episode that cannot be driven, or that was broken off and not learnt from."""

from __future__ import annotations

from math import isfinite

from mape.errors import ManagedSystemError, MapekError, NonFiniteError, PartError
from mape.execute import episode
from mape.ports import ManagedSystem
from mape.states import told
from mape.values import ids, shown


def broken_off(error: BaseException, system: ManagedSystem, number: int, step: int) -> MapekError:
    """Return what was raised in a step as an error that says where; a broken contract keeps its own words and kind."""
    after = f", in episode {number} at step {step}. {_kept(number)}"
    if isinstance(error, PartError):
        return PartError(str(error).rstrip(".") + after)
    if isinstance(error, ManagedSystemError):
        return ManagedSystemError(str(error).rstrip(".") + after)
    return ManagedSystemError(f"{system.name} raised {told(error)}" + after)


def _kept(number: int) -> str:
    return f"Nothing of that episode was learnt; the {number - 1} passes before it stand in the log."


def refused(
    status: int,
    system: ManagedSystem,
    number: int,
    steps: int,
    fault: tuple[float, float, float],
    known: tuple[int, ...],
) -> ManagedSystemError:
    """Turn a status of `episode.episode` other than OK, and the three numbers it came with, into an error.

    `known` are the actions that have a row in the Q-table.
    """
    first, action, last = fault
    where = f"in episode {number} at step {steps}"
    kept = _kept(number)
    if status == episode.NONE_LEGAL:
        legal = getattr(system, "legal_actions", None)
        these = "" if legal is None else f" {tuple(sorted(legal))}"
        return ManagedSystemError(
            f"{system.name} is in state {int(first)} {where}, and of the actions{these} that are legal there none can "
            f"be taken: those in the Q-table are {known}. {kept} In a state that is not terminal one at least is "
            "legal, and on offer since an earlier episode."
        )
    if status == episode.OFF_TABLE:
        return ManagedSystemError(
            f"{system.name} went to state {int(first)} {where}; its states are 0 .. {system.n_states - 1}. {kept}"
        )
    if status == episode.OVERFLOW:
        return NonFiniteError(
            f"the return of episode {number} became {first}, its mean absolute TD error {action}, its largest "
            f"change of Q {last}: too large for a float. {kept} Scale the rewards down."
        )
    if isfinite(first) and isfinite(last):
        return NonFiniteError(
            f"the Q-value of action {int(action)} became infinite or NaN {where}, by an update with the TD error "
            f"{last} (reward {first}). {kept} Lower the step size, or mend the learner's."
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
    if ids(available) is None or not isinstance(available, tuple):
        raise ManagedSystemError(
            f"{system.name} offers {shown(available)} in episode {number}; actions are a tuple of ids, each an int"
        )
    if not available:
        raise ManagedSystemError(
            f"{system.name} offers no action in episode {number}; a managed system has at least one available"
        )
    if len(set(available)) != len(available):
        raise ManagedSystemError(f"{system.name} offers actions {available} in episode {number}; name each action once")
    for action in available:
        if action < 0:
            raise ManagedSystemError(
                f"{system.name} offers action {action} in episode {number}; ids are integers from 0 to "
                f"{max_actions - 1}. Let its action space begin at 0, as Discrete(n) does, by a wrapper such as "
                "Gymnasium's TransformAction where the environment is not yours."
            )
        if action >= max_actions:
            raise ManagedSystemError(
                f"{system.name} offers action {action} in episode {number}; ids are integers from 0 to "
                f"{max_actions - 1}. Raise system.max_actions if it has more."
            )
