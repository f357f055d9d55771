"""The per-episode table: one row per trial and episode, taken from the log's rows.

Where a trial has several loops, there is one row per trial, loop and episode, and what is said of trials below holds
for the loops of all trials, one after the other.

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
loop         uint32    number of the loop within the trial, from 0; only where a trial has several
============ ========= =======================================================================
"""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from adapters.results.files import DAMAGE, hold, made_again, whole
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
        ("loop", "<u4"),
    ]
)
COLUMNS: tuple[str, ...] = tuple(name for name in DTYPE.names or () if name != "loop")
"""Columns of every table."""

NOISE = ("td_error", "q_change")
"""Columns that are stored as they are: they would take most of the time of packing, and become hardly smaller."""

BLOCK = 8_192
"""Rows that are held in memory at a time."""


def from_rows(trial: int, loop: int, rows: npt.NDArray[np.void]) -> npt.NDArray[np.void]:
    """Take the table's columns from a segment of the log's rows."""
    table = np.empty(len(rows), DTYPE)
    table["trial"] = trial
    table["loop"] = loop
    table["episode"] = rows["pass"]
    table["steps"] = rows["steps"]
    table["epsilon"] = rows["epsilon"]
    for i, name in ((0, "return"), (2, "td_error"), (3, "q_change")):
        table[name] = rows["signals"][:, i]
    table["alarm"] = rows["alarm"].any(axis=1)
    table["actions"] = np.bitwise_count(rows["available"]).sum(axis=1)
    return table


def write_npz(path: Path, chunks: Iterable[Path], rows: int, skip: int = 0, *, loops: int = 1) -> None:
    """Write `rows` rows of chunk files as one ``.npz`` with an array per column, with a block of them in memory.

    The first `skip` rows of each file are left out. Where a trial has several `loops` there is a column of their
    numbers.
    """
    files = list(chunks)
    with whole(path) as file, zipfile.ZipFile(file, "w", compresslevel=1) as archive:
        for column in (*COLUMNS, "loop") if loops > 1 else COLUMNS:
            archive.compression = zipfile.ZIP_STORED if column in NOISE else zipfile.ZIP_DEFLATED
            with archive.open(f"{column}.npy", "w", force_zip64=True) as member:
                _write_column(member, column, files, rows, skip)


def _write_column(member: IO[bytes], column: str, files: list[Path], rows: int, skip: int) -> None:
    header: dict[str, Any] = {"descr": DTYPE[column].str, "fortran_order": False, "shape": (rows,)}
    np.lib.format.write_array_header_1_0(member, header)
    buffer = bytearray(BLOCK * DTYPE.itemsize)
    block = np.frombuffer(buffer, DTYPE)[column]
    for chunk in files:
        with open(chunk, "rb") as file:
            file.seek(skip * DTYPE.itemsize)
            while size := file.readinto(buffer):
                member.write(block[: size // DTYPE.itemsize].tobytes())


def read_episodes(path: str | Path, columns: Iterable[str] = COLUMNS) -> dict[str, npt.NDArray[Any]]:
    """Read columns of a per-episode table, each of shape (trials, episodes).

    Raises
    ------
    ResultsError
        The file is missing, cut short, or not what its run wrote, or it has no such column.
    """
    with _opened(path, columns) as archive:
        trials, _ = _shape(archive)
        return {name: archive[name].reshape(trials, -1) for name in columns}


def read_last(path: str | Path, column: str, episodes: int) -> npt.NDArray[Any]:
    """Read a column's last episodes of each trial, shape (trials, episodes), with a block of the others in memory.

    Raises
    ------
    ResultsError
        The file is missing, cut short, or not what its run wrote, or it has no such column.
    """
    with _opened(path, (column,)) as archive:
        trials, length = _shape(archive)
        kept, at = [np.empty(0, DTYPE[column])], 0
        for block in _blocks(archive, column):
            episode = np.arange(at, at + len(block)) % length
            kept.append(block[episode >= length - episodes])
            at += len(block)
        return np.concatenate(kept).reshape(trials, -1)


@contextlib.contextmanager
def _opened(path: str | Path, columns: Iterable[str]) -> Iterator[Any]:
    hold(Path(path))
    try:
        # Opened here: `np.load` leaves a file that it cannot read open.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            if missing := set(columns) - set(archive.files):
                raise ResultsError(f"{path} has no column {sorted(missing)[0]!r}; it has {', '.join(archive.files)}")
            yield archive
    except DAMAGE as error:
        raise ResultsError(
            f"{path} is no whole table of episodes: {error}. {made_again(Path(path))}".rstrip()
        ) from error


def _shape(archive: Any) -> tuple[int, int]:
    """Return the number of trials, or of their loops, whose rows stand together, and of the episodes of each."""
    trials, rows = 0, 0
    for block in _blocks(archive, "episode"):
        trials += int(np.count_nonzero(block == 1))
        rows += len(block)
    if not trials or rows % trials:
        raise ValueError(f"{rows} rows are of no whole number of episodes for {trials} trials")
    return trials, rows // trials


def _blocks(archive: Any, column: str) -> Iterator[npt.NDArray[Any]]:
    with archive.zip.open(f"{column}.npy") as member:
        np.lib.format.read_magic(member)
        (rows,), _, dtype = np.lib.format.read_array_header_1_0(member)
        for first in range(0, rows, BLOCK):
            size = min(BLOCK, rows - first) * dtype.itemsize
            yield np.frombuffer(member.read(size), dtype, size // dtype.itemsize)
        member.read(1)  # the end, where the checksum is held against what was read
