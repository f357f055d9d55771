"""Folders of runs, made within this process, and what commands say of them once they are damaged."""

import contextlib
import io
import json
import shutil
from pathlib import Path
from typing import NamedTuple

from replay_logs import small, write_log

from adapters.cli.main import main
from adapters.results import RunFolder
from adapters.stores import Store

QUIETLY = ("--no-figures", "-q")
CONFIG = small(episodes=12)


class Said(NamedTuple):
    """How a command ended, and what it said."""

    code: int
    out: str
    err: str


def mapek(*arguments: object) -> Said:
    """Run a command within this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as stop:
            code = int(stop.code or 0)
    return Said(code, out.getvalue(), err.getvalue())


def hashes(folder: Path) -> tuple[str, str]:
    found = json.loads((folder / "result.json").read_bytes())
    return found["log_sha256"], found["q_table_sha256"]


def logged(folder: Path, *, open_wal: bool = False) -> Path:
    """Make a folder of `mapek up` whose log is complete, and of which the tables are still to be made.

    With `open_wal` the log is as a killed Knowledge leaves it.
    """
    (folder.parent / "small.json").write_text(CONFIG.to_json())
    command = ["up", str(folder.parent / "small.json"), *QUIETLY]
    RunFolder(folder, "up", {"small": CONFIG}, command=command).close()
    log = folder / "log.sqlite"
    write_log(log, CONFIG)
    if open_wal:
        with Store(log) as store:
            store.event("plan", "note", "what was committed last")
            store.commit()
            killed = folder.parent / "killed"
            shutil.copytree(folder, killed)
        shutil.rmtree(folder)
        killed.rename(folder)
        assert (folder / "log.sqlite-wal").stat().st_size
    return folder


def copied(folder: Path, to: Path) -> Path:
    shutil.rmtree(to, ignore_errors=True)
    shutil.copytree(folder, to)
    return to
