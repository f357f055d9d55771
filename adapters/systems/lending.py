"""The same system for one trial after another, and the one that was looked at for the first of them."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Self

from adapters.systems.gymnasium_system import GymnasiumSystem, make_env
from mape.config import SystemConfig


class Lender:
    """Makes systems; one that was only looked at is lent to whoever asks next, so that none is made to be looked at.

    One whose episodes are rules is lent again and again: making it takes longer than many passes. Such a system carries
    from one episode to the next no more than it says, and is put back to what it said when it was made. All others are
    made anew.

    Examples
    --------
    >>> config = SystemConfig(id="mapek/Gridworld-v0")
    >>> with Lender() as lend:
    ...     seen = lend.look(config)
    ...     one = lend(config)
    ...     one.close()
    ...     seen is one is lend(config)
    True
    """

    def __init__(self) -> None:
        self._kept: _Lent | None = None
        self._fresh: list[_Lent] = []  # looked at, and not driven

    def look(self, config: SystemConfig) -> GymnasiumSystem:
        """Return a system to be looked at: whoever drives it asks for one, and leaves it to the lender to close this.

        Raises
        ------
        ConfigError
            There is no such environment, it refuses its options, or it is no table of states and actions.
        """
        there = self._kept
        if there is not None and not there.lent and there.config == config:
            return there
        for made in self._fresh:
            if made.config == config:
                return made
        self._fresh.append(_Lent(make_env(config), config))
        return self._fresh[-1]

    def __call__(self, config: SystemConfig) -> GymnasiumSystem:
        """Return a system that is as one freshly made, and is not lent to anybody else."""
        made = self.look(config)
        assert isinstance(made, _Lent)
        made.lent = True
        if made is not self._kept:
            self._fresh.remove(made)
            if made.again and (self._kept is None or not self._kept.lent):
                self._end()
                self._kept = made
        return made

    def _end(self) -> None:
        if self._kept is not None:
            self._kept.again = False
            self._kept.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for made in self._fresh:
            made.again = False
            made.close()
        self._end()


class _Lent(GymnasiumSystem):
    def __init__(self, env: Any, config: SystemConfig) -> None:
        super().__init__(env, config)
        self.lent = False
        self.again = self.rules is not None and (self.says_state or not hasattr(env.unwrapped, "enable_actions"))
        self._first = self.get_state() if self.again else None

    def close(self) -> None:
        self.lent = False
        if self.again:
            self.set_state(self._first)
        else:
            super().close()
