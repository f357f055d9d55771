"""A log, record by record, beside what the same config makes again."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from adapters import private
from adapters.replay.derivations import Derivation, FedByLog, WholeLoop, with_swaps
from adapters.results.folder import LOGS_OF_AGENTS
from adapters.stores import LOG_NAME, Store
from adapters.stores.ledger import differences, layout_from
from adapters.stores.mark import mark_path
from adapters.systems import make_system
from adapters.systems.declared import is_plant
from knowledge import STAGES, Ack, ChangePlan, FreeLog, Observation, Record, RowLayout, from_json, to_json
from mape.config import Config, from_foreign_table
from mape.errors import ConfigError, PartError, ResultsError
from mape.near import did_you_mean, nearest_path
from mape.parts import config_at

ENDINGS = (".sqlite", ".mark")
"""Of a log, and of its mark: with a mark, and no log, there was one."""

BATCH = 512
"""Records that are held in memory at a time."""


def log_of(path: Path) -> Path | None:
    """Return the log in a run's folder, or `path` itself where that is a file; None where the folder has none.

    Raises
    ------
    ResultsError
        There is no such folder or file, or a link is in the folder.
    """
    if path.is_dir():
        private.refuse_links(path)
        several = sorted(
            {one.with_suffix(".sqlite") for one in path.glob(f"{LOGS_OF_AGENTS}*") if one.suffix in ENDINGS}
        )
        if several:
            names = ", ".join(str(log) for log in several)
            raise ConfigError(f"{path} holds a log for each agent; name one of them: {names}")
        log = path / LOG_NAME
        return log if log.is_file() or mark_path(log).is_file() else None
    if not path.exists():
        near = nearest_path(path, os.path.exists)
        raise ResultsError(
            f"there is no folder or file {path}{did_you_mean(near)} Name the folder of a run, or its {LOG_NAME}"
        )
    return path


class Difference(NamedTuple):
    """Where the log and what is derived again part; `stage` is None where it is not about a record."""

    loop: int
    pass_no: int
    stage: str | None
    text: str


class Moment(NamedTuple):
    """What Knowledge held after a pass, and the states of the parts; one that gives no state has None."""

    seen: Observation
    plan: ChangePlan
    known: tuple[int, ...]
    detectors: tuple[dict[str, Any], ...]
    analyzer: dict[str, Any]
    planner: dict[str, Any]
    q_table: dict[str, Any] | None


class Replayed(NamedTuple):
    """What one loop came to.

    Attributes
    ----------
    records : those that are equal.
    passes : finished passes among them.
    ended : whether the log holds all passes of the loop.
    fed : whether the Observations were taken from the log as they are.
    log_sha256, q_table_sha256 : of what was derived; None where it has none, or not all of it was derived.
    """

    loop: int
    records: int
    passes: int
    ended: bool
    fed: bool
    log_sha256: str | None
    q_table_sha256: str | None
    difference: Difference | None
    moment: Moment | None


class LogReplay:
    """Derives the loops of a log again.

    Parameters
    ----------
    store
        The log, opened for reading.

    Attributes
    ----------
    config : what ran, without what was replaced live.
    versions : of the packages that wrote the log.

    Raises
    ------
    ResultsError
        Nothing has been logged yet.
    """

    def __init__(self, store: Store) -> None:
        self.store = store
        facts = store.facts()
        if "config" not in facts or "layout" not in facts:
            raise ResultsError(f"{store.path} holds no record yet")
        self.config: Config = from_foreign_table(facts["config"], f"the config in {store.path}")
        self.versions: dict[str, str] = facts.get("versions", {})
        self.layout: RowLayout = layout_from(facts["layout"])
        self.free = self.config.execute.mode == "free"

    def loops(self, chosen: int | None) -> list[int]:
        """Return the numbers of the loops, or only the one that was chosen.

        Raises
        ------
        ConfigError
            There is no such loop.
        """
        if chosen is None:
            return list(range(self.config.units))
        if chosen >= self.config.units:
            raise ConfigError(f"--loop {chosen}: the run has loops 0 to {self.config.units - 1}")
        return [chosen]

    def replay(self, loop: int, *, to: int | None = None, on_pass: Callable[[], object] = lambda: None) -> Replayed:
        """Derive a loop again, up to the first difference, the end of the log, or the end of pass `to`.

        Parameters
        ----------
        loop
            Number of the loop in the records.
        to
            Last pass; what Knowledge held after it is then in the answer.
        on_pass
            Called after each pass.

        Raises
        ------
        ConfigError
            A part or the system cannot be made, or the log does not reach to pass `to`.
        """
        if to is not None and (last := self.store.last(loop)[3]) < to:
            raise ConfigError(f"--to {to}: the log of loop {loop} ends with pass {max(0, last)}")
        config = with_swaps(self.config, self.store.swaps(), loop)
        system = self._system(loop)
        try:
            if system is not None and not self.free:
                derivation: Derivation = WholeLoop(config, system, loop)
            else:
                derivation = FedByLog(config, self.store, self.layout, loop, system)
            return self._compare(config, derivation, loop, to, on_pass)
        finally:
            if system is not None:
                system.close()

    def _system(self, loop: int) -> Any:
        """Make the managed system, if the episodes of a loop can be driven again."""
        if is_plant(self.config.system) or (self.free and self.store.dropped(loop)):
            return None
        system = make_system(self.config.system)
        if system.redrivable:
            return system
        system.close()
        return None

    def _compare(
        self, config: Config, derivation: Derivation, loop: int, to: int | None, on_pass: Callable[[], object]
    ) -> Replayed:
        order = _Order(loop, self.free, self.store.dropped(loop))
        records, passes = 0, 0
        seen: Observation | None = None
        difference: Difference | None = None
        for number, stage, body in logged(self.store, loop):
            kind = STAGES[stage]
            try:
                there = from_json(body)
                order.next(there, number, kind)
            except ValueError as error:
                difference = Difference(loop, number, kind.__name__, f": {error}")
                break
            here = derivation.make(there)
            said = _differs(body, here, derivation)
            if said is not None:
                difference = Difference(loop, number, kind.__name__, said)
                break
            records += 1
            if isinstance(here, Observation):
                seen = here
            elif isinstance(here, ChangePlan):
                passes = number
                on_pass()
                if number == to:
                    break
        ended = passes >= config.episodes
        moment, log_sha256, q_sha256 = None, None, None
        if difference is None:
            # Past the last record nothing is made: what is compared is what both have.
            if ended or (to is not None and not self.free):
                derivation.settle()
            log_sha256 = derivation.log_sha256()
            table = derivation.q_table()
            if table is not None and ended:
                q_sha256 = table.sha256()
            if to is None:
                difference = self._ends(loop, passes, ended, log_sha256, q_sha256)
            elif seen is not None:
                moment = self._moment(config, derivation, seen)
        return Replayed(
            loop, records, passes, ended, derivation.from_observations, log_sha256, q_sha256, difference, moment
        )

    def _ends(
        self, loop: int, passes: int, ended: bool, log_sha256: str | None, q_sha256: str | None
    ) -> Difference | None:
        """Compare what stands in the store beside the records: the packed rows, and the Q-table of the end."""
        if log_sha256 is not None:
            digest = hashlib.sha256(self.layout.schema)
            for row in islice(self.store.rows(loop), passes + 1):
                digest.update(row or b"")
            if digest.hexdigest() != log_sha256:
                text = f"the packed rows hash to {digest.hexdigest()} there, and to {log_sha256} here"
                return Difference(loop, passes, None, text)
        final = self.store.snapshot(loop, "execute") if ended and q_sha256 is not None else None
        if final is not None and final.final and final.table is not None and final.table.sha256() != q_sha256:
            text = f"the Q-table of the end hashes to {final.table.sha256()} there, and to {q_sha256} here"
            return Difference(loop, passes, None, text)
        return None

    def _moment(self, config: Config, derivation: Derivation, seen: Observation) -> Moment:
        serving = config_at(config, seen.pass_no)
        try:
            states = derivation.monitor.state()
        except PartError:
            states = [None] * len(serving.monitor.detectors)
        plan = derivation.knowledge.plan
        assert plan is not None
        table = derivation.q_table()
        return Moment(
            seen,
            plan,
            derivation.knowledge.actions,
            tuple(
                {"name": spec.name, "signal": signal, "state": state}
                for spec, (signal, _), state in zip(
                    serving.monitor.detectors, derivation.monitor.detectors, states, strict=True
                )
            ),
            {"name": serving.analyze.name, "state": _state(derivation.analyze)},
            {"name": serving.plan.name, "state": _state(derivation.plan)},
            None
            if table is None
            else {
                "shape": list(table.values.shape),
                "actions": list(table.actions),
                "sha256": table.sha256(),
                "max": float(table.values.max()),
                "row_max": table.values.max(axis=1).tolist(),
                "values": table.values.tolist(),
            },
        )


def logged(store: Store, loop: int) -> Iterator[tuple[int, int, str]]:
    """Yield (pass, stage, body) of a loop's log, in order, up to what is its end when this is called."""
    last = store.last(loop)
    stages = dict.fromkeys(range(4), 0)
    while found := store.since(loop, stages, BATCH):
        # What comes meanwhile is another process's; of a free-running loop it may stand before what is read by then.
        yield from (record for record in found if record[0] <= last[record[1]])
        number, stage, _ = found[-1]
        if number > max(last):
            return
        stages = {s: number + (s <= stage) for s in range(4)}


class _Order:
    # Whether each record is the next one: of the log in lockstep; of its stage where the loop ran freely, and then past
    # what was dropped.
    def __init__(self, loop: int, free: bool, dropped: list[tuple[int, int]]) -> None:
        self._free = free
        self._due = (0, STAGES.index(ChangePlan))
        self._log = FreeLog(loop)
        self._dropped = iter([*dropped, (2**63, 2**63)])
        self._next = next(self._dropped)

    def next(self, record: Record, number: int, kind: type[Record]) -> None:
        if type(record) is not kind or record.pass_no != number:
            raise ValueError(f"in its place stands {type(record).__name__} {record.pass_no}")
        while self._next[0] <= number:
            self._log.drop(*self._next)
            self._next = next(self._dropped)
        stage = STAGES.index(kind)
        if self._log.append(record) is not Ack.OK or not (self._free or (number, stage) == self._due):
            raise ValueError("does not come next in its log; records before it are missing")
        self._due = (number, stage + 1) if stage + 1 < len(STAGES) else (number + 1, 0)


def _differs(body: str, here: Record | None, derivation: Derivation) -> str | None:
    if here is None:
        return f": it is there, and here nothing could be made: {derivation.failure}"
    made = to_json(here).decode()
    return None if made == body else differences(body, made)


def _state(component: Any) -> Any:
    try:
        return component.state()
    except PartError:
        return None


def as_json(moment: Moment) -> dict[str, Any]:
    """Return a moment as plain JSON."""
    return {
        "pass": moment.seen.pass_no,
        "signals": moment.seen.signals,
        "available": list(moment.seen.available),
        "known": list(moment.known),
        "plan": json.loads(to_json(moment.plan)),
        "detectors": list(moment.detectors),
        "analyzer": moment.analyzer,
        "planner": moment.planner,
        "q_table": moment.q_table,
    }
