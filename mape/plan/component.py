"""The Plan component."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from knowledge import ChangePlan, ChangeRequest, Knowledge
from mape.errors import PartError
from mape.ports import Json, Planner, Schedule
from mape.specs import PartSpec
from mape.states import faults, hand_over, restore, state_of, told

_NO_ACTIONS: tuple[int, ...] = ()


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
        self.answered = False  # whether the newest plan is of the planner that is here now
        self.schedule_spec: PartSpec | None = None  # of the schedule that took the place of the config's, if one did
        self._knowledge = knowledge
        self._send = send
        self._rate: object = object()  # the last one seen, which is as a rule the next

    def start(self, loop: int) -> ChangePlan:
        """Send plan 0, which starts the run, and return it."""
        plan = self._started(loop)
        self._knowledge.plan = plan
        self.answered = True
        self._send(plan)
        return plan

    def on_request(self, request: ChangeRequest) -> None:
        """Turn a ChangeRequest into a ChangePlan.

        Raises
        ------
        PartError
            The planner raised, gave no plan, one with a value of a wrong type, or an exploration rate outside [0, 1].
        """
        try:
            plan = self.planner.plan(request, self._knowledge)
        except faults() as error:
            raise self._failed(request.pass_no, error) from error
        self._check(plan, request.pass_no)
        self._knowledge.plan = plan
        self.answered = True
        self._send(plan)

    def follow(self, plan: ChangePlan) -> None:
        """Take `plan` for sent: the planner's rule was called in its place."""
        self._knowledge.plan = plan

    def state(self) -> Json:
        """Return the planner's state, its schedule's in it: all that is carried from pass to pass.

        The plan in force stands in Knowledge.

        Raises
        ------
        PartError
            The planner does not give it.
        """
        return state_of("planner", self.planner)

    def restore(self, state: Json) -> None:
        """Go on where another Plan of the same config gave `state`.

        Raises
        ------
        PartError
            The planner does not take it.
        """
        restore("planner", self.planner, state)

    def replace(self, planner: Planner) -> bool:
        """Let `planner` answer from the next ChangeRequest on.

        It is started as at the beginning of a run, but the plan that it starts with is not put in force.

        Returns
        -------
        Whether it took over the old one's state, which it does where both give it in the same format.

        Raises
        ------
        PartError
            It does not start with a legal plan, or does not take the state; then the old one stays.
        """
        old, self.planner = self.planner, planner
        try:
            self._started(self._knowledge.log.loop)
            handed_over = hand_over("planner", old, planner)
            self.answered = False
            return handed_over
        except BaseException:
            self.planner = old
            raise

    def replace_schedule(self, schedule: Schedule) -> bool:
        """Let the planner explore by `schedule` from its next plan on.

        Returns
        -------
        Whether it took over the old one's state, which it does where both give it in the same format.

        Raises
        ------
        PartError
            The planner keeps no schedule that could be replaced, or the new one does not take the state; then the old
            one stays.
        """
        planner: Any = self.planner
        if not hasattr(planner, "schedule"):
            raise PartError(
                f"planner {type(planner).__name__} keeps no schedule in an attribute `schedule`; replace the planner "
                "as a whole (part 'plan')"
            )
        handed_over = hand_over("schedule", planner.schedule, schedule)
        planner.schedule = schedule
        return handed_over

    def _started(self, loop: int) -> ChangePlan:
        try:
            plan = self.planner.start(loop)
        except faults() as error:
            raise self._failed(0, error) from error
        self._check(plan, 0)
        return plan

    def _check(self, plan: ChangePlan, number: int) -> None:
        if type(plan) is not ChangePlan:
            raise PartError(
                f"planner {type(self.planner).__name__} returned {plan!r} at pass {number}; a planner returns a "
                "ChangePlan"
            )
        _, _, epsilon, rate, add, drop, enable, reset, adopt = plan
        if rate is not self._rate:
            rates = self._knowledge.log.layout.rates
            if not (isinstance(rate, tuple) and len(rate) == rates and all(map(_is_number, rate))):
                raise self._refused("the learning rate", rate, number, f"the learner takes {rates} numbers, in a tuple")
            self._rate = rate
        if not (_is_number(epsilon) and 0.0 <= epsilon <= 1.0):
            raise self._refused("epsilon", epsilon, number, "an exploration rate is a number in [0, 1]")
        if not (add is drop is enable is _NO_ACTIONS):  # as in all passes but a few
            for name, actions in (("add", add), ("drop", drop), ("enable", enable)):
                if not (isinstance(actions, tuple) and all(type(a) is int and a >= 0 for a in actions)):
                    raise self._refused(name, actions, number, "it is a tuple of action ids, each an int from 0")
                if len(set(actions)) != len(actions):
                    raise self._refused(name, actions, number, "it names each action once")
        if type(reset) is not bool:
            raise self._refused("reset_detector", reset, number, "it is True or False")
        if adopt is not None and not isinstance(adopt, str):
            raise self._refused("adopt", adopt, number, "it is the SHA-256 of a remembered Q-table, as text, or None")

    def _refused(self, name: str, value: Any, number: int, legal: str) -> PartError:
        return PartError(f"planner {type(self.planner).__name__} gave {name} {value!r} for pass {number}; {legal}")

    def _failed(self, number: int, error: BaseException) -> PartError:
        # Where it is named is not known here: in [plan], in a [[swap]], or in what somebody asks of a running loop.
        when = f"at pass {number}" if number else "at its start"
        return PartError(
            f"planner {type(self.planner).__name__} raised {told(error)}, {when}. Choose another planner, or mend this "
            "one and run `mapek check` on it."
        )


def _is_number(value: Any) -> bool:
    return isinstance(value, (float, int)) and not isinstance(value, bool)
