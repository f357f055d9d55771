"""Whether to run what a folder names: somebody else may have written it."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from adapters import private
from adapters.results.folder import LOGS_OF_AGENTS, MODULES, read_manifest
from adapters.stores import LOG_NAME, Store
from mape.allowed import named_modules
from mape.config import from_foreign_table
from mape.errors import ConfigError
from mape.ownership import not_ones_own


def check_trust(chosen: argparse.Namespace, path: Path, also: Iterable[str] = ()) -> None:
    """Ask whether that may run what a folder that is not the user's own names; imports nothing.

    Nothing is asked with --trust, nor where the folder and all in it are the user's own, nor where all that it names is
    built in, registered, or of Gymnasium.

    Parameters
    ----------
    chosen
        The command line, with its `trust`.
    path
        Folder of a run, or its log.
    also
        What would be run besides the modules that are named there.

    Raises
    ------
    ConfigError
        The answer is no, or there is nobody to ask.
    ResultsError
        What is there cannot be read.
    """
    if chosen.trust or (foreign := _foreign(path)) is None:
        return
    runs = [*also, *(f"module {module!r}, {why}" for module, why in sorted(_modules(path).items()))]
    if not runs:
        return
    listed = "".join(f"\n  {line}" for line in runs)
    said = f"{foreign}, so somebody else may have written what is to be run for {path}:{listed}"
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise ConfigError(f"{said}\nNothing was run. Where you trust all of it, say so: --trust")
    print(f"mapek: {said}\nRun it? [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise ConfigError("nothing was run")


def _foreign(path: Path) -> str | None:
    """Say why a folder, or a log with what stands beside it, is not the user's own; None where it is."""
    for each in _all_of(path):
        with contextlib.suppress(FileNotFoundError):  # of a run that goes on
            if (why := not_ones_own(each)) is not None:
                return why
    return None


def _all_of(path: Path) -> Iterator[Path]:
    yield path
    if not path.is_dir():
        beside = path.absolute().parent
        yield from (each for each in beside.iterdir() if each.name.startswith(f"{path.stem}."))
        yield beside / "manifest.json"
        return
    private.refuse_links(path)
    for place, folders, files in os.walk(path):
        yield from (Path(place, name) for name in (*folders, *files))


def _modules(path: Path) -> dict[str, str]:
    """Return module -> by what it is named."""
    found: dict[str, str] = {}
    folder = path if path.is_dir() else path.absolute().parent
    if (folder / "manifest.json").exists():
        manifest = read_manifest(folder)
        for module in manifest.get(MODULES) or {}:  # to look for its file is to import the package around it
            found[module] = "whose source is compared"
        for agent, table in manifest["agents"].items():
            found |= _of_config(table, f"the config of {agent}")
    logs = [path] if not path.is_dir() else [*folder.glob(LOG_NAME), *folder.glob(f"{LOGS_OF_AGENTS}*.sqlite")]
    for log in logs:
        with Store(log, readonly=True) as store:
            if (table := store.facts().get("config")) is not None:
                found |= _of_config(table, f"the config in {log.name}")
            for swap in store.swaps():
                found |= dict.fromkeys(_of_spec(swap.spec), f"swapped in from pass {swap.pass_no} on, in {log.name}")
    return found


def _of_config(table: Mapping[str, Any], where: str) -> dict[str, str]:
    return dict.fromkeys(named_modules(from_foreign_table(table, where)), f"named by {where}")


def _of_spec(spec: Mapping[str, Any]) -> Iterator[str]:
    for key, value in spec.items():
        if isinstance(value, Mapping):  # as a planner has its schedule
            yield from _of_spec(value)
        elif key == "name" and ":" in str(value):
            yield str(value).partition(":")[0]
