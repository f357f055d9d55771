"""Checks of what a figure is given. Each raises a ValueError that names the value, what is legal, and the way out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


def floats(name: str, value: object, dimensions: int, *, empty: bool = False, gaps: bool = False) -> Floats:
    """Return `value` as a finite float64 array of that many dimensions, with at least one item unless `empty`.

    With `gaps` there may be NaN beside at least one number: what was not recorded.

    Raises
    ------
    ValueError
        It is something else.
    """
    try:
        found = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name} cannot be read as numbers ({error}); give an array of {dimensions} dimension(s)"
        ) from error
    if found.size == 0 and empty:
        return found.reshape((0,) * dimensions)
    if found.ndim != dimensions:
        raise ValueError(f"{name} has shape {found.shape}; give an array of {dimensions} dimension(s)")
    if found.size == 0:
        raise ValueError(f"{name} is empty, shape {found.shape}; there is nothing to draw without at least one item")
    wrong = np.isinf(found) if gaps and not np.isnan(found).all() else ~np.isfinite(found)
    if wrong.any():
        where = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise ValueError(f"{name} holds {found[where]} at {where}; give finite numbers")
    return found


def integers(name: str, value: object, *, low: int = 1, empty: bool = False) -> Ints:
    """Return `value` as a one-dimensional int64 array of whole numbers of at least `low`.

    Raises
    ------
    ValueError
        It is something else.
    """
    found = floats(name, value, 1, empty=empty)
    whole = found.astype(np.int64)
    if (whole != found).any():
        raise ValueError(f"{name} holds {found[whole != found][0]}; give whole numbers")
    if found.size and whole.min() < low:
        raise ValueError(f"{name} holds {whole.min()}; give whole numbers of at least {low}")
    return whole


def columns(name: str, table: Any, wanted: Sequence[str]) -> dict[str, Floats]:
    """Return columns of a structured array or of a mapping of arrays, all of one length.

    Raises
    ------
    ValueError
        A column is missing, of another length, empty or not finite.
    """
    if isinstance(table, Mapping):
        known: tuple[str, ...] = tuple(str(key) for key in table)
    else:
        known = getattr(getattr(table, "dtype", None), "names", None) or ()
    if missing := [column for column in wanted if column not in known]:
        raise ValueError(
            f"{name} has no column {missing[0]!r}; it has {', '.join(known) or 'none'}. Give a structured array or a "
            f"mapping of arrays with {', '.join(wanted)}"
        )
    found = {column: floats(f"{name}[{column!r}]", table[column], 1) for column in wanted}
    first = wanted[0]
    for column, values in found.items():
        if len(values) != len(found[first]):
            raise ValueError(
                f"{name}[{column!r}] has {len(values)} items and {name}[{first!r}] has {len(found[first])}; give "
                "columns of one length"
            )
    return found


def some(name: str, value: Mapping[str, Any] | Sequence[Any]) -> None:
    """Check that there is at least one thing to draw.

    Raises
    ------
    ValueError
        There is none.
    """
    if len(value) == 0:
        raise ValueError(f"{name} is empty; there is nothing to draw without at least one")


def count(name: str, value: object, low: int = 1) -> int:
    """Return `value` as an integer of at least `low`.

    Raises
    ------
    ValueError
        It is something else.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < low:
        raise ValueError(f"{name} is {value!r}; give an integer of at least {low}")
    return int(value)


def cells(name: str, value: Iterable[Sequence[int]], rows: int, columns: int) -> tuple[tuple[int, int], ...]:
    """Return (row, column) cells of a grid.

    Raises
    ------
    ValueError
        One is not a pair of integers inside the grid.
    """
    found = []
    for i, cell in enumerate(value):
        pair = tuple(cell)
        if len(pair) != 2 or any(isinstance(p, bool) or not isinstance(p, int | np.integer) for p in pair):
            raise ValueError(f"{name}[{i}] is {cell!r}; give a cell as (row, column)")
        if not (0 <= pair[0] < rows and 0 <= pair[1] < columns):
            raise ValueError(f"{name}[{i}] is {pair}; give a row in 0..{rows - 1} and a column in 0..{columns - 1}")
        found.append((int(pair[0]), int(pair[1])))
    return tuple(found)
