"""What a plan asks of Execute, looked at before anything of it is put in force."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from knowledge import ChangePlan, Knowledge, QTable
from mape.errors import ManagedSystemError, PartError
from mape.execute.rules import rate_array
from mape.ports import Learner, ManagedSystem
from mape.states import faults, told


def fitting(plan: ChangePlan, known: tuple[int, ...]) -> ChangePlan:
    """Return a plan without what other plans have done since the observation of which it was made.

    In a free-running loop several plans may be made of observations that were alike; the action that the first of them
    adds or drops is news to none of the others.
    """
    return plan._replace(
        add=tuple(action for action in plan.add if action not in known),
        drop=tuple(action for action in plan.drop if action in known),
    )


def checked_rate(plan: ChangePlan, learner: Learner) -> npt.NDArray[np.float64]:
    """Return a plan's learning rate as the learner takes it.

    Raises
    ------
    PartError
        It has another number of parameters, or one that is not finite.
    """
    names = learner.rate_names
    if len(plan.learning_rate) != len(names):
        raise PartError(
            f"plan {plan.pass_no} has {len(plan.learning_rate)} learning-rate parameters; the learner takes "
            f"{len(names)}: {', '.join(names)}"
        )
    rates: npt.NDArray[np.float64] = rate_array(plan.learning_rate)
    if not np.isfinite(rates).all():
        raise PartError(f"plan {plan.pass_no} has the learning rate {plan.learning_rate}; it is of finite numbers")
    return rates


def check_actions(plan: ChangePlan, known: tuple[int, ...], available: tuple[int, ...], knowledge: Knowledge) -> None:
    """Look at a plan where it is made, as far as the actions tell whether Execute can put it in force.

    Which actions the system holds in reserve, to enable, the system alone knows.

    Parameters
    ----------
    plan
        What is planned.
    known, available
        Actions with a row in the Q-table, and those that the system offers, as of the observation before the plan.
    knowledge
        Where the table is remembered that the plan may adopt.

    Raises
    ------
    PartError
        An action cannot be dropped, the table is not remembered, or no action would be left.
    """
    after = _rows_after(plan, QTable(known, 1), knowledge)
    if not set(after.actions) & {*available, *plan.enable}:
        raise _none_left(plan, after, "the system", available)


def table_after(
    plan: ChangePlan, table: QTable, available: tuple[int, ...], system: ManagedSystem, knowledge: Knowledge
) -> QTable:
    """Return the Q-table that a plan makes of `table`, or the remembered one that it adopts.

    Raises
    ------
    PartError
        An action cannot be dropped, the table is not remembered or does not fit, or no action would be left.
    """
    after = _rows_after(plan, table, knowledge)
    if after.n_states != system.n_states:
        raise PartError(
            f"plan {plan.pass_no} adopts a Q-table of {after.n_states} states; {system.name} has {system.n_states}"
        )
    # Where only a reset tells what is offered, an enabled action comes with the next one: too late for these rows.
    told = system.available(plan.pass_no + 1) is not None
    if not set(after.actions) & {*available, *(plan.enable if told else ())}:
        raise _none_left(plan, after, system.name, available)
    return after


def _rows_after(plan: ChangePlan, table: QTable, knowledge: Knowledge) -> QTable:
    try:
        after = table.copy() if plan.adopt is None else knowledge.recall(plan.adopt)
        after.add(plan.add)
        after.drop(plan.drop)
    except (LookupError, ValueError) as error:
        raise PartError(f"plan {plan.pass_no} cannot be executed: {error}") from error
    return after


def _none_left(plan: ChangePlan, after: QTable, system: str, available: tuple[int, ...]) -> PartError:
    return PartError(
        f"plan {plan.pass_no} leaves a Q-table of the actions {after.actions}; {system} offers {available}, of which "
        "at least one must stay"
    )


def enable(plan: ChangePlan, system: ManagedSystem) -> None:
    """Have the system enable what a plan wants.

    Raises
    ------
    PartError
        The system holds no such action in reserve.
    ManagedSystemError
        The system raised.
    """
    try:
        system.enable(plan.enable)
    except ValueError as error:
        raise PartError(f"plan {plan.pass_no} cannot be executed: {error}") from error
    except faults() as error:
        raise ManagedSystemError(
            f"{system.name} raised {told(error)}, while it enabled the actions {plan.enable} of plan {plan.pass_no}"
        ) from error
