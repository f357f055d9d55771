"""The one rule for episodes that the managed system breaks off: each is begun again, up to so many times."""

from __future__ import annotations

from collections.abc import Callable

from mape.errors import ManagedSystemError
from mape.execute.checkpoint import carried_by, take_up
from mape.ports import Json, ManagedSystem
from mape.states import faults, told


def _unheard(number: int, *said: str) -> None:
    """Stand where nobody listens."""


class Attempts:
    """The attempts at one episode after the other.

    Parameters
    ----------
    system
        What is driven.
    retries
        How often an episode is begun again, by another object of the system: one that has failed may stand anywhere.

    Attributes
    ----------
    retries : int, as given.
    failures : int, of the episode in hand, since as many as are allowed were allowed.
    carried : what the system carried at the end of the last episode; known where an episode may be begun again.
    on_begin : told of an attempt before anything is done, by its episode.
    on_abort : told of an attempt that was broken off, by its episode and why.
    """

    def __init__(self, system: ManagedSystem, retries: int) -> None:
        self._system = system
        self.retries = retries
        self.failures = 0
        self._before = 0, 0  # an episode, and how many attempts at it were broken off in processes before this one
        self.carried: Json = None
        self.on_begin: Callable[[int], object] = _unheard
        self.on_abort: Callable[[int, str], object] = _unheard

    def go_on_after(self, number: int, failures: int) -> None:
        """Go on where so many attempts at episode `number` were broken off in processes before this one.

        Where they were as many as are allowed, somebody has let it go on since, and as many are allowed anew.
        """
        self._before = number, failures % (self.retries + 1)

    def broken_off(self, number: int, error: ManagedSystemError) -> None:
        """Count and tell that an attempt at episode `number` was broken off.

        Raises
        ------
        ManagedSystemError
            `error`, with the rule, where the episode is not begun again.
        """
        last = self.is_last(number)
        self.failures += 1
        self.on_abort(number, str(error))
        if last:
            error.args = (f"{error} {self.rule}",)
            raise error

    def is_last(self, number: int) -> bool:
        """Whether no other attempt at episode `number` is allowed after the one that is being made."""
        episode, before = self._before
        return self.failures + (before if episode == number else 0) >= self.retries

    def begun_again(self, number: int, enabled: tuple[int, ...]) -> None:
        """Put another object of the system in the place of the one that has failed, as it was after the last episode.

        Raises
        ------
        ManagedSystemError
            It cannot be made, or does not go on from there.
        """
        try:
            self._system.renew()
        except faults() as error:
            raise ManagedSystemError(
                f"{self._system.name} raised {told(error)}, when it was to be made anew for episode {number}. The "
                f"{number - 1} passes before it stand in the log."
            ) from error
        take_up(self._system, self.carried, enabled)

    def over(self) -> None:
        """Take note that the episode is driven."""
        self.failures = 0
        if self.retries:
            self.carried = carried_by(self._system)

    @property
    def rule(self) -> str:
        """The rule, as a sentence that names the setting."""
        times = "time" if self.retries == 1 else "times"
        return (
            f"An episode that the system breaks off is begun again {self.retries} {times} at most "
            f"(system.retries = {self.retries})."
        )
