"""Everything that mapek raises on purpose.

    MapekError
    |-- ConfigError          a config, an option or a name that is not legal
    |   `-- UnknownName      a part, system or option that does not exist ("did you mean ...?")
    |-- PartError            a detector, planner, schedule or learner that raised or broke its contract
    |-- ManagedSystemError   a managed system that raised or broke its contract
    |   `-- NonFiniteError   a reward, TD error or signal that is NaN or infinite
    |-- BusError             a record that could not be sent or delivered
    `-- ResultsError         a results folder that is taken, truncated, of another config, or cannot be written

    Stop                     somebody wants this process to end; no error, and no Exception

Each message names the value, what is legal, and the way out. The CLI prints it as one paragraph and exits with 1,
or with 2 for a ConfigError.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from mape.near import did_you_mean, nearest


class MapekError(Exception):
    """Base of all errors that are raised on purpose."""


class Stop(BaseException):
    """Somebody wants this process to end, as by a signal: raised through whatever runs, by no fault of it."""


class ConfigError(MapekError):
    """A config, an option or a name that is not legal."""


class UnknownName(ConfigError):
    """A name that is not one of the legal ones."""

    def __init__(self, what: str, name: str, legal: Iterable[str], way_out: str = "") -> None:
        legal = sorted(legal)
        hint = did_you_mean(nearest(name, legal))
        known = f" Known: {', '.join(legal)}." if legal else ""
        super().__init__(f"unknown {what} {name!r}{hint}{known}{' ' if way_out else ''}{way_out}")

    def __reduce__(self) -> tuple[Any, ...]:
        # Made again of its text, as the others are: a worker process hands it on by pickle.
        return ConfigError, self.args


class PartError(MapekError):
    """A part of the loop raised, or broke its contract."""


class ManagedSystemError(MapekError):
    """A managed system raised, or broke its contract."""


class NonFiniteError(ManagedSystemError):
    """A number of the managed system is NaN or infinite; nothing of the episode was learnt."""


class BusError(MapekError):
    """A record could not be sent or delivered."""


class ResultsError(MapekError):
    """A results folder is taken, truncated, of another config, or cannot be written."""
