"""The Q-table: one row per action, one column per state, growing and shrinking by action."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from knowledge.records import MalformedRecord

SCHEMA = "QTable/1"
"""Schema of a table's header on the wire, and its version."""

_HEADER = ("schema", "actions", "shape", "dtype", "sha256")


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
    values : float64 array, shape (actions, states), Fortran-contiguous: the values of a state stand together, as they
        are looked at. A new array after each change of the rows.

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
        self.values: npt.NDArray[np.float64] = np.zeros((len(self.actions), n_states), order="F")

    @property
    def n_states(self) -> int:
        """Number of columns."""
        return int(self.values.shape[1])

    def add(self, actions: Iterable[int]) -> None:
        """Append a row of zeros for each action that has none yet."""
        new = tuple(a for a in actions if a not in self.actions)
        if new:
            self.values = np.asfortranarray(np.concatenate([self.values, np.zeros((len(new), self.n_states))]))
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
        self.values = np.asfortranarray(self.values[keep])
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

    def to_bytes(self) -> tuple[dict[str, Any], bytes]:
        """Write the table as a header that JSON can hold, and its values.

        Returns
        -------
        header : ``schema``, ``actions`` (ids in the order of their rows), ``shape`` (actions, states), ``dtype`` and
            ``sha256``, the hash of the whole table.
        data : the values, row-major little-endian float64.

        Raises
        ------
        MalformedRecord
            A value is not finite.

        Examples
        --------
        >>> header, data = QTable((0, 7), n_states=3).to_bytes()
        >>> header["actions"], header["shape"], len(data)
        ([0, 7], [2, 3], 48)
        """
        if not np.isfinite(self.values).all():
            raise MalformedRecord(f"{SCHEMA}: the table holds a value that is not finite")
        header = {
            "schema": SCHEMA,
            "actions": list(self.actions),
            "shape": list(self.values.shape),
            "dtype": "<f8",
            "sha256": self.sha256(),
        }
        return header, self.values.astype("<f8", order="C").tobytes()

    @classmethod
    def from_bytes(cls, header: dict[str, Any], data: bytes) -> QTable:
        """Read what `to_bytes` wrote; strict: no other version, no unknown or missing key, no value that is not finite.

        Raises
        ------
        MalformedRecord
            Says what is wrong.
        """
        if not isinstance(header, dict) or header.get("schema") != SCHEMA:
            raise MalformedRecord(f"the header of a Q-table is an object with the schema {SCHEMA}")
        if header.keys() != set(_HEADER):
            raise MalformedRecord(
                f"{SCHEMA}: a header holds {', '.join(_HEADER)}, and not {', '.join(map(str, header))}"
            )
        actions, shape = header["actions"], header["shape"]
        if not (_are_integers(actions) and _are_integers(shape) and len(shape) == 2):
            raise MalformedRecord(f"{SCHEMA}: actions is a list of integers, and shape one of two")
        if header["dtype"] != "<f8" or shape[0] != len(actions) or 8 * shape[0] * shape[1] != len(data):
            raise MalformedRecord(
                f"{SCHEMA}: {len(actions)} actions and {len(data)} bytes are no table of shape {shape} and dtype <f8"
            )
        try:
            table = cls(actions, shape[1])
            table.values[:] = np.frombuffer(data, "<f8").reshape(shape)
            digest = table.sha256()
        except (ValueError, OverflowError, struct.error) as error:
            raise MalformedRecord(f"{SCHEMA}: {error}") from error
        if not np.isfinite(table.values).all():
            raise MalformedRecord(f"{SCHEMA}: the table holds a value that is not finite")
        if header["sha256"] != digest:
            raise MalformedRecord(f"{SCHEMA}: sha256 is {header['sha256']!r}; the hash of the table is {digest!r}")
        return table


def _are_integers(given: Any) -> bool:
    # A bool is an int to isinstance.
    return type(given) is list and all(type(item) is int for item in given)
