"""The folder of a run.

config-AGENT.json     effective config, as in the manifest, which `mapek run` takes as it is
manifest.json         what runs, with seeds and versions, those of the user's own modules by their SHA-256; and which
                      command began it, in which folder
chunks/               finished trials, as they come; gone when the run is complete. Of a trial that failed,
                      broken-UNIT.npz holds the passes before the failure
episodes-AGENT.npz    per-episode table; columns in `adapters.results.table`
q_tables-AGENT.npz    Q-tables at the end: q_UNIT (actions x states), actions_UNIT (ids of the rows)
trace-AGENT.npy       steps of the traced episodes of unit 0
readings-AGENT.npz    what its detectors read at the end of each of them: pass, statistic, alarm (episodes x detectors)
result.json           what the command found, with the hashes; its presence says that the run is complete. ``files``
                      holds the SHA-256 of tables and figures
figures/              PNG and PDF
log.sqlite            the log, of `up` and `serve`, and of a run over a plant; of several agents log-AGENT.sqlite

manifest.json, result.json and the JSON of a chunk end with the SHA-256 of their other entries; that of a chunk holds
those of the files beside it.

A unit of work is a trial, or one loop of it: unit ``trial * loops + loop``. What is said of trials below is of units.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import json
import os
import shutil
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

from adapters import private
from adapters.held import held_by
from adapters.results.chunk import READINGS, read_arrays, read_chunk, remove_parts
from adapters.results.files import (
    cannot_write,
    file_sum,
    hold,
    made_again,
    read_json,
    read_npz,
    read_sealed,
    whole,
    write_json,
    write_sealed,
)
from adapters.results.own_code import other_versions, own_modules
from adapters.results.table import read_episodes, read_last, write_npz
from adapters.stores import LOG_NAME
from adapters.versions import versions
from mape.config import Config
from mape.errors import MapekError, ResultsError
from mape.near import did_you_mean, nearest_path
from mape.tables import first_difference
from mape.trials import TrialResult

FORMAT = 3
"""Version of what stands in the folder; another one is not read."""

READERS = {2: "0.2.0.dev0"}
"""Which mapek reads an older one."""

LOGS_OF_AGENTS = "log-"
"""With what the names of logs begin where a run has several agents."""

BEGUN_BY = ("command", "cwd")
"""Entries of a manifest that do not say what runs: the same run may be gone on with from elsewhere."""

MODULES = "modules"
"""Entry of a manifest for the user's own code, see `own_modules`; older ones have none."""

MENDED = "mended"
"""Entry for what modules of the user's own were when the run was begun, or gone on with, and are no more."""


def default_path(name: str) -> Path:
    """Make an empty folder that nobody else has taken, and return its path: results/NAME-DATE-TIME.

    Raises
    ------
    ResultsError
        It cannot be made.
    """
    stem = Path("results", f"{name}-{time.strftime('%Y%m%d-%H%M%S')}")
    for n in itertools.count(1):
        path = stem if n == 1 else stem.with_name(f"{stem.name}-{n}")
        try:
            private.make_folder(path.parent)
            # Taken by being made: a name that is looked up first, another process can take meanwhile.
            path.mkdir(mode=private.FOLDER)
            path.chmod(private.FOLDER)
        except FileExistsError:
            if not path.parent.is_dir():
                raise ResultsError(
                    f"{path.parent} is a file, and no folder for results; choose another --out"
                ) from None
        except OSError as error:
            raise cannot_write(path, error) from error
        else:
            return path
    raise AssertionError


def read_manifest(path: Path, way_out: str = "name the folder that `mapek` wrote") -> dict[str, Any]:
    """Read what runs, or ran, in a folder; `way_out` ends the sentence where it cannot be read.

    Raises
    ------
    ResultsError
        It is no folder of a run of ours, or its manifest is damaged.
    """
    manifest = path / "manifest.json"
    if not os.path.isfile(manifest):  # which says no of a name that is too long; a Path raises
        near = None if os.path.exists(path) else nearest_path(path)
        raise ResultsError(
            f"{path} holds no run of ours{did_you_mean(near)} Name the folder that `mapek` wrote "
            "(results/NAME-DATE-TIME)"
        )
    try:
        there = read_json(manifest)
    except ResultsError as error:
        raise ResultsError(
            f"{manifest} is damaged ({error.__cause__}), so the run there cannot be continued; {way_out}"
        ) from error
    if not isinstance(there, dict) or "format" not in there or "agents" not in there:
        raise ResultsError(f"{manifest} is of no run of ours; {way_out}")
    if there["format"] in READERS:
        reader = READERS[there["format"]]
        raise ResultsError(
            f"{path} has a layout of format {there['format']}, and this mapek reads format {FORMAT}; mapek {reader} "
            f"reads it; {way_out}"
        )
    found: dict[str, Any] = read_sealed(manifest)
    return found


def is_summed(path: Path) -> bool:
    """Whether a file, named from its run's folder, has its checksum in ``result.json``."""
    if path.parts[0] == "figures":
        return path.suffix in (".png", ".pdf") and not path.name.startswith(".")
    return len(path.parts) == 1 and path.name.startswith(("episodes-", "q_tables-", "trace-", "readings-"))


def _stems(path: Path, agent: str) -> list[Path]:
    return sorted(p.with_suffix("") for p in (path / "chunks" / agent).glob("*.json"))


def assemble(folder: str, agent: str, rows: int, loops: int) -> None:
    """Make an agent's tables, of `rows` rows, of the chunks of all its trials, each of so many loops.

    Raises
    ------
    ResultsError
        A chunk is damaged, or the tables cannot be written.
    """
    path = Path(folder)
    stems = _stems(path, agent)
    write_npz(path / f"episodes-{agent}.npz", [stem.with_suffix(".rows") for stem in stems], rows, loops=loops)
    arrays: dict[str, npt.NDArray[Any]] = {}
    for stem in stems:
        arrays.update(read_arrays(stem))
    trace = arrays.pop("trace", None)
    if trace is not None:
        with whole(path / f"trace-{agent}.npy") as file:
            np.save(file, trace, allow_pickle=False)
        readings = {name: arrays.pop(f"readings_{name}") for name in READINGS}
        with whole(path / f"readings-{agent}.npz") as file:
            np.savez(file, allow_pickle=False, **readings)
    with whole(path / f"q_tables-{agent}.npz") as file:
        np.savez(file, allow_pickle=False, **arrays)


class RunFolder:
    """A folder that holds one run, of one or several agents, and nothing else.

    Parameters
    ----------
    path
        A new folder, an empty one, or that of an unfinished run of the same configs, which is then continued.
    kind
        The command.
    configs
        Agent -> config.
    trace
        Episodes of trial 0 whose steps are kept; a run that is continued has the same.
    command
        Arguments of the command line, with which `mapek resume` goes on; what is None is not known.
    mended
        Go on although modules of the user's own have changed since; the manifest then says so.

    Raises
    ------
    ResultsError
        The folder holds something else, or another process works in it.
    """

    def __init__(
        self,
        path: Path,
        kind: str,
        configs: Mapping[str, Config],
        trace: tuple[int, int] | None = None,
        command: Sequence[str] | None = None,
        *,
        mended: bool = False,
    ) -> None:
        self.path = path
        self.configs = dict(configs)
        self.command = None if command is None else list(command)
        self.resumed = 0
        wanted = {
            "format": FORMAT,
            "kind": kind,
            "agents": {agent: json.loads(config.to_json()) for agent, config in configs.items()},
            "trace": None if trace is None else list(trace),
            "versions": versions(),
        }
        self._kind = kind
        try:
            # Before anything is written there: a folder of someone else's is left as it is.
            self._refuse_foreign()
            private.make_folder(path)
            private.refuse_links(path)
            self._lock = open(path / ".lock", "a", opener=private.opener)  # noqa: SIM115 - held until `close`
        except OSError as error:
            raise cannot_write(path, error) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            who = held_by(self._lock)
            self._lock.close()
            raise ResultsError(f"another run is writing to {path}{who}; wait for it, or choose another --out") from None
        try:
            self._open(wanted, mended)
        except BaseException:
            self.close()
            raise

    def _refuse_foreign(self) -> None:
        if not self.path.is_dir() or (self.path / "manifest.json").exists():
            return
        # The manifest comes after the configs; a run that was killed before it has left no more than these.
        first = {".lock", *(f"config-{agent}.json" for agent in self.configs)}
        others = [p.name for p in self.path.iterdir() if p.name not in first and not p.match("*.json.*.part")]
        if others:
            raise ResultsError(
                f"{self.path} is not empty ({sorted(others)[0]}) and holds no run of ours; choose another --out"
            )

    def _open(self, wanted: dict[str, Any], mended: bool) -> None:
        manifest = self.path / "manifest.json"
        if not manifest.exists():
            self._refuse_foreign()
            remove_parts(self.path)
            self._write_configs(wanted)
            own = own_modules(self.configs.values())
            write_sealed(manifest, {**wanted, MODULES: own, "command": self.command, "cwd": os.getcwd()})
            return
        if (self.path / "result.json").exists():
            raise ResultsError(f"{self.path} holds a finished run, which is left as it is; choose another --out")
        there = read_manifest(self.path, "choose another --out")
        runs = {name: value for name, value in there.items() if name not in (*BEGUN_BY, MODULES, MENDED)}
        if runs != wanted:
            what, had, has = first_difference(runs, wanted)
            way_out = "give the same command to continue it"
            if what.startswith("versions."):
                way_out = "hashes hold for equal versions only: install those it was begun with to continue it"
            raise ResultsError(
                f"{self.path} holds an unfinished run with {what} = {had!r}, not {has!r}; {way_out}, or choose another "
                "--out"
            )
        others = other_versions(there.get(MODULES) or {})
        if others and not mended:
            raise ResultsError(
                f"{self.path} holds an unfinished run that was begun with {others[0]}. Its results would belong to "
                "neither. Put the file back as it was to continue, or choose another --out; or, where what is finished "
                f"is to stay as it is, `mapek resume {self.path} --mended`"
            )
        remove_parts(self.path)
        self._write_configs(wanted)
        self.resumed = sum(len(self.finished(agent)) for agent in self.configs)
        if others:
            then = [{"module": other.module, "sha256": other.then} for other in others]
            own = own_modules(self.configs.values())
            write_sealed(manifest, {**there, MODULES: own, MENDED: [*there.get(MENDED, []), *then]})

    def _write_configs(self, wanted: Mapping[str, Any]) -> None:
        for agent in self.configs:
            write_json(self.path / f"config-{agent}.json", wanted["agents"][agent])

    def log_path(self, agent: str) -> Path:
        """Return where the log of an agent's run over a plant belongs."""
        return self.path / (LOG_NAME if len(self.configs) == 1 else f"{LOGS_OF_AGENTS}{agent}.sqlite")

    def chunk_stem(self, agent: str, first: int, count: int) -> str:
        """Return where a chunk's results belong."""
        folder = self.path / "chunks" / agent
        private.make_folder(folder)
        return str(folder / f"{first:08d}-{first + count - 1:08d}")

    def _stems(self, agent: str) -> list[Path]:
        return _stems(self.path, agent)

    def finished(self, agent: str) -> dict[int, TrialResult]:
        """Return the results of the trials that are on disk, by number."""
        found: dict[int, TrialResult] = {}
        for stem in self._stems(agent):
            for result in read_chunk(stem, self.configs[agent]) or ():
                found[self.configs[agent].unit(result.trial, result.loop)] = result
        return found

    def assembly(self, agent: str) -> tuple[str, str, int, int]:
        """Return the arguments with which `assemble` makes the agent's tables of its chunks, in any process."""
        config = self.configs[agent]
        return str(self.path), agent, config.units * config.episodes, config.loops

    def assemble(self, agent: str) -> None:
        """Make the agent's tables of its chunks."""
        assemble(*self.assembly(agent))

    def episodes(self, agent: str, *columns: str) -> dict[str, npt.NDArray[Any]]:
        """Return columns of the agent's table, each of shape (trials, episodes)."""
        return read_episodes(self.path / f"episodes-{agent}.npz", columns)

    def last_episodes(self, agent: str, column: str, episodes: int) -> npt.NDArray[Any]:
        """Return a column of the agent's table for the last episodes of each trial, shape (trials, episodes)."""
        return read_last(self.path / f"episodes-{agent}.npz", column, episodes)

    def q_tables(self, agent: str) -> dict[int, tuple[npt.NDArray[np.float64], tuple[int, ...]]]:
        """Return values and action ids at the end of each trial."""
        path = self.path / f"q_tables-{agent}.npz"
        hold(path)
        arrays = read_npz(path, made_again(path))
        trials = sorted(int(name[2:]) for name in arrays if name.startswith("q_"))
        return {t: (arrays[f"q_{t}"], tuple(arrays[f"actions_{t}"].tolist())) for t in trials}

    def q_table(self, agent: str, unit: int) -> tuple[npt.NDArray[np.float64], tuple[int, ...]]:
        """Return values and action ids at the end of one trial."""
        path, names = self.path / f"q_tables-{agent}.npz", (f"q_{unit}", f"actions_{unit}")
        hold(path)
        values, actions = read_npz(path, made_again(path), names).values()
        return values, tuple(actions.tolist())

    def trace(self, agent: str) -> npt.NDArray[np.void] | None:
        """Return the traced steps of trial 0, or None where nothing was traced."""
        path = self.path / f"trace-{agent}.npy"
        if not path.exists():
            return None
        hold(path)
        steps: npt.NDArray[np.void] = np.load(path, allow_pickle=False)
        return steps

    def readings(self, agent: str) -> dict[str, npt.NDArray[Any]]:
        """Return what detectors read in the traced episodes of trial 0: `pass`, `statistic` and `alarm`, by column."""
        path = self.path / f"readings-{agent}.npz"
        hold(path)
        return read_npz(path, made_again(path))

    def finish(self, result: Mapping[str, Any]) -> None:
        """Write the result, with the checksums of the files that are beside it, and remove the chunks."""
        kept = [path for path in sorted(self.path.rglob("*")) if is_summed(path.relative_to(self.path))]
        with ThreadPoolExecutor() as pool:  # which hash side by side
            sums = dict(zip((str(p.relative_to(self.path)) for p in kept), pool.map(file_sum, kept), strict=True))
        write_sealed(
            self.path / "result.json", {"command": self.command, "versions": versions(), **result, "files": sums}
        )
        shutil.rmtree(self.path / "chunks", ignore_errors=True)

    def kept(self) -> str:
        """Say in a sentence what there is of the run, and how to go on."""
        if (self.path / "result.json").exists():
            return f"The run is complete; all of it is in {self.path}."
        if self._kind == "up" or any(self.log_path(agent).exists() for agent in self.configs):
            return f"All that was logged is kept; `mapek resume {self.path}` continues."
        kept = sum(len(self.finished(agent)) for agent in self.configs)
        wanted = sum(config.units for config in self.configs.values())
        units = "trials" if all(config.loops == 1 for config in self.configs.values()) else "loops of trials"
        continues = f"`mapek resume {self.path}` continues"
        return f"{kept:,} of {wanted:,} {units} are finished and kept in {self.path}; {continues}."

    def close(self) -> None:
        """Let others have the folder."""
        if not self._lock.closed:
            fcntl.flock(self._lock, fcntl.LOCK_UN)
            self._lock.close()
            if not any(p.name != ".lock" for p in self.path.iterdir()):
                (self.path / ".lock").unlink(missing_ok=True)
                os.rmdir(self.path)

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None and not isinstance(error, MapekError):
            # Ctrl-C, or a reader that is gone, does not know of the folder.
            with contextlib.suppress(MapekError):
                error.add_note(self.kept())
        self.close()
