"""The per-episode table: one row per trial and episode, taken from the log's rows.

============ ========= =======================================================================
column       type      meaning
============ ========= =======================================================================
trial        uint32    number of the trial, from 0
episode      uint32    number of the episode, from 1
steps        uint32    length of the episode
return       float64   sum of the rewards
epsilon      float64   exploration rate of the episode
td_error     float64   mean absolute TD error
q_change     float64   largest absolute change of Q from the end of the episode before
alarm        bool      whether a detector alarmed at the end of the episode
actions      uint16    number of actions that were available
============ ========= =======================================================================
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from adapters.results.files import DAMAGE, whole
from mape.errors import ResultsError

DTYPE = np.dtype(
    [
        ("trial", "<u4"),
        ("episode", "<u4"),
        ("steps", "<u4"),
        ("return", "<f8"),
        ("epsilon", "<f8"),
        ("td_error", "<f8"),
        ("q_change", "<f8"),
        ("alarm", "?"),
        ("actions", "<u2"),
    ]
)
COLUMNS: tuple[str, ...] = tuple(DTYPE.names or ())


def from_rows(trial: int, rows: npt.NDArray[np.void]) -> npt.NDArray[np.void]:
    """Take the table's columns from a segment of the log's rows."""
    table = np.empty(len(rows), DTYPE)
    table["trial"] = trial
    table["episode"] = rows["pass"]
    table["steps"] = rows["steps"]
    table["epsilon"] = rows["epsilon"]
    for i, name in ((0, "return"), (2, "td_error"), (3, "q_change")):
        table[name] = rows["signals"][:, i]
    table["alarm"] = rows["alarm"].any(axis=1)
    table["actions"] = np.bitwise_count(rows["available"]).sum(axis=1)
    return table


def write_npz(path: Path, chunks: Iterable[Path], rows: int) -> None:
    """Write chunk files as one ``.npz`` with an array per column, without holding more than a chunk in memory."""
    files = list(chunks)
    with whole(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for column in COLUMNS:
            with archive.open(f"{column}.npy", "w", force_zip64=True) as member:
                _write_column(member, column, files, rows)


def _write_column(member: IO[bytes], column: str, files: list[Path], rows: int) -> None:
    header: dict[str, Any] = {"descr": DTYPE[column].str, "fortran_order": False, "shape": (rows,)}
    np.lib.format.write_array_header_1_0(member, header)
    for chunk in files:
        member.write(np.ascontiguousarray(np.fromfile(chunk, DTYPE)[column]).tobytes())


def read_episodes(path: str | Path, columns: Iterable[str] = COLUMNS) -> dict[str, npt.NDArray[Any]]:
    """Read columns of a per-episode table, each of shape (trials, episodes).

    Raises
    ------
    ResultsError
        The file is missing, cut short, or has no such column.
    """
    try:
        # Opened here: `np.load` leaves a file that it cannot read open.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            if missing := set(columns) - set(archive.files):
                raise ResultsError(f"{path} has no column {sorted(missing)[0]!r}; it has {', '.join(archive.files)}")
            trials = len(np.unique(archive["trial"]))
            return {name: archive[name].reshape(trials, -1) for name in columns}
    except DAMAGE as error:
        raise ResultsError(f"{path} is no whole table of episodes: {error}. Run the same command again.") from error
