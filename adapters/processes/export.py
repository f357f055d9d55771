"""From Knowledge's file to the tables of a run's folder: the same ones that a run in one process writes."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from adapters.results.chunk import READINGS, write_heads
from adapters.results.files import whole
from adapters.results.table import BLOCK, from_rows
from adapters.stores.ledger import Ledger
from knowledge import ChangePlan, ChangeRequest, Observation, RowLayout, Symptom, from_json
from mape.config import Config
from mape.errors import ResultsError
from mape.trials import TrialResult, steps_and_alarms


def export(config: Config, ledger: Ledger, stem: Path, trace: npt.NDArray[np.void] | None = None) -> list[TrialResult]:
    """Write a complete run as one chunk of results: ``STEM.rows``, ``STEM.npz`` and, last, ``STEM.json``.

    `trace` are the steps that were traced of unit 0.

    Raises
    ------
    ResultsError
        The run is not complete, or the results cannot be written.
    """
    if not ledger.complete:
        raise ResultsError(f"{ledger.store.path} holds an unfinished run; go on with `mapek resume`")
    results: list[TrialResult] = []
    arrays: dict[str, npt.NDArray[Any]] = {}
    digest = hashlib.sha256()
    readings: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in READINGS}
    aborted = [event for event in ledger.store.events() if event.kind == "aborted"]
    with whole(stem.with_suffix(".rows")) as file:
        for unit in range(ledger.units):
            trial, loop = divmod(unit, config.loops)
            steps, dropped, alarms = 0, 0, []
            for rows in rows_of(ledger, unit):
                block = from_rows(trial, loop, rows).tobytes()
                if trace is not None and unit == 0:
                    inside = np.isin(rows["pass"], trace["episode"])
                    for name, found_there in readings.items():
                        found_there.append(rows[name][inside])
                digest.update(block)
                file.write(block)
                more, alarmed = steps_and_alarms(rows)
                steps += more
                alarms += alarmed
                dropped += int(np.isnan(rows["epsilon"]).sum())
            found = ledger.store.snapshot(unit, "execute")
            if found is None or found.table is None:
                raise ResultsError(f"{ledger.store.path} has no Q-table of the end of loop {unit}")
            arrays[f"q_{unit}"] = found.table.values
            arrays[f"actions_{unit}"] = np.array(found.table.actions, dtype=np.int64)
            sha256 = ledger.sha256(unit) or ""
            swaps = {(swap.pass_no, swap.part): swap.handed_over for swap in ledger.store.swaps() if swap.loop == unit}
            handed_over = tuple(swaps.get((swap.pass_no, swap.part), False) for swap in config.swap)
            results.append(
                TrialResult(
                    trial,
                    config.episodes,
                    steps,
                    tuple(alarms),
                    sha256,
                    found.table.sha256(),
                    loop,
                    handed_over,
                    dropped,
                    tuple((event.pass_no or 0, event.text) for event in aborted if event.loop == unit),
                )
            )
    if trace is not None:
        arrays["trace"] = trace
        arrays |= {f"readings_{name}": np.concatenate(parts) for name, parts in readings.items()}
    write_heads(stem, config, results, arrays, len(results) * config.episodes, digest.hexdigest())
    return results


def rows_of(ledger: Ledger, unit: int) -> Iterator[npt.NDArray[np.void]]:
    """Yield the packed passes of one loop, in blocks; of a free-running one as far as they are whole.

    A free-running loop's pass that was dropped has no steps, and numbers that are none.
    """
    layout = ledger.layout
    assert layout is not None
    if not ledger.free:
        packed = ledger.store.rows(unit)
        next(packed)  # plan 0's
        while block := b"".join(islice(packed, BLOCK)):
            yield np.frombuffer(block, layout.dtype)
        return
    buffer = bytearray(layout.struct.size)
    for number in range(1, ledger.episodes + 1):
        bodies = [ledger.store.body(unit, number, stage) for stage in range(4)]
        if None in bodies:
            yield _dropped(layout, number)
            continue
        seen, symptom, request, plan = (from_json(str(body)) for body in bodies)
        assert isinstance(seen, Observation)
        assert isinstance(symptom, Symptom)
        assert isinstance(request, ChangeRequest)
        assert isinstance(plan, ChangePlan)
        layout.pack_into(buffer, 0, seen, symptom, request, plan)
        yield np.frombuffer(bytes(buffer), layout.dtype)


def _dropped(layout: RowLayout, number: int) -> npt.NDArray[np.void]:
    row = np.zeros(1, layout.dtype)
    row["pass"] = number
    row["epsilon"] = row["signals"] = np.nan
    return row
