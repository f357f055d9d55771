"""The built-in analysis: every alarm is a drift of its signal, and action sets are compared.

added   = available - known        (in the order in which the system names them)
removed = known - available
"""

from __future__ import annotations

from typing import Any

from knowledge import ChangeRequest, Drift, Symptom
from mape.ports import QuietRule
from mape.specs import PartConfig

_new = tuple.__new__


class ChangesConfig(PartConfig):
    """Options of `Changes`: none."""


def nothing(state: list[float], params: tuple[float, ...], signals: Any) -> bool:
    """Say that nothing changed, where no detector alarms and the sets of actions are equal."""
    return False


class Changes:
    """Every alarm is a drift; where two detectors watch one signal, the first that alarms names the direction."""

    Config = ChangesConfig
    state_format = "changes/1"
    quiet = QuietRule(nothing, [])  # there is no state to be shared

    def __init__(self, config: ChangesConfig) -> None:
        self.config = config

    def analyze(self, symptom: Symptom) -> ChangeRequest:
        """Say what changed."""
        loop, number, signals, available, known, readings = symptom
        drifts: tuple[Drift, ...] = ()
        added: tuple[int, ...]
        removed: tuple[int, ...]
        for signal, _, _, alarm, direction in readings:
            if alarm and all(signal != drift.signal for drift in drifts):
                drifts += (Drift(signal, direction),)
        if available == known:
            added, removed = (), ()
        else:
            added = tuple(a for a in available if a not in known)
            removed = tuple(a for a in known if a not in available)
        return _new(ChangeRequest, (loop, number, drifts, added, removed, signals))

    def state(self) -> None:
        """Return None: nothing is carried from pass to pass."""

    def restore(self, state: Any) -> None:
        """Do nothing: there is no state."""
