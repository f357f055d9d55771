"""What parts say of quiet passes, in which nothing changes; see `mape.ports.QuietRule`."""

from __future__ import annotations

import functools
from typing import Any

from mape.compose import Composed, Rule
from mape.errors import PartError
from mape.ports import QuietRule
from mape.states import faults, told

# Bound by `mape.compose`.
schedule_rule: Any = None


def quiet_of(part: Any) -> QuietRule | None:
    """Return a part's rule, or None where its class declares none.

    One that is inherited does not count: a subclass may do anything else than its base. Where it does the same in a
    quiet pass it says so, by ``quiet = Base.quiet``.

    Raises
    ------
    PartError
        The part raised when it was asked.
    """
    if "quiet" not in vars(type(part)):
        return None
    try:
        rule = part.quiet
    except PartError:
        raise  # its schedule's
    except faults() as error:
        raise PartError(
            f"{type(part).__name__} raised {told(error)}, when it was asked for its rule (quiet). "
            "Mend it, or choose the engine 'python', which asks for none."
        ) from error
    return rule if isinstance(rule, QuietRule) else None


def by_schedule(state: list[float], params: tuple[float, ...], signals: Any) -> float:
    """Advance the schedule by the episode's return, and return the exploration rate."""
    epsilon: float = schedule_rule(state, params, signals[0])
    return epsilon


def quiet_by(schedule: Any) -> QuietRule | None:
    """Return the rule of a planner that explores by `schedule`; None where that has none."""
    rule = quiet_of(schedule)
    return None if rule is None else rule._replace(function=_by(rule.function))


@functools.cache
def _by(schedule_rule: Rule) -> Composed:
    return Composed(by_schedule, {"schedule_rule": schedule_rule})


def obstacle(kind: str, part: Any) -> str | None:
    """Say in a clause why a part has no rule; None where it has one."""
    if quiet_of(part) is not None:
        return None
    if "quiet" in vars(type(part)) and hasattr(part, "schedule"):
        return f"schedule {type(part.schedule).__name__} declares no rule"
    return f"{kind} {type(part).__name__} declares no rule"
