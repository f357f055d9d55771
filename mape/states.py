"""A part is called: what it may raise. Its state: given, taken up, handed over to the part that takes its place."""

from __future__ import annotations

import sys
from typing import Any

from mape.errors import PartError, Stop
from mape.ports import Json

STOPS = (KeyboardInterrupt, GeneratorExit, Stop)
"""What is raised through a part or a managed system by no fault of its own.

All else is a fault, and becomes an error that names the part, whether it is an Exception or not: an exit, for code of
the user's, a simulator among it, ends no run; a panic of code in Rust, whose class nobody can name beforehand.
"""


def faults() -> tuple[type[BaseException], ...]:
    """Return the class of what is just being raised, to stand in an ``except``; none where it is one of `STOPS`.

    >>> try:
    ...     raise SystemExit(3)
    ... except faults() as error:
    ...     print(told(error))
    SystemExit: 3
    """
    raised = sys.exception()
    return () if raised is None or isinstance(raised, STOPS) else (type(raised),)


def told(error: BaseException) -> str:
    """Say what was raised: its kind, and its text where it has one.

    >>> told(ZeroDivisionError("no budget")), told(SystemExit())
    ('ZeroDivisionError: no budget', 'SystemExit')
    """
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def state_of(kind: str, part: Any) -> Json:
    """Return what a part carries from pass to pass.

    Raises
    ------
    PartError
        It has no `state`, or that raised.
    """
    return _call(kind, part, "state")


def restore(kind: str, part: Any, state: Json) -> None:
    """Have a part take up what another one of its kind gave.

    Raises
    ------
    PartError
        It has no `restore`, or that refused the state.
    """
    _call(kind, part, "restore", state)


def hand_over(kind: str, old: Any, new: Any) -> bool:
    """Have a new part take over the old one's state, where both give their state in the same format.

    Returns
    -------
    Whether it did; else it is as it was made.

    Raises
    ------
    PartError
        The old one does not give its state, or the new one does not take it.
    """
    form = getattr(new, "state_format", None)
    if form is None or form != getattr(old, "state_format", None):
        return False
    restore(kind, new, state_of(kind, old))
    return True


def joint_format(name: str, schedule: Any) -> str | None:
    """Return the format of a planner's state that holds its schedule's; None where the schedule's has no name.

    >>> from mape.plan.constant import Constant, ConstantConfig
    >>> joint_format("morphin/1", Constant(ConstantConfig()))
    'morphin/1+none/1'
    """
    form = getattr(schedule, "state_format", None)
    return None if form is None else f"{name}+{form}"


def _call(kind: str, part: Any, method: str, *arguments: Any) -> Any:
    name = type(part).__name__
    if not hasattr(part, method):
        raise PartError(
            f"{kind} {name} has no {method}(), and a loop that is to go on elsewhere needs it; give it state() and "
            "restore(), as `mapek check` asks, or choose another"
        )
    try:
        return getattr(part, method)(*arguments)
    except faults() as error:
        of = f" of {arguments[0]!r}" if arguments else ""
        raise PartError(
            f"{kind} {name} raised {told(error)}, at {method}(){of}. Mend it, and run `mapek check` on it."
        ) from error
