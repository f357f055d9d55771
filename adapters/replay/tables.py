"""A folder of tables beside what its trials come to when they are run again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from adapters.experiments.runner import run_agents
from adapters.results import RunFolder
from adapters.results.files import hold, read_npz, read_sealed
from adapters.results.table import COLUMNS, read_episodes
from adapters.systems.declared import is_plant
from mape.config import Config, from_table
from mape.errors import ResultsError
from mape.trials import TrialResult, combined_hash


class TableReplay(NamedTuple):
    """What running again came to; `difference` is a sentence, or None."""

    trials: int
    episodes: int
    log_sha256: str
    q_table_sha256: str
    difference: str | None


def replay_tables(
    path: Path, manifest: Mapping[str, Any], scratch: Path, *, workers: int | None = None, quiet: bool = False
) -> TableReplay:
    """Run all trials of a finished folder again, and name the first difference from what it holds.

    Parameters
    ----------
    path, manifest
        The folder, and what `read_manifest` says of it.
    scratch
        An empty folder for the tables of now.
    workers, quiet
        As `run_agents` takes them.

    Raises
    ------
    ResultsError
        The run there is not finished, or its files are damaged.
    MapekError
        A trial failed.
    """
    if not (path / "result.json").exists():
        raise ResultsError(f"{path} holds an unfinished run; finish it with `mapek resume {path}`")
    stored = read_sealed(path / "result.json")
    configs = {agent: from_table(table, f"{path}, {agent}") for agent, table in manifest["agents"].items()}
    for config in configs.values():
        if is_plant(config.system):
            raise ResultsError(
                f"{path} holds a run over {config.system.id}, which cannot be driven again, and no log of it: there is "
                "nothing that it could be compared with"
            )
    with RunFolder(scratch, "replay", configs) as folder:
        results = run_agents(configs, folder, workers=workers, quiet=quiet)
    found = (said for agent, config in configs.items() for said in _differences(path, scratch, agent, config))
    return TableReplay(
        sum(config.units for config in configs.values()),
        sum(config.units * config.episodes for config in configs.values()),
        *_combined([r for agent in configs for r in results[agent]]),
        next(found, None) or _hash_difference(path, stored, configs, results),
    )


def _differences(path: Path, scratch: Path, agent: str, config: Config) -> Iterator[str]:
    """Yield what differs between an agent's tables there and here."""
    columns = (*COLUMNS, "loop") if config.loops > 1 else COLUMNS
    firsts = []
    for place, column in enumerate(columns):  # one at a time is in memory
        there, here = (read_episodes(folder / f"episodes-{agent}.npz", [column])[column] for folder in (path, scratch))
        if there.shape != here.shape:
            yield f"agent {agent}: column {column} has {_shape(there)} there, and {_shape(here)} here"
            return
        at = np.flatnonzero(~_equal(there, here).ravel())
        if len(at):
            unit, episode = divmod(int(at[0]), there.shape[1])
            values = there[unit, episode].item(), here[unit, episode].item()
            firsts.append((int(at[0]), place, unit, episode + 1, column, values))
    if firsts:
        _, _, unit, episode, column, (was, is_now) = min(firsts)
        where = f"agent {agent}, {config.unit_name(*divmod(unit, config.loops))}, episode {episode}"
        yield f"{where}: {column} is {was} there, and {is_now} here"
    yield from _table_differences(path, scratch, agent, config)


def _table_differences(path: Path, scratch: Path, agent: str, config: Config) -> Iterator[str]:
    hold(path / f"q_tables-{agent}.npz")
    there, here = (read_npz(folder / f"q_tables-{agent}.npz", "It cannot be compared.") for folder in (path, scratch))
    for unit in range(config.units):
        named = f"agent {agent}, {config.unit_name(*divmod(unit, config.loops))}"
        actions, values = f"actions_{unit}", f"q_{unit}"
        if actions not in there or values not in there:
            yield f"{named}: its Q-table is missing there"
        elif there[actions].tolist() != here[actions].tolist():
            yield (
                f"{named}: the rows of the Q-table are of actions {there[actions].tolist()} there, and "
                f"{here[actions].tolist()} here"
            )
        elif there[values].shape != here[values].shape:
            yield f"{named}: the Q-table has shape {there[values].shape} there, and {here[values].shape} here"
        elif len(at := np.argwhere(~_equal(there[values], here[values]))):
            row, state = at[0].tolist()
            yield (
                f"{named}: the Q-value of action {here[actions][row]} in state {state} is {there[values][row, state]} "
                f"there, and {here[values][row, state]} here"
            )


def _hash_difference(
    path: Path, stored: Mapping[str, Any], configs: Mapping[str, Config], results: Mapping[str, list[TrialResult]]
) -> str | None:
    """Compare the hashes that a result names: of each trial, of each agent, or of all."""
    every = [r for agent in configs for r in results[agent]]
    named: list[tuple[str, Mapping[str, Any], str, str]] = [("", stored, *_combined(every))]
    if isinstance(stored.get("agents"), dict):
        named += [
            (f", agent {agent}", stored["agents"].get(agent, {}), *_combined(results[agent])) for agent in configs
        ]
    if isinstance(stored.get("trials"), list):
        pairs = zip(stored["trials"], every, strict=False)
        named += [(f", trial {r.trial}", one, r.log_sha256, r.q_table_sha256) for one, r in pairs]
    for where, said, log, table in reversed(named):  # from the parts to the whole
        for name, here in (("log_sha256", log), ("q_table_sha256", table)):
            if said.get(name, here) != here:
                return f"{path / 'result.json'}{where}: {name} is {said[name]} there, and {here} here"
    return None


def _combined(results: list[TrialResult]) -> tuple[str, str]:
    return combined_hash(r.log_sha256 for r in results), combined_hash(r.q_table_sha256 for r in results)


def _equal(there: npt.NDArray[Any], here: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    # By their bytes: a zero's sign, and what is no number, count.
    if there.dtype != here.dtype:
        return np.zeros(there.shape, bool)
    kind = f"u{there.dtype.itemsize}"
    same: npt.NDArray[np.bool_] = np.ascontiguousarray(there).view(kind) == np.ascontiguousarray(here).view(kind)
    return same


def _shape(table: npt.NDArray[Any]) -> str:
    return f"{table.shape[0]} trials of {table.shape[1]} episodes"
