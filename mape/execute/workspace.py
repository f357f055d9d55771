"""The arrays between a Q-table and the episodes that write it."""

from __future__ import annotations

from typing import Any

import numpy as np

from knowledge import QTable
from mape.execute.rules import Ints


class Workspace:
    """Which rows of a Q-table an episode may use, and an undo journal of what it writes.

    Parameters
    ----------
    longest
        Steps of the longest episode, which touches as many pairs of state and action at most.
    narrowed
        Whether there may be states in which not all that is offered is legal.

    Attributes
    ----------
    used : int64 array, shape (2,): length of the journal, and steps of the episode; valid even if a rule raised.
    """

    def __init__(self, longest: int, narrowed: bool) -> None:
        self._narrowed = narrowed
        self._journal = np.empty(longest, dtype=np.int64)
        self._saved = np.empty(longest)
        self.used: Ints = np.zeros(2, dtype=np.int64)

    def open(self, table: QTable) -> None:
        """Let the next episodes write `table`."""
        self._table = table
        # Stamps are episode numbers, from 1: a fresh table is untouched.
        self._touched = np.zeros(table.values.shape, dtype=np.int64, order="F")
        self._actions = np.array(table.actions, dtype=np.int64)
        self.forget()

    def offer(self, available: tuple[int, ...]) -> bool:
        """Let them use the rows of `available`; say whether there are any, and if not, leave all as it was."""
        usable = [row for row, action in enumerate(self._table.actions) if action in available]
        if usable:
            self._rows = np.array(usable, dtype=np.int64)
            self._legal = np.empty_like(self._rows) if self._narrowed else self._rows
            self._choices = np.empty_like(self._rows)
        return bool(usable)

    @property
    def arguments(self) -> tuple[Any, ...]:
        """The table and the arrays, in the order of `episode.episode`."""
        values = self._table.values
        return (
            values,
            self._touched,
            self._journal,
            self._saved,
            self.used,
            self._rows,
            self._legal,
            self._choices,
            self._actions,
        )

    def forget(self) -> None:
        """Let what the last episode wrote stand: an episode that is broken off before it begins has written nothing."""
        self.used[0] = 0
        self.used[1] = -1

    def roll_back(self) -> None:
        """Make the table what it was before the last episode, if that is not forgotten."""
        pairs = np.divmod(self._journal[: int(self.used[0])], self._table.n_states)
        self._table.values[pairs] = self._saved[: len(pairs[0])]
        # Driven again, the episode saves these pairs anew.
        self._touched[pairs] = 0
