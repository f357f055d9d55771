"""`mapek examples`: the configs and programs that mapek ships, listed, or copied to be read, run and changed."""

from __future__ import annotations

import argparse
import ast
import os
from pathlib import Path

from adapters.results.files import cannot_write
from mape.config_files import examples
from mape.errors import ConfigError, ResultsError
from mape.tables import read_table


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    shipped = sorted(path for path in examples().iterdir() if path.suffix in (".toml", ".py"))
    if chosen.folder is None:
        width = max(len(_name(path)) for path in shipped)
        for path in sorted(shipped, key=lambda path: (path.suffix != ".toml", path)):
            print(f"{_name(path):<{width}}  {_about(path)}")
        print("\n`mapek run NAME` runs a config by its name; `mapek examples DIR` copies all, the programs among them.")
        return 0
    folder = Path(chosen.folder)
    if os.path.exists(folder) and not os.path.isdir(folder):
        raise ConfigError(f"{chosen.folder!r} is a file; name a folder, which may be new")
    copied, changed = _copy(shipped, folder)
    there = len(shipped) - copied - len(changed)
    print(f"{folder}: {copied} examples copied{f', {there} were there already' if there else ''}")
    if changed:
        raise ResultsError(
            f"{folder} has files of its own called {', '.join(changed)}, which are left as they are. Rename them, or "
            "name another folder."
        )
    return 0


def _copy(shipped: list[Path], folder: Path) -> tuple[int, list[str]]:
    """Copy what is not there; return how many that were, and the names under which something else stands there."""
    copied, changed = 0, []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path in shipped:
            target, content = folder / path.name, path.read_bytes()
            try:
                with open(target, "xb") as file:
                    file.write(content)
                copied += 1
            except FileExistsError:
                if not target.is_file() or target.read_bytes() != content:
                    changed.append(path.name)
    except OSError as error:
        raise cannot_write(folder, error, "Make room, or name another folder.") from error
    return copied, changed


def _name(path: Path) -> str:
    return path.stem if path.suffix == ".toml" else path.name


def _about(path: Path) -> str:
    """Return what an example says of itself: the description of a config, the first line of a program."""
    if path.suffix == ".toml":
        return str(read_table(path).get("description", ""))
    said = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return said.partition("\n")[0]
