"""What the commands share: configs with the options of the command line, folders, and the output of results."""

from __future__ import annotations

import argparse
import atexit
import contextlib
import functools
import gc
import json
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adapters.cli.main import OutputError
from mape import compose, ctrl_c
from mape.config import Config, load
from mape.config_files import find_config
from mape.errors import ConfigError, ResultsError
from mape.parts import cautions
from mape.tables import parse_override

if TYPE_CHECKING:  # `mapek serve` does without systems and results, most commands without Zenoh
    from adapters.buses.wire import Wire
    from adapters.experiments.runner import Checked
    from adapters.results import RunFolder
    from adapters.systems.lending import Lender


def prepare() -> None:
    """Make long compilations heard, and the end of the process quick."""
    # Python looks for garbage a last time, among all that Numba keeps, which takes longer than many a run.
    atexit.register(gc.freeze)
    if not compose.on_compile:
        compose.on_compile.append(lambda sentence: print(sentence, file=sys.stderr))
    if not ctrl_c.on_wait:
        ctrl_c.on_wait.append(lambda sentence: print(f"mapek: {sentence}", file=sys.stderr, flush=True))


def config_of(path: str | Path, chosen: argparse.Namespace, agent: str | None = None, **defaults: Any) -> Config:
    """Load a config with the command line's profile, overrides, seed, trials and engine laid over it.

    `defaults` fill what the command line leaves open. Which file a bare name stands for is said, once.
    """
    found = find_config(path)
    if found != Path(path) and path not in (told := vars(chosen).setdefault("told", set())):
        told.add(path)
        print(f"{path} is {found}", file=sys.stderr)
    overrides = list(chosen.overrides)
    given = {key for override in overrides for key in parse_override(override)}
    for key in ("seed", "trials"):
        value = getattr(chosen, key, None)
        if value is None and key not in given:
            value = defaults.get(key)
        if value is not None:
            overrides.append(f"{key}={value}")
    if (engine := getattr(chosen, "engine", None)) is not None:
        overrides.append(f"execute.engine={engine}")
    return load(path, profile=chosen.profile or defaults.get("profile"), agent=agent, overrides=overrides)


def open_folder(
    chosen: argparse.Namespace,
    kind: str,
    name: str,
    configs: Mapping[str, Config],
    trace: tuple[int, int] | None = None,
    check: Callable[[Config], object] | None = None,
) -> RunFolder:
    """Open the folder that the command line names, or a new one, and say if it is continued.

    What is wrong with a config is said before: no folder is begun that could not be gone on with.
    """
    from adapters.cli.trust import check_trust
    from adapters.experiments import runner
    from adapters.results import RunFolder
    from adapters.results.folder import default_path

    check = check or runner.check
    check_json_target(chosen)
    if chosen.out and os.path.exists(chosen.out) and not os.path.isdir(chosen.out):
        raise ConfigError(f"--out {chosen.out!r} is a file; name a folder, which may be new")
    if chosen.out and os.path.isdir(chosen.out):
        check_trust(chosen, Path(chosen.out))
    caution(configs.values())
    for agent, config in configs.items():
        check_name(agent)
        checked = check(config)
        if getattr(chosen, "verbose", False):
            print(f"{agent}: {checked}{_looked_at(chosen, trace)}", file=sys.stderr)
    path = Path(chosen.out) if chosen.out else default_path(name)
    folder = RunFolder(path, kind, configs, trace, chosen.arguments, mended=getattr(chosen, "mended", False))
    if folder.resumed:
        say(chosen, f"continuing in {folder.path}: {folder.resumed:,} trials are finished already")
    return folder


def caution(configs: Iterable[Config]) -> None:
    """Say on standard error, once, what detectors say of the signals that they are to watch."""
    for sentence in dict.fromkeys(sentence for config in configs for sentence in cautions(config)):
        print(f"caution: {sentence}", file=sys.stderr)


def looking(lend: Lender) -> Callable[[Config], Checked]:
    """Return a check of configs that looks at the systems which `lend` lends afterwards."""
    from adapters.experiments.runner import check

    return functools.partial(check, lend=lend)


def _looked_at(chosen: argparse.Namespace, trace: tuple[int, int] | None) -> str:
    """Say which passes are made one by one all the same, because somebody looks at them."""
    if getattr(chosen, "show", None) is not None:
        return "; the passes of trial 0 are made one by one, to be shown"
    if trace is not None:
        return f"; passes {trace[0]} to {trace[1]} of trial 0 are made one by one, to be traced"
    return ""


def wire_of(chosen: argparse.Namespace, endpoint: str, system: str) -> Wire:
    """Return where a run's processes meet, with what the command line says of who may come.

    Raises
    ------
    ConfigError
        The endpoint is none, or takes no keys, or has none and would be open to other machines.
    """
    from adapters.buses.wire import Wire

    tls, token = (None if path is None else Path(path) for path in (chosen.tls, chosen.token))
    # `mapek up`, whose processes meet on this machine, takes no other patience.
    more: dict[str, Any] = {"patience": chosen.patience} if hasattr(chosen, "patience") else {}
    if hasattr(chosen, "largest_message"):
        more["largest"] = chosen.largest_message << 20
    return Wire(endpoint, system, tls, chosen.insecure, token=token, **more)


@contextlib.contextmanager
def operator(chosen: argparse.Namespace) -> Iterator[tuple[Any, Any]]:
    """Join a run as a person who looks on; yield the session and the wire.

    Raises
    ------
    BusError
        Nobody listens there.
    """
    wire = wire_of(chosen, chosen.connect, "*")
    session = wire.join_patiently("operator", 3.0)
    try:
        yield session, wire
    finally:
        session.close()  # type: ignore[no-untyped-call]


def check_name(agent: str) -> None:
    """Refuse an agent whose name cannot be part of a file's name."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", agent):
        raise ConfigError(
            f"agent {agent!r} gives its name to files; let it begin with a letter or digit, and hold at most 64 "
            "letters, digits, _ . or -"
        )


def check_json_target(chosen: argparse.Namespace) -> None:
    """Refuse a --json that cannot be written before the work is done, not after."""
    from adapters.results.files import try_whole

    if chosen.json in (None, "-"):
        return
    path = Path(chosen.json)
    if os.path.isdir(path):
        raise ConfigError(f"--json {chosen.json!r} is a folder; name a file, or - for standard output")
    if not os.path.isdir(path.absolute().parent):
        raise ConfigError(f"--json {chosen.json!r}: there is no folder {str(path.parent)!r} to hold it; make it first")
    if _is_replaced(path):
        try:
            try_whole(path, "Nothing was run; choose another place for --json.")
        except ResultsError as error:
            raise ConfigError(f"--json {chosen.json!r}: {error}") from error
    elif not os.access(path, os.W_OK):
        raise ConfigError(f"--json {chosen.json!r} may not be written by you; choose another place")


def _is_replaced(path: Path) -> bool:
    """Whether a file is written anew and put in its place: a device or a pipe cannot be replaced."""
    return os.path.isfile(path) or not os.path.exists(path)


def say(chosen: argparse.Namespace, text: str = "") -> None:
    """Print for people: on standard error where standard output carries JSON.

    Raises
    ------
    OutputError
        It cannot be printed.
    """
    try:
        print(text, file=sys.stderr if chosen.json == "-" else sys.stdout)
    except OSError as error:
        raise OutputError(error) from error


def finish(chosen: argparse.Namespace, folder: RunFolder, result: Mapping[str, Any], figures: list[Path]) -> None:
    """Write the result beside the tables and where --json wants it, and say where all is."""
    from adapters.experiments.statistics import finite
    from adapters.results.files import cannot_write, write_json

    result = finite(dict(result))
    folder.finish(result)
    if chosen.json == "-":
        print(json.dumps(result, indent=2, allow_nan=False))
    elif chosen.json:
        target = Path(chosen.json)
        if _is_replaced(target):
            write_json(target, result, folder.kept(), opener=None)  # the user's own place, with the mode of the place
        else:
            try:
                with open(target, "w", encoding="utf-8") as file:
                    json.dump(result, file, indent=2, allow_nan=False)
            except OSError as error:
                raise cannot_write(target, error, folder.kept()) from error
    if figures:
        say(
            chosen, f"figures:  {folder.path / 'figures'} ({', '.join(sorted({p.stem for p in figures}))}; PNG and PDF)"
        )
    say(chosen, f"results:  {folder.path}")
    sys.stdout.flush()  # here, where it can still be said what the folder holds
