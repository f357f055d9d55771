"""`mapek resume`: an unfinished run goes on, by the command that began it."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import sys
from pathlib import Path
from typing import Any

from adapters import private
from adapters.cli.main import dispatch
from adapters.cli.options import parser
from adapters.cli.trust import check_trust
from adapters.results.folder import read_manifest
from adapters.scratch import scratch
from mape.config_files import find_config
from mape.errors import ConfigError, ResultsError


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    folder = Path(chosen.folder).resolve()  # of a link somebody else may make another one meanwhile
    private.refuse_links(folder)
    manifest = read_manifest(folder)
    if (folder / "result.json").exists():
        raise ResultsError(f"{folder} holds a finished run, which is left as it is; there is nothing to continue")
    command, cwd = manifest.get("command"), manifest.get("cwd")
    if not isinstance(command, list) or not isinstance(cwd, str):
        raise ResultsError(
            f"{folder} does not say which command began it; give that command again, with --out {folder}, to continue"
        )
    again = _parsed(command, folder)
    # A config that the command names may be another one than the manifest holds: it is part of what is trusted.
    check_trust(chosen, folder, [f"{shlex.join(['mapek', *command])}, in {cwd}, with all that its configs there name"])
    again.out, again.trust = str(folder), True
    again.quiet = again.quiet or chosen.quiet
    again.mended = chosen.mended
    # What stands in a folder may be somebody else's word, and is not to say which file of this machine is replaced.
    if again.json not in (None, "-") and chosen.json is None:
        print(f"--json {again.json} is not written; say it again where it is to be: --json FILE", file=sys.stderr)
        again.json = None
    if chosen.json is not None:
        again.json = chosen.json if chosen.json == "-" else os.path.abspath(chosen.json)
    if chosen.workers is not None:
        if not hasattr(again, "workers"):
            raise ConfigError(f"`mapek {again.command}` has no --workers: each role is a process of its own")
        again.workers = chosen.workers
    with contextlib.ExitStack() as opened:
        if Path(cwd).is_dir():
            # Configs, parts of one's own and --json were named from there.
            opened.enter_context(contextlib.chdir(cwd))
        else:
            print(f"the folder {cwd}, where the run was begun, is gone; continuing from here", file=sys.stderr)
        _find_config(again, manifest, opened)
        return dispatch(again)


def _parsed(command: list[str], folder: Path) -> argparse.Namespace:
    again = None
    with contextlib.suppress(SystemExit), contextlib.redirect_stderr(None):
        again = parser().parse_args(command)
    if again is None or not hasattr(again, "out"):
        raise ResultsError(f"{folder} was begun by `mapek {' '.join(command)}`, which this mapek does not know")
    again.arguments = command
    return again


def _find_config(again: argparse.Namespace, manifest: dict[str, Any], opened: contextlib.ExitStack) -> None:
    """Take the config as the folder keeps it where the file that was named is gone."""
    path = getattr(again, "config", None)
    if path is None:
        return
    with contextlib.suppress(ConfigError):
        find_config(path)
        return
    label, config = next(iter(manifest["agents"].items()))
    # With all that the command line had laid over it; an agent is named once more, for files are named after it.
    kept = Path(opened.enter_context(scratch()), "config.json")
    kept.write_text(json.dumps({**config, "agents": {label: {}}}), encoding="utf-8")
    again.config, again.agent = str(kept), label if again.agent else None
    again.profile, again.overrides, again.seed, again.trials, again.engine = None, [], None, None, None
