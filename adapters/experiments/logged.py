"""A run over a plant in one process: each pass is on disk before the next episode is begun, as under `mapek up`.

So it is gone on with after the last whole episode, and replayed without the plant.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from adapters.processes.export import export
from adapters.processes.role import plain
from adapters.processes.serve import open_ledger
from adapters.results.chunk import traced
from adapters.results.files import whole
from adapters.stores.begun import begins, breaks_off, go_on
from adapters.stores.ledger import Ledger
from adapters.stores.sqlite_store import Snapshot, Swap
from adapters.systems.lending import Lender
from knowledge import STAGES, ChangePlan, Observation, QTable, Record, from_json, to_json
from mape.config import Config, SwapConfig
from mape.errors import MapekError, ResultsError
from mape.loop import Loop, layout_of
from mape.trials import TrialResult

PAST = 512
"""Passes that are read from the log at a time."""


def run_logged(
    config: Config,
    log: Path,
    stem: Path,
    *,
    lend: Lender,
    trace: tuple[int, int] | None = None,
    prepare: Callable[[Loop], object] | None = None,
    on_passes: Callable[[int], object] = lambda count: None,
) -> list[TrialResult]:
    """Run what is not in the log yet, one unit after the other, and make of it one chunk of results.

    Parameters
    ----------
    config
        What runs.
    log, stem
        The log, which is begun or gone on with; path of the results without their endings.
    lend
        Makes the systems.
    trace
        First and last episode whose steps are kept, of unit 0.
    prepare
        Called with each loop before its first pass here.
    on_passes
        Told of passes that are finished, those of an earlier run among them.

    Raises
    ------
    MapekError
        A unit failed; all its whole episodes are in the log.
    """
    ledger = open_ledger(config, log, "normal")
    with ledger.store:
        go_on(ledger)
        for unit in range(config.units):
            if ledger.ended(unit):
                on_passes(config.episodes)
            else:
                _Unit(config, ledger, unit, stem, trace, on_passes).run(lend, prepare)
        pieces = [np.load(path, allow_pickle=False) for path in _traces(stem)]
        return export(config, ledger, stem, np.concatenate(pieces) if pieces else None)


class _Unit:
    def __init__(
        self,
        config: Config,
        ledger: Ledger,
        unit: int,
        stem: Path,
        trace: tuple[int, int] | None,
        on_passes: Callable[[int], object],
    ) -> None:
        self._config = config
        self._ledger = ledger
        self._unit = unit
        self._stem = stem
        self._trace = trace if unit == 0 else None
        self._on_passes = on_passes
        self._loop: Loop | None = None

    def run(self, lend: Lender, prepare: Callable[[Loop], object] | None) -> None:
        trial, turn = divmod(self._unit, self._config.loops)
        system = lend(self._config.system)
        try:
            loop = self._go_on(system, trial, turn)
            if prepare is not None:
                prepare(loop)
            loop.run(self._config.episodes - loop.execute.passes)
            self._keep_state(final=True)
            self._ledger.commit()
            loop.close()
        except MapekError as error:
            if self._config.units > 1:
                error.args = (f"{self._config.unit_name(trial, turn)}: {error}",)
            raise
        finally:
            system.close()

    def _go_on(self, system: Any, trial: int, turn: int) -> Loop:
        config, ledger, store = self._config, self._ledger, self._ledger.store
        layout = layout_of(config, system)
        names = ("signals", "detectors", "rates", "max_actions")
        ledger.begin({name: plain(_listed(getattr(layout, name))) for name in names})
        found = store.snapshot(self._unit, "execute")
        checkpoint = None
        if found is not None:
            if found.table is None:
                raise ResultsError(f"{store.path}: the state of execute at pass {found.pass_no} has no Q-table")
            checkpoint = found.state, found.table
        self._loop = loop = Loop(config, system, trial, turn, checkpoint=checkpoint, keep=self._keep)
        loop.on_swap(self._keep_swap)
        if found is not None:
            loop.go_on(self._past(), self._read)
            ledger.commit()
        loop.knowledge.serve_q_table(self._read_now)
        loop.execute.attempts.on_begin = self._begins
        loop.execute.attempts.on_abort = self._breaks_off
        if self._trace is not None:
            loop.execute.record_trace(*self._trace, self._keep_trace)
        return loop

    def _past(self) -> Iterator[Observation]:
        number = 1
        while found := self._ledger.store.since(self._unit, {0: number}, PAST):
            for _, _, body in found:
                seen = from_json(body)
                assert isinstance(seen, Observation)
                yield seen
            number += len(found)

    # What is written, in the order in which it happens.

    def _begins(self, number: int) -> None:
        begins(self._ledger.store, self._unit, number)
        self._ledger.commit()

    def _breaks_off(self, number: int, why: str) -> None:
        breaks_off(self._ledger, why, self._unit, number)
        self._ledger.commit()

    def _keep(self, record: Record) -> None:
        """Write a record, before any component hears of it; with an Observation the state behind it."""
        data = to_json(record)
        taken = self._ledger.take(self._unit, STAGES.index(type(record)), data)
        if isinstance(record, Observation) and taken.ack.value == "ok":
            self._keep_state()
            self._ledger.commit()
        elif isinstance(record, ChangePlan):
            self._ledger.commit()
            self._on_passes(min(1, record.pass_no))

    def _keep_state(self, *, final: bool = False) -> None:
        assert self._loop is not None
        state, table = self._loop.execute.state()
        passes = self._loop.execute.passes
        self._ledger.keep("execute", Snapshot(self._unit, "execute", passes, plain(state), table, final), 0)

    def _keep_swap(self, swap: SwapConfig, handed_over: bool) -> None:
        spec = swap.to.model_dump(mode="json")
        self._ledger.swapped(Swap(self._unit, swap.pass_no, swap.part, spec, handed_over, planned=True))

    def _keep_trace(self, number: int, steps: npt.NDArray[np.float64]) -> None:
        with whole(self._stem.parent / f"traced-{number:010d}.npy") as file:
            np.save(file, traced(number, steps), allow_pickle=False)

    # What a planner reads.

    def _read_now(self) -> QTable:
        assert self._loop is not None
        table = self._loop.execute.q_table.copy()
        self._ledger.store.keep_version(self._unit, self._loop.execute.passes, table)
        return table

    def _read(self, number: int) -> QTable:
        table = self._ledger.store.version(self._unit, number)
        if table is None:
            raise LookupError(f"the log holds no Q-table of the end of episode {number}")
        return table


def _listed(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _traces(stem: Path) -> list[Path]:
    return sorted(stem.parent.glob("traced-*.npy"))
