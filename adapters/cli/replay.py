"""`mapek replay`: what is on disk, derived again and compared."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from adapters.cli.common import prepare
from adapters.cli.sentences import ids, sentence
from adapters.cli.trust import check_trust
from adapters.replay.records import Difference, LogReplay, Moment, Replayed, as_json, log_of
from adapters.replay.tables import replay_tables
from adapters.results.files import read_sealed
from adapters.results.folder import LOGS_OF_AGENTS, MENDED, MODULES, read_manifest
from adapters.results.own_code import other_versions
from adapters.scratch import scratch
from adapters.stores import LOG_NAME, Store
from adapters.versions import versions
from mape.errors import ConfigError
from mape.trials import combined_hash


def execute(chosen: argparse.Namespace) -> int:
    """Run the command; 1 where there is a difference."""
    prepare()
    folder = Path(chosen.folder)
    path = log_of(folder)
    check_trust(chosen, folder)
    if path is None:
        return _tables(chosen, folder)
    with Store(path, readonly=True) as store:
        return _log(chosen, path, LogReplay(store))


# A log.


def _log(chosen: argparse.Namespace, path: Path, log: LogReplay) -> int:
    loops = log.loops(chosen.loop)
    found: list[Replayed] = []
    total = sum(min(chosen.to or log.config.episodes, max(0, log.store.last(loop)[3])) for loop in loops)
    with tqdm(
        total=total, unit=" passes", unit_scale=True, disable=True if chosen.quiet else None, leave=False,
        dynamic_ncols=True,
    ) as bar:  # fmt: skip
        for loop in loops:
            found.append(log.replay(loop, to=chosen.to, on_pass=bar.update))
            if found[-1].difference is not None:
                break
    difference = found[-1].difference
    result = path.parent / "result.json"
    compared = difference is None and chosen.to is None and result.exists()
    if compared:
        stored = read_sealed(result)
        if path.name != LOG_NAME:  # that of one of several agents, of which less is said
            agent = path.stem.removeprefix(LOGS_OF_AGENTS)
            stored = {"log_sha256": _combined(found, "log_sha256"), **stored.get("agents", {}).get(agent, {})}
        difference = _against_result(result, stored, found, chosen.loop is None)
    if chosen.json:
        _print_json(path, log, found, difference, compared)
    else:
        _print(chosen, path, log, found, difference, compared)
    return 0 if difference is None else 1


def _against_result(path: Path, stored: Mapping[str, Any], found: list[Replayed], whole: bool) -> Difference | None:
    """Compare with what the run itself said that it came to."""
    trials = stored.get("trials", [])
    for one in found if "trials" in stored else ():
        said = trials[one.loop] if one.loop < len(trials) else {}
        for name in ("log_sha256", "q_table_sha256"):
            here = getattr(one, name)
            if here is not None and said.get(name) != here:
                return Difference(one.loop, one.passes, None, f"{name} is {said.get(name)} in {path}, and {here} here")
    for name in ("log_sha256", "q_table_sha256"):
        hashes = _combined(found, name)
        if whole and hashes is not None and stored.get(name) != hashes:
            return Difference(0, found[0].passes, None, f"{name} is {stored.get(name)} in {path}, and {hashes} here")
    return None


def _combined(found: list[Replayed], name: str) -> str | None:
    hashes = [getattr(one, name) for one in found]
    return None if None in hashes else combined_hash(hashes)


def _print_json(
    path: Path, log: LogReplay, found: list[Replayed], difference: Difference | None, compared: bool
) -> None:
    _dump(
        {
            "log": str(path),
            "name": log.config.name,
            "mode": log.config.execute.mode,
            "equal": difference is None,
            "difference": None if difference is None else {**difference._asdict(), "text": _told(difference)},
            "records": sum(one.records for one in found),
            "loops": [
                {
                    "loop": one.loop,
                    "records": one.records,
                    "passes": one.passes,
                    "complete": one.ended,
                    "observations": "taken from the log" if one.fed else "derived",
                    "log_sha256": one.log_sha256,
                    "q_table_sha256": one.q_table_sha256,
                    **({} if one.moment is None else {"knowledge": as_json(one.moment)}),
                }
                for one in found
            ],
            "log_sha256": _combined(found, "log_sha256"),
            "q_table_sha256": _combined(found, "q_table_sha256"),
            "result": "equal" if compared and difference is None else "different" if compared else "not compared",
            **_other_code(log.versions, _manifest(path.parent)),
        }
    )


def _print(
    chosen: argparse.Namespace,
    path: Path,
    log: LogReplay,
    found: list[Replayed],
    difference: Difference | None,
    compared: bool,
) -> None:
    records = sum(one.records for one in found)
    units = log.config.units
    loops = "" if units == 1 else f", {units} loops" if chosen.loop is None else f", loop {chosen.loop} of {units}"
    print(f"{path}: {log.config.name}, {log.config.execute.mode}{loops}")
    if found[-1].fed:
        why = "episodes were dropped" if log.store.dropped(found[-1].loop) else "its system cannot be driven again"
        print(f"Observations cannot be derived again ({why}); the other records are derived from those in the log")
    if difference is not None:
        print(f"{records:,} records are equal; the first difference: {_told(difference)}")
        _print_other_code(log.versions, _manifest(path.parent))
        return
    print(f"{records:,} records derived again: no difference")
    if chosen.to is not None:
        for one in found:
            assert one.moment is not None
            _print_moment(one.moment, log.config.units > 1)
        return
    short = [one for one in found if not one.ended]
    if short:
        first = short[0]
        print(
            f"the log ends early: {len(short)} of {len(found)} loops are unfinished, loop {first.loop} after pass "
            f"{first.passes:,} of {log.config.episodes:,}"
        )
    _print_hashes(found)
    if compared:
        print("result.json says the same")


def _print_hashes(found: list[Replayed]) -> None:
    for name, title in (("log_sha256", "log:"), ("q_table_sha256", "Q-table:")):
        hashes = _combined(found, name)
        if len(found) == 1:
            print(f"{title:<9} {getattr(found[0], name) or _NONE[name]}")
            continue
        for one in found:
            print(f"{title:<9} {getattr(one, name) or _NONE[name]} (loop {one.loop})")
        if hashes is not None:
            print(f"{title:<9} {hashes} (of all loops)")


_NONE = {
    "log_sha256": "no hash: a free-running loop depends on when its plans came",
    "q_table_sha256": "not derived: that takes all episodes, driven again",
}


def _print_moment(moment: Moment, named: bool) -> None:
    seen = moment.seen
    of = f"loop {seen.loop}, " if named else ""
    print(f"--- {of}after pass {seen.pass_no}")
    print(f"signals:     {', '.join(f'{name} {value:.6g}' for name, value in seen.signals.items())}")
    print(f"plan:        {sentence(moment.plan).split(maxsplit=1)[1]}")
    print(f"actions:     available {ids(seen.available)}, in the Q-table {ids(moment.known)}")
    for place, detector in enumerate(moment.detectors):
        print(f"detector {place}:  {detector['name']} on {detector['signal']}, {_state(detector['state'])}")
    print(f"analyzer:    {moment.analyzer['name']}, {_state(moment.analyzer['state'])}")
    print(f"planner:     {moment.planner['name']}, {_state(moment.planner['state'])}")
    table = moment.q_table
    if table is None:
        print("Q-table:     not derived, as the Observations are not")
        return
    rows, states = table["shape"]
    print(f"Q-table:     {rows} actions x {states} states, largest value {table['max']:.6g}, {table['sha256']}")
    for action, most in zip(table["actions"], table["row_max"], strict=True):
        print(f"  action {action:<3} largest value {most:.6g}")


def _state(state: Any) -> str:
    return "no state" if state is None else f"state {json.dumps(state)}"


def _told(difference: Difference) -> str:
    if difference.stage is None:
        return f"loop {difference.loop}, after pass {difference.pass_no}: {difference.text}"
    return f"{difference.stage} {difference.pass_no} of loop {difference.loop}{difference.text}"


# Tables.


def _tables(chosen: argparse.Namespace, folder: Path) -> int:
    manifest = read_manifest(folder)
    if chosen.to is not None or chosen.loop is not None:
        option = "--to" if chosen.to is not None else "--loop"
        raise ConfigError(
            f"{option} needs a log, and {folder} has only tables; `mapek up` writes a log, and `mapek step CONFIG "
            "--from PASS` shows a pass of any config"
        )
    with scratch() as apart:
        found = replay_tables(folder, manifest, apart / "run", workers=chosen.workers, quiet=chosen.quiet)
    if chosen.json:
        fields = found._asdict()
        _dump({"folder": str(folder), "equal": found.difference is None, **fields,
               **_other_code(manifest.get("versions", {}), manifest)})  # fmt: skip
    else:
        print(f"{folder}: {manifest['kind']}, tables without records")
        trials = f"{found.trials:,} trial{'s' * (found.trials > 1)}"
        print(f"{trials}, {found.episodes:,} episodes in all, run again: ", end="")
        if found.difference is None:
            print("no difference")
            print(f"log:      {found.log_sha256} (hash of the trials' hashes)")
            print(f"Q-tables: {found.q_table_sha256} (hash of the trials' hashes)")
            print("result.json says the same")
        else:
            print(f"the first difference: {found.difference}")
            _print_other_code(manifest.get("versions", {}), manifest)
    return 0 if found.difference is None else 1


# What made it, and what derives it again.


def _manifest(folder: Path) -> Mapping[str, Any]:
    """Return the manifest beside a log; a log alone has none."""
    return read_manifest(folder) if (folder / "manifest.json").exists() else {}


def _changed_versions(then: Mapping[str, str]) -> dict[str, list[str]]:
    """Return name -> versions then and now, where they are not the same."""
    now = versions()
    return {name: [then[name], now[name]] for name in now if name in then and then[name] != now[name]}


def _other_code(then: Mapping[str, str], manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Return what has changed since, for JSON: versions, and hashes of modules of the user's own."""
    return {
        "versions": _changed_versions(then),
        "modules": {other.module: [other.then, other.now] for other in other_versions(manifest.get(MODULES) or {})},
        "mended": manifest.get(MENDED, []),
    }


def _print_other_code(then: Mapping[str, str], manifest: Mapping[str, Any]) -> None:
    if others := _changed_versions(then):
        told = ", ".join(f"{name} {was} then, {is_now} now" for name, (was, is_now) in others.items())
        print(f"bits are equal for equal versions only: {told}")
    for other in other_versions(manifest.get(MODULES) or {}):
        print(f"this is {other}")
    for one in manifest.get(MENDED, []):
        module, sha256 = one["module"], one["sha256"][:12]
        print(
            f"module {module!r} was changed in the middle of the run: what was finished before is of SHA-256 {sha256}"
        )


def _dump(fields: Mapping[str, Any]) -> None:
    print(json.dumps(fields, indent=2))
