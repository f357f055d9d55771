"""What an environment tells at a reset and a step: looked at, and taken for what it says or refused.

Each function raises a ManagedSystemError that names the value and what is legal there.
"""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from typing import Any

import numpy as np

from mape.errors import ManagedSystemError
from mape.values import ids, number, shown, truth, whole

Info = Mapping[str, Any]

_RESET = "Gymnasium's reset returns (observation, info), info a dict; without info it is the API of before 0.26"
_STEP = (
    "Gymnasium's step returns (observation, reward, terminated, truncated, info), info a dict; with one `done` in the "
    "place of terminated and truncated it is the API of before 0.26"
)


def reset_answer(name: str, answer: Any) -> tuple[Any, Info]:
    """Take what a reset returned apart."""
    if not isinstance(answer, (tuple, list)) or len(answer) != 2 or not isinstance(answer[1], Mapping):
        raise ManagedSystemError(f"{name} returned {shown(answer)} from reset(). {_RESET}: return both")
    return answer[0], answer[1]


def step_answer(name: str, answer: Any) -> tuple[Any, float, bool, bool, Info]:
    """Take what a step returned apart."""
    if not isinstance(answer, (tuple, list)) or len(answer) != 5:
        raise ManagedSystemError(f"{name} returned {shown(answer)} from step(). {_STEP}: return all five")
    seen, reward, terminated, truncated, info = answer
    if type(reward) is not float and (reward := number(reward)) is None:
        raise ManagedSystemError(f"{name} gave the reward {shown(answer[1])}; a reward is one real number, as a float")
    if type(terminated) is not bool or type(truncated) is not bool:
        terminated, truncated = truth(terminated), truth(truncated)
        if terminated is None or truncated is None:
            raise ManagedSystemError(
                f"{name} gave terminated = {shown(answer[2])} and truncated = {shown(answer[3])}; each is True or False"
            )
    if not isinstance(info, Mapping):
        raise ManagedSystemError(f"{name} gave the info {shown(info)}. {_STEP}")
    return seen, reward, terminated, truncated, info


def refuse_old_api(name: str, error: BaseException) -> None:
    """Say it where a wrapper of Gymnasium's failed to take apart what an environment returned by the old API."""
    frames = traceback.extract_tb(error.__traceback__)
    of_wrapper = "gymnasium" in frames[-1].filename and "wrappers" in frames[-1].filename
    if of_wrapper and isinstance(error, (TypeError, ValueError)) and "unpack" in str(error):
        raise ManagedSystemError(f"{name}: {error}. {_RESET}. {_STEP}: return all of them") from error


def action_ids(name: str, key: str, value: Any, actions: range, of: str = "") -> tuple[int, ...]:
    """Take ``info[key]`` for ids of actions that the action space has; `of` says of what in messages."""
    found = ids(value)
    if found is None:
        raise ManagedSystemError(
            f"{name} gave info[{key!r}] = {shown(value)}; it holds ids of actions, integers in {_span(actions)}"
        )
    for action in found:
        if action not in actions:
            raise ManagedSystemError(
                f"{name} offers action {action} in info[{key!r}] = {shown(found)}{of}; its action space has "
                f"{_span(actions)}"
            )
    return found


def mask(name: str, value: Any, actions: range) -> Any:
    """Take ``info["action_mask"]`` for a mark for each action; whether a mark is one, `marked` tells."""
    # An array is asked itself: NumPy's function takes a while, in each step.
    if getattr(value, "shape", None) != (len(actions),) != np.shape(value):
        raise ManagedSystemError(
            f"{name} gave an info['action_mask'] of shape {np.shape(value)}; it has a mark for each of "
            f"{len(actions)} actions, shape ({len(actions)},)"
        )
    return value


def marked(name: str, marks: Any, place: int) -> bool:
    """Return one mark of a mask."""
    mark = marks[place]
    if mark == 1:
        return True
    if mark == 0:
        return False
    raise ManagedSystemError(f"{name} gave an info['action_mask'] of {shown(marks)}; a mark is 0 or 1")


def refuse_empty_mask(name: str, marks: Any, actions: range) -> None:
    """Refuse a mask in which nothing is marked, which would offer everything."""
    if not any(marked(name, marks, place) for place in range(len(actions))):
        raise ManagedSystemError(
            f"{name} gave an info['action_mask'] of {shown(marks)} in a state that is not terminal: no action would be "
            "worth exploring. Mark one at least, or leave the mask out where all are; what must not be done is said by "
            "info['legal_actions']"
        )


def legal(name: str, value: Any, actions: range) -> frozenset[int]:
    """Take ``info["legal_actions"]``: ids, or a mask, which is told by its type, bool or int8, as Gymnasium's are."""
    items = value.tolist() if isinstance(value, np.ndarray) else value
    is_mask = isinstance(value, np.ndarray) and value.dtype in (np.bool_, np.int8)
    if is_mask or (isinstance(items, (list, tuple)) and items and all(isinstance(item, bool) for item in items)):
        if (
            not isinstance(items, (list, tuple))
            or len(items) != len(actions)
            or any(item not in (0, 1) for item in items)
        ):
            raise ManagedSystemError(
                f"{name} gave the mask info['legal_actions'] = {shown(value)}; it has a mark, 0 or 1, for each of "
                f"{len(actions)} actions"
            )
        return frozenset(action for action, mark in zip(actions, items, strict=True) if mark)
    found = action_ids(name, "legal_actions", value, actions)
    if len(set(found)) != len(found):
        raise ManagedSystemError(
            f"{name} gave info['legal_actions'] = {shown(value)}; name each id once. A mask is an array of bool or int8"
        )
    return frozenset(found)


def taken(name: str, value: Any, actions: range) -> int:
    """Take ``info["action_taken"]`` for the id of the action that was done in the place of the chosen one."""
    found = whole(value)
    if found is None or found not in actions:
        raise ManagedSystemError(
            f"{name} gave info['action_taken'] = {shown(value)}; it is the id of an action, in {_span(actions)}"
        )
    return found


def signals(name: str, names: tuple[str, ...], info: Info, context: Any) -> None:
    """Add a step's own signals to `context`, in the order of `names`."""
    given = info.get("signals", {})
    if not isinstance(given, Mapping):
        raise ManagedSystemError(
            f"{name} gave info['signals'] = {shown(given)}; it is a dict of a number for each of {', '.join(names)}"
        )
    for k, signal in enumerate(names):
        if signal not in given:
            raise ManagedSystemError(
                f"{name} declares signal {signal!r} and did not put it into info['signals']; got "
                f"{', '.join(map(str, given)) or 'none'}"
            )
        value = number(given[signal])
        if value is None:
            raise ManagedSystemError(
                f"{name} gave signal {signal!r} = {shown(given[signal])} in info['signals']; a signal is a real number"
            )
        context[k] += value


def _span(actions: range) -> str:
    return f"{actions[0]} .. {actions[-1]}"
