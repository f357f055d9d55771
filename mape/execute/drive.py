"""The bindings that fit a system to the episode: compilable rules, or any object with `begin` and `step`."""

from __future__ import annotations

from typing import Any

from mape.errors import ManagedSystemError
from mape.execute.rules import Floats, Ints
from mape.ports import ManagedSystem
from mape.values import number, shown, truth, whole

# Bound by `mape.compose`.
phase_rule: Any = None
reset_rule: Any = None
step_rule: Any = None
legal_rule: Any = None


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


def all_are_legal(params: Any, phase: int, state: int, rows: Ints, legal: Ints, actions: Ints) -> int:
    """Let all rows be used, where a system has no rule that bars any; `legal` is `rows`. Return how many."""
    return len(rows)


def narrow_by_rules(params: Any, phase: int, state: int, rows: Ints, legal: Ints, actions: Ints) -> int:
    """Write the rows whose actions are legal in a state into `legal`; return how many."""
    count = 0
    for i in range(len(rows)):
        if legal_rule(params, phase, state, actions[rows[i]]):
            legal[count] = rows[i]
            count += 1
    return count


def credit_as_chosen(system: Any, row: int, actions: Ints) -> int:
    """Let the action that was chosen be learnt from: rules take no other."""
    return row


class Called:
    """A system that is driven by calls: its methods, the state that its last reset gave, and what is legal.

    Attributes
    ----------
    legal : ids of the actions that were legal in the state before, of which the rows stand as they were written; 0
        before the first state of an episode.
    count : number of these rows.
    """

    def __init__(self, system: ManagedSystem) -> None:
        self.system: Any = system
        self.state = 0
        self.legal: frozenset[int] | int | None = 0
        self.count = 0
        self.step = system.step
        self.explorable = system.explorable


def begin_by_calls(called: Called, number: int, draws: Floats, at: int) -> tuple[int, int]:
    """Hand on the state that the system's reset gave; calls know no phase."""
    called.legal = 0
    return 0, called.state


def narrow_by_calls(called: Called, phase: int, state: int, rows: Ints, legal: Ints, actions: Ints) -> int:
    """Ask the system which actions are legal in its present state."""
    ids = getattr(called.system, "legal_actions", None)
    if ids != called.legal:
        called.legal, called.count = ids, 0
        for row in rows.tolist():
            if ids is None or int(actions[row]) in ids:
                legal[called.count] = row
                called.count += 1
    return called.count


def act_by_calls(
    called: Called, phase: int, state: int, action: int, draws: Floats, at: int, context: Floats
) -> tuple[int, float, bool, bool]:
    """Call the system's step."""
    answer = called.step(int(action), context)
    next_state, reward, terminated, truncated = answer
    if type(next_state) is int and type(reward) is float and type(terminated) is bool and type(truncated) is bool:
        return answer
    return _taken_for_it(called.system, answer)


def _taken_for_it(system: Any, answer: tuple[Any, Any, Any, Any]) -> tuple[int, float, bool, bool]:
    """Return what a step gave as Python's own types."""
    found = (whole(answer[0]), number(answer[1]), truth(answer[2]), truth(answer[3]))
    kinds = ("state, an int", "reward, one real number", "terminated, True or False", "truncated, True or False")
    for kind, given, value in zip(kinds, answer, found, strict=True):
        if value is None:
            raise ManagedSystemError(f"{system.name} gave {shown(given)} for the {kind}")
    return found  # type: ignore[return-value]


def credit_by_calls(called: Called, row: int, actions: Ints) -> int:
    """Return the row of the action that the system says it took, where that is another one than was chosen.

    Raises
    ------
    ManagedSystemError
        The Q-table has no row for it.
    """
    taken = getattr(called.system, "taken", None)
    if taken is None or taken == actions[row]:
        return row
    known = actions.tolist()
    if taken not in known:
        raise ManagedSystemError(
            f"{called.system.name} took action {taken} in the place of action {known[row]}, and the Q-table knows "
            f"{tuple(known)}: it has no row to which that could be credited"
        )
    return int(known.index(taken))


def explorable_by_calls(called: Called, phase: int, state: int, action: int) -> bool:
    """Ask the system, whose mask is that of the present state."""
    return called.explorable(int(action))
