"""Where a config file is: where its name says, or by a bare name in this folder, or among the examples."""

from __future__ import annotations

import functools
import os
from pathlib import Path

from mape.errors import ConfigError
from mape.near import did_you_mean, nearest, nearest_path

SUFFIXES = (".toml", ".json")
"""Of files that are read as configs."""


@functools.cache  # asked for each part of each trial
def examples() -> Path:
    """Return the folder of the examples: within this package where it is installed, beside it in a checkout."""
    inside = Path(__file__).with_name("examples")
    return inside if inside.is_dir() else inside.parents[1] / "examples"


def shipped() -> dict[str, Path]:
    """Return the configs among the examples, by the bare names under which they are found."""
    return {path.stem: path for path in sorted(examples().glob("*.toml"))}


def find_config(named: str | Path, folder: Path | None = None) -> Path:
    """Return the file of a config.

    What stands at ``DIR/NAME.toml`` is that. A bare ``NAME`` is a file of that very name, else NAME.toml in the same
    folder, else the example of that name.

    Parameters
    ----------
    named
        As it was typed, or as another config extends it.
    folder
        From which it is named; by default the present one.

    Raises
    ------
    ConfigError
        There is no such file.

    Examples
    --------
    >>> find_config("frozen_lake") == examples() / "frozen_lake.toml"
    True
    """
    path = Path(named) if folder is None else folder / named
    ready_made = shipped()
    found = [path, path.with_name(f"{path.name}.toml")] if path.name and not path.suffix else [path]
    found += [ready_made[str(named)]] if str(named) in ready_made else []
    for one in found:
        if os.path.exists(one) and not os.path.isdir(one):
            return one
    try:
        os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        near = nearest_path(path, _is_config) or nearest(path.stem, ready_made)
        raise ConfigError(
            f"no config file {str(path)!r}{did_you_mean(near)} A bare name also finds an example: "
            f"{', '.join(ready_made)}. `mapek examples DIR` copies them."
        ) from None
    except (OSError, ValueError):
        pass  # it is there, or nothing like a path: whoever reads it says what is wrong
    return path


def _is_config(path: Path) -> bool:
    return path.suffix in SUFFIXES and os.path.isfile(path)
