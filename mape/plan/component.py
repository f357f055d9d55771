"""The Plan component."""

from __future__ import annotations

from collections.abc import Callable

from knowledge import ChangePlan, ChangeRequest, Knowledge
from mape.errors import PartError
from mape.ports import Planner


class Plan:
    """Asks its planner for the next plan, keeps it as the plan in force, and sends it.

    Parameters
    ----------
    planner
        The method.
    knowledge
        Given to the planner to read; its entry ``plan`` is written here.
    send
        Takes the ChangePlan.
    """

    def __init__(self, planner: Planner, knowledge: Knowledge, send: Callable[[ChangePlan], object]) -> None:
        self.planner = planner
        self._knowledge = knowledge
        self._send = send
        self._rate: tuple[float, ...] | None = None  # the last one seen, which is as a rule the next

    def start(self, loop: int) -> ChangePlan:
        """Send plan 0, which starts the run, and return it."""
        try:
            plan = self.planner.start(loop)
        except Exception as error:
            raise self._failed(0, error) from error
        self._put(plan, 0)
        return plan

    def on_request(self, request: ChangeRequest) -> None:
        """Turn a ChangeRequest into a ChangePlan.

        Raises
        ------
        PartError
            The planner raised, gave no plan, or an exploration rate outside [0, 1].
        """
        try:
            plan = self.planner.plan(request, self._knowledge)
        except Exception as error:
            raise self._failed(request.pass_no, error) from error
        self._put(plan, request.pass_no)

    def _put(self, plan: ChangePlan, number: int) -> None:
        if type(plan) is not ChangePlan:
            raise PartError(
                f"planner {type(self.planner).__name__} returned {plan!r} at pass {number}; a planner returns a "
                "ChangePlan"
            )
        rate, epsilon = plan.learning_rate, plan.epsilon
        if rate is not self._rate:
            if len(rate) != self._knowledge.log.layout.rates:
                raise PartError(
                    f"planner {type(self.planner).__name__} gave the learning rate {rate} for pass {number}; the "
                    f"learner takes {self._knowledge.log.layout.rates} numbers"
                )
            self._rate = rate
        if not (isinstance(epsilon, (float, int)) and 0.0 <= epsilon <= 1.0):
            raise PartError(
                f"planner {type(self.planner).__name__} gave epsilon {epsilon!r} for pass {number}; an "
                "exploration rate is a number in [0, 1]"
            )
        self._knowledge.plan = plan
        self._send(plan)

    def _failed(self, number: int, error: Exception) -> PartError:
        return PartError(
            f"planner {type(self.planner).__name__} raised {type(error).__name__}: {error}, at pass {number}. Choose "
            "another in [plan], or mend this one and run `mapek check` on it."
        )
