"""What a run's folder holds, each file beside its checksums; nothing is run again."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from adapters import private
from adapters.replay.records import LogReplay
from adapters.results.chunk import read_arrays, read_chunk
from adapters.results.files import changed, file_sum, read_json, read_sealed
from adapters.results.folder import LOGS_OF_AGENTS, is_summed, read_manifest
from adapters.stores import LOG_NAME, Store
from adapters.stores.mark import mark_path
from mape.config import from_foreign_table
from mape.errors import ResultsError

ROWS = {
    "records": "records",
    "dropped": "gaps",
    "snapshots": "states",
    "q_tables": "Q-tables",
    "versions": "Q-tables that were asked for",
    "swaps": "swaps",
    "run": "facts of the run",
    "roles": "roles",
    "events": "events",
}
"""What the rows of a log's tables are called."""

NEVER = (".lock", "manifest.json", "result.json")
"""Files that hold nothing, or their own checksum."""


def verified(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield a file of a run's folder and what of it was found to be as it was written, one after the other.

    What has no checksum comes last.

    Raises
    ------
    ResultsError
        Names the first file that is not as it was written, and what of it is not.
    """
    private.refuse_links(folder)
    manifest = read_manifest(folder)
    yield "manifest.json", "as it was written"
    yield from _configs(folder, manifest)
    result = folder / "result.json"
    stored = read_sealed(result) if result.is_file() else None
    held = {*NEVER}
    for agent, config in manifest["agents"].items():
        log = folder / (LOG_NAME if len(manifest["agents"]) == 1 else f"{LOGS_OF_AGENTS}{agent}.sqlite")
        if log.exists() or mark_path(log).exists() or (manifest["kind"] == "up" and stored is not None):
            yield log.name, _log(log, config, stored)
            held |= {log.name, f"{log.name}-wal", f"{log.name}-shm", mark_path(log).name}
    if stored is None:
        yield from _chunks(folder, manifest, held)
    else:
        yield from _files(folder, stored, held)
        yield "result.json", "as it was written"
    yield from _without(folder, manifest, stored, held)


def verified_log(log: Path) -> Iterator[tuple[str, str]]:
    """Yield a log that stands by itself, as `verified` does."""
    yield log.name, _log(log, None, None)


def _configs(folder: Path, manifest: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for agent, config in manifest["agents"].items():
        path = folder / f"config-{agent}.json"
        if path.exists():  # else the run was killed before it was written again
            if read_json(path) != config:
                raise ResultsError(f"{path} was changed after it was written: it is not the config in manifest.json")
            yield path.name, "the config in manifest.json"


def _log(path: Path, config: Mapping[str, Any] | None, stored: Mapping[str, Any] | None) -> str:
    with Store(path, readonly=True) as store:  # which holds all of it against its sums
        facts = store.facts()
        if config is not None and facts.get("config", config) != config:
            raise ResultsError(f"{path} is the log of a run with another config than manifest.json has")
        if stored is not None:
            _hashes(LogReplay(store), stored)
        return ", ".join(f"{store.held[table]:,} {named}" for table, named in ROWS.items() if store.held[table])


def _hashes(log: LogReplay, stored: Mapping[str, Any]) -> None:
    """Hold what the run said that it came to against what stands in its log."""
    for unit, said in enumerate(stored.get("trials", ())):  # a comparison names only the hash of all
        last = log.store.snapshot(unit, "execute")
        table = None if last is None or last.table is None else last.table.sha256()
        digest = hashlib.sha256(log.layout.schema)
        if not log.free:
            for row in log.store.rows(unit):
                digest.update(row or b"")
        found = {"log_sha256": None if log.free else digest.hexdigest(), "q_table_sha256": table}
        for name, here in found.items():
            if said[name] != here:
                raise ResultsError(
                    f"result.json is of another run than {log.store.path}: {name} of loop {unit} is {said[name]} "
                    f"there, and {here} in the log"
                )


def _chunks(folder: Path, manifest: Mapping[str, Any], held: set[str]) -> Iterator[tuple[str, str]]:
    for agent, table in manifest["agents"].items():
        config = from_foreign_table(table, f"{folder / 'manifest.json'}, {agent}")
        for path in sorted((folder / "chunks" / agent).glob("*.json")):
            stem = path.with_suffix("")
            trials = read_chunk(stem, config) or ()
            read_arrays(stem)
            named = {str(stem.relative_to(folder)) + ending for ending in (".json", ".rows", ".npz")}
            held |= named
            yield f"{stem.relative_to(folder)}.*", f"{len(trials)} finished trials"


def _files(folder: Path, stored: Mapping[str, Any], held: set[str]) -> Iterator[tuple[str, str]]:
    for name, wanted in stored["files"].items():
        path = folder / name
        if not path.resolve().is_relative_to(folder.resolve()):
            raise ResultsError(f"{folder / 'result.json'} names {name!r}, which is no file of its folder")
        if file_sum(path) != wanted:
            raise changed(path)
        held.add(name)
        yield name, "its SHA-256 is that in result.json"


def _without(
    folder: Path, manifest: Mapping[str, Any], stored: Mapping[str, Any] | None, held: set[str]
) -> Iterator[tuple[str, str]]:
    if not any(name.endswith(".sqlite") for name in held):
        none = "nothing has been logged yet" if manifest["kind"] == "up" else f"`mapek {manifest['kind']}` keeps none"
        yield "no records", f"{none}, so there is no chain to hold"
    if stored is None:
        yield "no result", "the run is unfinished"
    names = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    for name in names:
        if name in held or name.startswith("config-"):
            continue
        why = (
            "made anew when the run is finished"
            if is_summed(Path(name)) and stored is None
            else "no result rests on it"
        )
        yield name, f"has no checksum; {why}"
