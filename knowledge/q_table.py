"""The Q-table: one row per action, one column per state, growing and shrinking by action."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt


class QTable:
    """State-action values of a tabular learner.

    Parameters
    ----------
    actions
        Ids of the actions, in the order of their rows.
    n_states
        Number of states, at least 1.

    Attributes
    ----------
    values : float64 array, shape (actions, states), C-contiguous. A new array after each change of the rows.

    Examples
    --------
    >>> q = QTable((0, 1), n_states=3)
    >>> q.add((7,))
    >>> q.actions, q.values.shape
    ((0, 1, 7), (3, 3))
    """

    def __init__(self, actions: Iterable[int], n_states: int) -> None:
        self.actions: tuple[int, ...] = tuple(actions)
        if len(set(self.actions)) != len(self.actions) or any(a < 0 for a in self.actions):
            raise ValueError(f"actions {self.actions} must be distinct and not negative")
        if n_states < 1:
            raise ValueError(f"n_states is {n_states}; a Q-table has at least one state")
        self.values: npt.NDArray[np.float64] = np.zeros((len(self.actions), n_states))

    @property
    def n_states(self) -> int:
        """Number of columns."""
        return int(self.values.shape[1])

    def add(self, actions: Iterable[int]) -> None:
        """Append a row of zeros for each action that has none yet."""
        new = tuple(a for a in actions if a not in self.actions)
        if new:
            self.values = np.concatenate([self.values, np.zeros((len(new), self.n_states))])
            self.actions += new

    def drop(self, actions: Iterable[int]) -> None:
        """Remove the rows of `actions`.

        Raises
        ------
        ValueError
            An action has no row.
        """
        gone = set(actions)
        if unknown := gone - set(self.actions):
            raise ValueError(f"actions {sorted(unknown)} have no row; the table knows {self.actions}")
        keep = [row for row, action in enumerate(self.actions) if action not in gone]
        self.values = np.ascontiguousarray(self.values[keep])
        self.actions = tuple(self.actions[row] for row in keep)

    def copy(self) -> QTable:
        """Return an independent table with the same rows."""
        twin = QTable(self.actions, self.n_states)
        twin.values[:] = self.values
        return twin

    def sha256(self) -> str:
        """Hash shape, action ids and row-major little-endian values, as 64 hexadecimal digits."""
        head = struct.pack(f"<{2 + len(self.actions)}q", *self.values.shape, *self.actions)
        return hashlib.sha256(head + self.values.astype("<f8", order="C").tobytes()).hexdigest()
