"""Oracle: told the drifts, in `episodes`. It bounds detection (no delay, no false alarm), not the return."""

from __future__ import annotations

import math
from typing import Any

from pydantic import field_validator

from knowledge.records import Direction
from knowledge.rows import UNKNOWN
from mape.ports import QuietRule
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


def oracle_alarm(state: list[float], params: tuple[float, ...], x: float) -> tuple[bool, float, int]:
    """Count one episode on state = (episodes seen,); params are the episodes that are told, increasing."""
    state[0] += 1.0
    told = False
    for episode in params:
        told = told or episode == state[0]
    return told, math.nan, UNKNOWN


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
        self._state = [0.0]
        self._params = tuple(float(episode) for episode in config.episodes)

    @property
    def quiet(self) -> QuietRule:
        """The rule of `update`, over this one's numbers."""
        return QuietRule(oracle_alarm, self._state, self._params)

    def update(self, x: float) -> bool:
        """Count one episode; say whether it is a named one."""
        return oracle_alarm(self._state, self._params, x)[0]

    def reset(self) -> None:
        """Do nothing: the count of the episodes is no evidence to be forgotten."""

    def state(self) -> int:
        """Return the number of episodes seen."""
        return int(self._state[0])

    def restore(self, state: Any) -> None:
        """Take up where `state` was given."""
        self._state[0] = float(int(state))
