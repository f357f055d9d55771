"""The same system for one trial after another."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Self

from adapters.systems.gymnasium_system import GymnasiumSystem, make_env
from mape.config import SystemConfig


class Lender:
    """Makes systems, and lends one again whose episodes are rules: making it takes longer than many passes.

    Such a system carries from one episode to the next no more than it says, and is put back to what it said when it
    was made. All others are made anew.

    Examples
    --------
    >>> config = SystemConfig(id="mapek/Gridworld-v0")
    >>> with Lender() as lend:
    ...     one = lend(config)
    ...     one.close()
    ...     lend(config) is one
    True
    """

    def __init__(self) -> None:
        self._kept: _Lent | None = None

    def __call__(self, config: SystemConfig) -> GymnasiumSystem:
        """Return a system that is as one freshly made, and is not lent to anybody else."""
        if self._kept is not None and not self._kept.lent and self._kept.config == config:
            self._kept.lent = True
            return self._kept
        made = _Lent(make_env(config), config)
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
        self._end()


class _Lent(GymnasiumSystem):
    def __init__(self, env: Any, config: SystemConfig) -> None:
        super().__init__(env, config)
        self.config = config
        self.lent = True
        self.again = self.rules is not None and (self.says_state or not hasattr(env.unwrapped, "enable_actions"))
        self._first = self.get_state()

    def close(self) -> None:
        self.lent = False
        if self.again:
            self.set_state(self._first)
        else:
            super().close()
