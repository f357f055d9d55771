"""The Analyze component."""

from __future__ import annotations

from collections.abc import Callable

from knowledge import ChangeRequest, Drift, Symptom
from knowledge.rows import DIRECTIONS
from mape.errors import PartError
from mape.ports import Analyzer, Json
from mape.states import faults, hand_over, restore, state_of, told
from mape.values import shown


class Analyze:
    """Asks its analyzer what changed and sends the answer.

    Parameters
    ----------
    analyzer
        The method.
    send
        Takes the ChangeRequest.
    """

    def __init__(self, analyzer: Analyzer, send: Callable[[ChangeRequest], object]) -> None:
        self.analyzer = analyzer
        self._send = send

    def on_symptom(self, symptom: Symptom) -> None:
        """Turn a Symptom into a ChangeRequest.

        Raises
        ------
        PartError
            The analyzer raised, or gave no change request, or one of what its symptom does not tell.
        """
        try:
            request = self.analyzer.analyze(symptom)
        except faults() as error:
            raise PartError(
                f"analyzer {type(self.analyzer).__name__} raised {told(error)}, at pass {symptom.pass_no}"
            ) from error
        if type(request) is not ChangeRequest:
            raise PartError(
                f"analyzer {type(self.analyzer).__name__} returned {request!r} at pass {symptom.pass_no}; an analyzer "
                "returns a ChangeRequest"
            )
        if request.drifts or request.added or request.removed:  # in few passes
            self._check_changes(request, symptom)
        self._send(request)

    def _check_changes(self, request: ChangeRequest, symptom: Symptom) -> None:
        _, _, drifts, added, removed, signals = request
        if not isinstance(drifts, tuple) or not all(
            type(drift) is Drift and drift.signal in signals and drift.direction in DIRECTIONS for drift in drifts
        ):
            raise self._refused(
                symptom,
                f"drifts = {shown(drifts)}; it is a tuple of Drift, each of one of the signals {', '.join(signals)}, "
                f"and to one of the sides {', '.join(DIRECTIONS)}",
            )
        available, known = symptom.available, symptom.known
        for name, actions, legal in (
            ("added", added, [action for action in available if action not in known]),
            ("removed", removed, [action for action in known if action not in available]),
        ):
            if not isinstance(actions, tuple) or not all(type(a) is int and a in legal for a in actions):
                raise self._refused(
                    symptom,
                    f"{name} = {shown(actions)} with {available} available and {known} known; it is a tuple of some of "
                    f"{tuple(legal)}",
                )

    def _refused(self, symptom: Symptom, why: str) -> PartError:
        return PartError(
            f"analyzer {type(self.analyzer).__name__} gave a request at pass {symptom.pass_no} that does not fit: {why}"
        )

    def state(self) -> Json:
        """Return the analyzer's state: all that is carried from pass to pass.

        Raises
        ------
        PartError
            The analyzer does not give it.
        """
        return state_of("analyzer", self.analyzer)

    def restore(self, state: Json) -> None:
        """Go on where another Analyze of the same config gave `state`.

        Raises
        ------
        PartError
            The analyzer does not take it.
        """
        restore("analyzer", self.analyzer, state)

    def replace(self, analyzer: Analyzer) -> bool:
        """Let `analyzer` answer from the next Symptom on.

        Returns
        -------
        Whether it took over the old one's state, which it does where both give it in the same format.

        Raises
        ------
        PartError
            It does not take the state; then the old one stays.
        """
        handed_over = hand_over("analyzer", self.analyzer, analyzer)
        self.analyzer = analyzer
        return handed_over
