"""Oracle: told the drifts, in `episodes`. It bounds detection (no delay, no false alarm), not the return."""

from __future__ import annotations

from typing import Any

from pydantic import field_validator

from knowledge.records import Direction
from mape.specs import PartConfig


class OracleConfig(PartConfig):
    """Options of `Oracle`."""

    episodes: tuple[int, ...] = ()

    @field_validator("episodes")
    @classmethod
    def _in_order(cls, episodes: tuple[int, ...]) -> tuple[int, ...]:
        if any(e < 1 for e in episodes) or list(episodes) != sorted(set(episodes)):
            raise ValueError(f"episodes {list(episodes)} must be increasing and at least 1")
        return episodes


class Oracle:
    """Alarms at the end of each named episode: the first one of a new regime, as a rule.

    It counts the episodes that it sees: swapped in on the way, it counts from there, or on from another oracle's count.

    Examples
    --------
    >>> oracle = Oracle(OracleConfig(episodes=(2,)))
    >>> [oracle.update(0.0) for _ in range(3)]
    [False, True, False]
    """

    Config = OracleConfig
    direction: Direction = "unknown"
    statistic = None
    state_format = "oracle/1"

    def __init__(self, config: OracleConfig) -> None:
        self.config = config
        self._told = frozenset(config.episodes)
        self._episode = 0

    def update(self, x: float) -> bool:
        """Count one episode; say whether it is a named one."""
        self._episode += 1
        return self._episode in self._told

    def reset(self) -> None:
        """Do nothing: the count of the episodes is no evidence to be forgotten."""

    def state(self) -> int:
        """Return the number of episodes seen."""
        return self._episode

    def restore(self, state: Any) -> None:
        """Take up where `state` was given."""
        self._episode = int(state)
