"""What is asked of a plant's diary."""

import functools
from pathlib import Path
from typing import Any

import pytest

EPISODES = 12
LONG = functools.partial(pytest.param, marks=pytest.mark.long)


def plant(episodes: int = EPISODES, name: str = "Pump", system: Any = (), **over: Any) -> dict[str, Any]:
    """A config of a plant."""
    return {"name": "plant", "episodes": episodes, "system": {"id": f"pump:Plant{name}-v0", **dict(system)}, **over}


def diary(folder: Path) -> list[str]:
    """What was done, without who did it."""
    path = folder / "diary"
    return [line.split(maxsplit=1)[1] for line in path.read_text().splitlines()] if path.exists() else []


def resets(folder: Path) -> list[int]:
    return [int(line.split()[1]) for line in diary(folder) if line.startswith("reset")]


def lives(folder: Path) -> list[list[str]]:
    """What was done by each process, in the order of their first lines."""
    found: dict[str, list[str]] = {}
    path = folder / "diary"
    for line in path.read_text().splitlines() if path.exists() else []:
        pid, what = line.split(maxsplit=1)
        found.setdefault(pid, []).append(what)
    return [*found.values()]


def one_by_one(first: int, last: int) -> list[str]:
    """The diary of an undisturbed plant from episode `first` to `last`."""
    return ["made", "connect", *(f"reset {number}" for number in range(first, last + 1)), "closed"]
