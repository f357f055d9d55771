"""The work of one worker: some trials of one agent, or loops of trials, with their results on disk."""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from adapters.results.files import file_sum, read_npz, read_sealed, whole, write_sealed
from adapters.results.table import DTYPE, from_rows, write_npz
from adapters.systems.lending import Lender
from mape.config import Config, from_table
from mape.errors import MapekError, ResultsError
from mape.execute.episode import TRACE_COLUMNS
from mape.loop import Loop
from mape.trials import TrialResult, run_trial

TRACE_DTYPE = np.dtype([("episode", "<u4"), *[(name, "<f8") for name in TRACE_COLUMNS]])
READINGS = ("pass", "statistic", "alarm")
"""What is kept of the log's rows of traced episodes: what each detector read."""


def run_chunk(
    config_json: str,
    first: int,
    count: int,
    stem: str,
    trace: tuple[int, int] | None = None,
    on_rows: Any = None,
    prepare: Any = None,
    lend: Lender | None = None,
) -> list[TrialResult]:
    """Run `count` units from number `first` and write ``STEM.rows``, ``STEM.npz`` and, last, ``STEM.json``.

    Parameters
    ----------
    config_json
        The config, as `Config.to_json` gives it.
    first, count
        Which units of work: the loops of trial 0, then those of trial 1, and so on; as a rule a trial has one.
    stem
        Path of the results without their endings.
    trace
        First and last episode whose steps are kept, of unit 0.
    on_rows, prepare
        Further listeners as `run_trial` takes them; only within one process.
    lend
        Makes the systems; only within one process.

    Raises
    ------
    MapekError
        The results could not be written: nothing of this chunk stays. Or a unit failed: those before it are stored as
        a chunk, and its own finished passes as ``broken-UNIT.npz`` beside it.
    """
    config = from_table(json.loads(config_json))
    results: list[TrialResult] = []
    arrays: dict[str, npt.NDArray[Any]] = {}
    readings: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in READINGS}
    digest = hashlib.sha256()
    whole_units = digest.copy()
    failure: MapekError | None = None
    path = Path(stem)
    with whole(path.with_suffix(".rows")) as file, ExitStack() as opened:
        lend = opened.enter_context(Lender()) if lend is None else lend
        for unit in range(first, first + count):
            trial, turn = divmod(unit, config.loops)

            def keep(rows: npt.NDArray[np.void], trial: int = trial, turn: int = turn) -> None:
                block = from_rows(trial, turn, rows).tobytes()
                digest.update(block)
                file.write(block)
                if trace is not None and trial == turn == 0:
                    inside = (rows["pass"] >= trace[0]) & (rows["pass"] <= trace[1])
                    for name in READINGS:
                        readings[name].append(rows[name][inside])
                if on_rows is not None:
                    on_rows(rows)

            steps: list[npt.NDArray[np.void]] = []
            kept: list[Loop] = []

            def ready(loop: Loop, unit: int = unit, steps: list[Any] = steps, kept: list[Loop] = kept) -> None:
                kept.append(loop)
                if trace is not None and unit == 0:
                    loop.execute.record_trace(*trace, lambda number, rows: steps.append(traced(number, rows)))
                if prepare is not None:
                    prepare(loop)

            try:
                results.append(run_trial(config, trial, lend, loop=turn, on_rows=keep, prepare=ready))
            except MapekError as error:
                target = path.parent / f"broken-{unit}.npz"
                _break_off(file, len(results) * config.episodes, target, config.loops)
                if not results:
                    raise
                failure = error
                break
            whole_units = digest.copy()
            table = kept[0].execute.q_table
            arrays[f"q_{unit}"] = table.values
            arrays[f"actions_{unit}"] = np.array(table.actions, dtype=np.int64)
            if unit == 0 and trace is not None:
                arrays["trace"] = np.concatenate(steps) if steps else np.empty(0, TRACE_DTYPE)
                arrays |= {f"readings_{name}": np.concatenate(parts) for name, parts in readings.items()}
    write_heads(path, config, results, arrays, len(results) * config.episodes, whole_units.hexdigest())
    if failure is not None:
        raise failure
    return results


def write_heads(
    stem: Path,
    config: Config,
    results: list[TrialResult],
    arrays: dict[str, npt.NDArray[Any]],
    rows: int,
    rows_sha256: str,
) -> None:
    """Write what stands beside a chunk's rows: its arrays and, last, its results, which say that it is whole.

    They say which chunk of what it is, too: one that was put in the place of another is told.
    """
    with whole(stem.with_suffix(".npz")) as file:
        np.savez(file, allow_pickle=False, **_packed(arrays))
    write_sealed(
        stem.with_suffix(".json"),
        {
            "chunk": stem.name,
            "config_sha256": _config_sum(config),
            "rows": rows,
            "rows_sha256": rows_sha256,
            "arrays_sha256": file_sum(stem.with_suffix(".npz")),
            "trials": [r._asdict() for r in results],
        },
    )


_TRACED = ("trace", *(f"readings_{name}" for name in READINGS))


def _config_sum(config: Config) -> str:
    return hashlib.sha256(config.to_json().encode()).hexdigest()


def _packed(arrays: dict[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    """Put the Q-tables of all units one behind the other: an archive of a few entries is written and read at once."""
    units = [int(name.removeprefix("q_")) for name in arrays if name.startswith("q_")]
    tables = [arrays[f"q_{unit}"] for unit in units]
    packed = {
        "units": np.array(units, dtype=np.int64),
        "shapes": np.array([table.shape for table in tables], dtype=np.int64).reshape(-1, 2),
        "values": np.concatenate([np.empty(0), *[table.ravel() for table in tables]]),
        "actions": np.concatenate([np.empty(0, np.int64), *[arrays[f"actions_{unit}"] for unit in units]]),
    }
    return packed | {name: arrays[name] for name in _TRACED if name in arrays}


def _unpacked(packed: dict[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    arrays: dict[str, npt.NDArray[Any]] = {name: packed[name] for name in _TRACED if name in packed}
    value = row = 0
    for unit, (rows, states) in zip(packed["units"].tolist(), packed["shapes"].tolist(), strict=True):
        arrays[f"q_{unit}"] = packed["values"][value : value + rows * states].reshape(rows, states)
        arrays[f"actions_{unit}"] = packed["actions"][row : row + rows]
        value, row = value + rows * states, row + rows
    return arrays


def _break_off(file: IO[bytes], rows: int, target: Path, loops: int = 1) -> None:
    """Cut the rows of a broken unit off a chunk, and store them by themselves."""
    file.flush()
    broken = os.stat(file.name).st_size // DTYPE.itemsize - rows
    if broken:
        write_npz(target, [Path(file.name)], broken, skip=rows, loops=loops)
    file.truncate(rows * DTYPE.itemsize)
    file.seek(0, 2)


def read_chunk(stem: Path, config: Config) -> list[TrialResult] | None:
    """Return the results of a finished chunk of `config`, or None where it is not there as a whole.

    Raises
    ------
    ResultsError
        The chunk says that it is finished, but its rows are cut short, or it is that of other trials or another run.
    """
    if not stem.with_suffix(".json").exists():
        return None
    head = _head(stem)
    rows = stem.with_suffix(".rows")
    try:
        if head["chunk"] != stem.name or head["config_sha256"] != _config_sum(config):
            raise ResultsError(
                f"{stem}.json is of chunk {head['chunk']} of this or another run; it stands in the wrong place. "
                f"Delete {stem}.* to have these trials run again."
            )
        if rows.stat().st_size != head["rows"] * DTYPE.itemsize:
            raise ResultsError(
                f"{rows} is cut short: {rows.stat().st_size} bytes instead of {head['rows'] * DTYPE.itemsize}. "
                f"Delete {stem}.* to have these trials run again."
            )
        stem.with_suffix(".npz").stat()
        return [
            TrialResult(
                **{
                    **one,
                    "alarms": tuple(one["alarms"]),
                    "handed_over": tuple(one["handed_over"]),
                    "aborted": tuple((number, why) for number, why in one.get("aborted", ())),
                }
            )
            for one in head["trials"]
        ]
    except (OSError, KeyError, TypeError) as error:
        raise ResultsError(f"{stem}.* is damaged ({error}); delete it to have these trials run again") from error


def read_arrays(stem: Path) -> dict[str, npt.NDArray[Any]]:
    """Return a finished chunk's arrays, and hold its rows against their hash.

    Raises
    ------
    ResultsError
        The rows or the arrays are not those that were written.
    """
    again = f"Delete {stem}.* and give the same command to have these trials run again."
    head = _head(stem)
    for ending, entry in ((".rows", "rows_sha256"), (".npz", "arrays_sha256")):
        path = stem.with_suffix(ending)
        found = file_sum(path)
        if found != head[entry]:
            raise ResultsError(f"{path} was changed after it was written: its SHA-256 is {found}. {again}")
    return _unpacked(read_npz(stem.with_suffix(".npz"), again))


def _head(stem: Path) -> Any:
    try:
        return read_sealed(stem.with_suffix(".json"))
    except ResultsError as error:
        raise ResultsError(f"{error}. Delete {stem}.* to have these trials run again.") from error


def remove_parts(folder: Path) -> None:
    """Remove what an interrupted writer left."""
    for part in folder.rglob("*.part"):
        os.unlink(part)


def traced(number: int, steps: npt.NDArray[np.float64]) -> npt.NDArray[np.void]:
    """Return the traced steps of an episode as they are stored, shape (steps,)."""
    block = np.empty(len(steps), TRACE_DTYPE)
    block["episode"] = number
    for i, name in enumerate(TRACE_COLUMNS):
        block[name] = steps[:, i]
    return block
