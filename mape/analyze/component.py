"""The Analyze component."""

from __future__ import annotations

from collections.abc import Callable

from knowledge import ChangeRequest, Symptom
from mape.errors import PartError
from mape.ports import Analyzer


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
            The analyzer raised, or gave no change request.
        """
        try:
            request = self.analyzer.analyze(symptom)
        except Exception as error:
            raise PartError(
                f"analyzer {type(self.analyzer).__name__} raised {type(error).__name__}: {error}, at pass "
                f"{symptom.pass_no}"
            ) from error
        if type(request) is not ChangeRequest:
            raise PartError(
                f"analyzer {type(self.analyzer).__name__} returned {request!r} at pass {symptom.pass_no}; an analyzer "
                "returns a ChangeRequest"
            )
        self._send(request)
