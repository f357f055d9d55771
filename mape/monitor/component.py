"""The Monitor component: one detector reading per watched signal and pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from typing import Any

import numpy as np

from knowledge import Observation, Reading, Symptom
from knowledge.rows import DIRECTIONS
from mape.errors import PartError
from mape.ports import Detector, Json
from mape.states import faults, hand_over, restore, state_of, told
from mape.values import number, shown

_new = tuple.__new__  # half the cost of a named tuple's own constructor, on the hot path


class Monitor:
    """Feeds each detector its signal and says what it reads.

    A detector that alarms is reset at once. A reset that Plan wants comes back with the next Observation, and is done
    before that observation is fed.

    Parameters
    ----------
    detectors
        Pairs of a signal's name and the detector that watches it.
    send
        Takes the Symptom.
    """

    def __init__(self, detectors: Sequence[tuple[str, Detector]], send: Callable[[Symptom], object]) -> None:
        self.detectors = tuple(detectors)
        for name, detector in self.detectors:
            self._check(name, detector)
        self._send = send

    def on_observation(self, seen: Observation) -> None:
        """Turn an Observation into a Symptom.

        Raises
        ------
        PartError
            A detector raised, or watches a signal that the run does not have.
        """
        loop, number, _, _, reset, _, available, known, signals = seen
        readings: tuple[Reading, ...] = ()
        for name, detector in self.detectors:
            try:
                if reset:
                    detector.reset()
                value = signals[name]
                alarm, statistic = detector.update(value), detector.statistic
                if type(alarm) is not bool:
                    alarm = _alarm(alarm)
                if statistic is not None and (type(statistic) is not float or not isfinite(statistic)):
                    statistic = _statistic(statistic)
                if (direction := detector.direction) not in DIRECTIONS:
                    raise ValueError(f"its direction is {direction!r}, none of {', '.join(DIRECTIONS)}")
                reading = _new(Reading, (name, value, statistic, alarm, direction))
                if alarm:
                    detector.reset()
            except faults() as error:
                raise self._failed(name, detector, seen, error) from error
            readings += (reading,)
        self._send(_new(Symptom, (loop, number, signals, available, known, readings)))

    def state(self) -> Json:
        """Return the states of the detectors, in their order: all that is carried from pass to pass.

        Raises
        ------
        PartError
            A detector does not give its state.
        """
        return [state_of("detector", detector) for _, detector in self.detectors]

    def restore(self, state: Json) -> None:
        """Go on where another Monitor of the same config gave `state`.

        Raises
        ------
        PartError
            It is of another number of detectors, or one of them does not take its state.
        """
        if not isinstance(state, list) or len(state) != len(self.detectors):
            raise PartError(f"Monitor cannot go on from {state!r}; give a state for each of {len(self.detectors)}")
        for (_, detector), one in zip(self.detectors, state, strict=True):
            restore("detector", detector, one)

    def replace(self, place: int, signal: str, detector: Detector) -> bool:
        """Let `detector` watch `signal` in the place of the detector number `place`, from the next Observation on.

        Returns
        -------
        Whether it took over the old one's state, which it does where it watches the same signal and both give their
        state in the same format.

        Raises
        ------
        PartError
            It watches no side, or does not take the state; then the old one stays.
        """
        self._check(signal, detector)
        watched, old = self.detectors[place]
        handed_over = watched == signal and hand_over("detector", old, detector)
        self.detectors = (*self.detectors[:place], (signal, detector), *self.detectors[place + 1 :])
        return handed_over

    @staticmethod
    def _check(name: str, detector: Detector) -> None:
        if (direction := getattr(detector, "direction", None)) not in DIRECTIONS:
            raise PartError(
                f"detector {type(detector).__name__} on {name} watches the side {direction!r}; its direction is "
                f"one of {', '.join(DIRECTIONS)}"
            )

    @staticmethod
    def _failed(name: str, detector: Detector, seen: Observation, error: BaseException) -> PartError:
        if isinstance(error, KeyError) and name not in seen.signals:
            return PartError(f"a detector watches signal {name!r}; the run has {', '.join(seen.signals)}")
        return PartError(
            f"detector {type(detector).__name__} raised {told(error)}, at pass {seen.pass_no} on {name} = "
            f"{seen.signals.get(name)}. Records up to that observation are kept; choose another detector, "
            "or mend this one and run `mapek check` on it."
        )


def _alarm(given: Any) -> bool:
    """Return NumPy's truth values as Python's.

    Raises
    ------
    TypeError
        It is something else, such as None or a statistic.
    """
    if isinstance(given, np.bool_):
        return bool(given)
    raise TypeError(f"its update returned {shown(given)}, where an alarm is True or False")


def _statistic(given: Any) -> float:
    """Return a finite number as a float.

    Raises
    ------
    ValueError
        It is none.
    """
    statistic = number(given)
    if statistic is None or not isfinite(statistic):
        raise ValueError(f"its statistic is {shown(given)}, not a finite number or None")
    return statistic
