"""Logs as Knowledge writes them, made within this process."""

import json
import sqlite3
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from adapters.results.files import file_sum, read_sealed, write_sealed
from adapters.stores import Store
from adapters.stores.ledger import Ledger
from adapters.stores.sqlite_store import COLUMNS, KEYS, Snapshot, Swap
from adapters.stores.sums import SIZE, record_sum, row_sum, seal_sum, toggled
from adapters.systems import make_system
from knowledge import STAGES, ChangePlan, Knowledge, Log, Record, to_json
from mape.config import Config, from_table
from mape.loop import Loop, build_analyze, build_execute, build_monitor, build_plan, layout_of

SMALL: dict[str, Any] = {
    "name": "small",
    "episodes": 12,
    "system": {
        "id": "mapek/Gridworld-v0",
        "options": {"size": [3, 3], "start": [0, 0], "goals": [[2, 2]], "max_steps": 10},
    },
    "monitor": {"detectors": [{"name": "page_hinkley", "threshold": 3.0}]},
    "execute": {"engine": "python"},
}


def small(**changes: Any) -> Config:
    return from_table({**SMALL, **changes})


def begin(store: Store, config: Config) -> Ledger:
    """Begin a log as Knowledge does once Execute has joined."""
    store.set_facts(config=json.loads(config.to_json()), versions={})
    ledger = Ledger(store, config.units, config.episodes, free=config.execute.mode == "free")
    system = make_system(config.system)
    layout = layout_of(config, system)
    system.close()
    facts = {"detectors": layout.detectors, "rates": layout.rates, "max_actions": layout.max_actions}
    ledger.begin({"signals": list(layout.signals), **facts})
    return ledger


def take(ledger: Ledger, record: Record) -> None:
    assert ledger.take(record.loop, STAGES.index(type(record)), to_json(record)).ack.value == "ok"


def write_log(path: Path, config: Config, live: Iterable[tuple[int, str, dict[str, Any]]] = ()) -> None:
    """Write what `mapek up` logs of a config in lockstep.

    Parameters
    ----------
    path
        The new file.
    config
        What runs.
    live
        Replacements that the config has not planned: pass, part, spec.
    """
    with Store(path) as store:
        ledger = begin(store, config)
        swaps = [{"pass": number, "part": part, "to": spec} for number, part, spec in live]
        swaps += [swap.model_dump(mode="json", by_alias=True) for swap in config.swap]
        driven = from_table({**json.loads(config.to_json()), "swap": swaps})
        for unit in range(config.units):
            loop = Loop(driven, make_system(config.system), *divmod(unit, config.loops))

            def swapped(swap: Any, handed_over: bool, unit: int = unit) -> None:
                to = swap.to.model_dump(mode="json")
                ledger.swapped(Swap(unit, swap.pass_no, swap.part, to, handed_over, swap in config.swap))

            loop.on_swap(swapped)
            taken = deque[Record]()
            for kind in STAGES:
                loop.bus.subscribe(kind, taken.append)
            for _ in range(config.episodes):
                loop.run(1)
                while taken:
                    take(ledger, taken.popleft())
                ledger.commit()
            state, table = loop.execute.state()
            ledger.keep("execute", Snapshot(unit, "execute", config.episodes, state, table, final=True), 0)
            loop.system.close()
        ledger.commit()


def write_free_log(path: Path, config: Config, lag: int, dropped: Iterable[int] = ()) -> None:
    """Write what a free-running loop logs whose plans arrive `lag` episodes late, without the episodes `dropped`."""
    gone = set(dropped)
    with Store(path) as store:
        ledger = begin(store, config)
        made: deque[Any] = deque()
        assert ledger.layout is not None
        knowledge = Knowledge(Log(ledger.layout))
        system = make_system(config.system)
        monitor, analyze = build_monitor(config, made.append), build_analyze(config, made.append)
        plan = build_plan(config, knowledge, made.append)
        execute = build_execute(config, system, knowledge, made.append)
        plan.start(0)
        take(ledger, made[0])
        execute.adopt(made.popleft())
        waiting: deque[ChangePlan] = deque()
        for number in range(1, config.episodes + 1):
            while len(waiting) > lag:
                execute.adopt(waiting.popleft())
            execute.drive()
            seen = made.popleft()
            if number in gone:
                assert ledger.drop(0, number, number).ack.value == "ok"
                continue
            monitor.on_observation(seen)
            analyze.on_symptom(made[-1])
            plan.on_request(made[-1])
            waiting.append(made[-1])
            for record in (seen, *made):
                take(ledger, record)
            made.clear()
        while waiting:
            execute.adopt(waiting.popleft())
        state, table = execute.state()
        ledger.keep("execute", Snapshot(0, "execute", config.episodes, state, table, final=True), 0)
        ledger.commit()
        system.close()


@contextmanager
def edited(path: Path) -> Iterator[dict[str, Any]]:
    """Change a JSON file of a run's folder as if it had been written so."""
    found = read_sealed(path)
    yield found
    write_sealed(path, found)


def reseal_files(folder: Path) -> None:
    """Make the checksums of a finished run's tables fit what stands in them."""
    with edited(folder / "result.json") as result:
        result["files"] = {name: file_sum(folder / name) for name in result["files"]}


def damage(path: Path, statement: str, *values: Any) -> None:
    """Change a log behind Knowledge's back."""
    db = sqlite3.connect(path)
    with db:
        assert db.execute(statement, values).rowcount == 1
    db.close()


def change(path: Path, statement: str, *values: Any) -> None:
    """Change a log as if it had been written so: its checksums fit."""
    damage(path, statement, *values)
    reseal(path)


def reseal(path: Path) -> None:
    """Make a log's checksums fit what stands in it."""
    db = sqlite3.connect(path)
    total, heads = 0, dict[tuple[int, int], bytes]()
    with db:
        for table, columns in COLUMNS.items():
            key = columns[: KEYS[table]]
            for row in db.execute(f"SELECT {', '.join(columns)} FROM {table} ORDER BY {', '.join(key)}").fetchall():
                found = row_sum(table, row)
                if table == "records":
                    place = (row[0], row[2])
                    found = heads[place] = record_sum(heads.get(place, b""), *row)
                where = " AND ".join(f"{name} = ?" for name in key)
                db.execute(f"UPDATE {table} SET sum = ? WHERE {where}", (found, *row[: len(key)]))
                total = toggled(total, found)
        run, commits = db.execute("SELECT run, commits FROM seal").fetchone()
        sealed = total.to_bytes(SIZE, "big")
        db.execute("UPDATE seal SET total = ?, sum = ?", (sealed, seal_sum(run, commits, sealed)))
    db.close()


def places(config: Config) -> list[tuple[int, int]]:
    """Pass and stage of every record of a loop, in order."""
    return [(0, 3), *((number, stage) for number in range(1, config.episodes + 1) for stage in range(4))]
