"""The Monitor component: one detector reading per watched signal and pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite

from knowledge import Observation, Reading, Symptom
from knowledge.rows import DIRECTIONS
from mape.errors import PartError
from mape.ports import Detector

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
            if (direction := getattr(detector, "direction", None)) not in DIRECTIONS:
                raise PartError(
                    f"detector {type(detector).__name__} on {name} watches the side {direction!r}; its direction is "
                    f"one of {', '.join(DIRECTIONS)}"
                )
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
                if statistic is not None and not isfinite(statistic):
                    raise ValueError(f"its statistic is {statistic!r}, not a finite number or None")
                reading = _new(Reading, (name, value, statistic, alarm, detector.direction))
                if alarm:
                    detector.reset()
            except Exception as error:
                raise self._failed(name, detector, seen, error) from error
            readings += (reading,)
        self._send(_new(Symptom, (loop, number, signals, available, known, readings)))

    @staticmethod
    def _failed(name: str, detector: Detector, seen: Observation, error: Exception) -> PartError:
        if isinstance(error, KeyError) and name not in seen.signals:
            return PartError(f"a detector watches signal {name!r}; the run has {', '.join(seen.signals)}")
        return PartError(
            f"detector {type(detector).__name__} raised {type(error).__name__}: {error}, at pass {seen.pass_no} on "
            f"{name} = {seen.signals.get(name)}. Records up to that observation are kept; choose another detector in "
            "[monitor], or mend this one and run `mapek check` on it."
        )
