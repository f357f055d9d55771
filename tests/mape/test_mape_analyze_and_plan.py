import json
import re

import numpy as np
import pytest

from knowledge import ChangeRequest, Drift, Knowledge, Log, QTable, Reading, RowLayout, Symptom
from mape import registry
from mape.analyze import Analyze
from mape.errors import ConfigError, PartError
from mape.plan import Plan
from mape.specs import PartSpec

SIGNALS = {"return": -5.0, "steps": 5.0}


def symptom(*alarms, available=(0, 1, 2), known=(0, 1, 2)):
    readings = tuple(Reading(signal, 1.0, None, alarm, direction) for signal, alarm, direction in alarms)
    return Symptom(0, 4, SIGNALS, available, known, readings)


def analysed(given):
    return registry.build("analyzer", PartSpec(name="changes")).analyze(given)


def test_nothing_changed_is_said_with_three_empty_tuples():
    assert analysed(symptom(("return", False, "down"))) == ChangeRequest(0, 4, (), (), (), SIGNALS)


def test_every_alarm_is_a_drift_of_its_signal():
    found = analysed(symptom(("return", True, "down"), ("steps", True, "up")))
    assert found.drifts == (Drift("return", "down"), Drift("steps", "up"))


def test_of_two_alarms_on_one_signal_the_first_names_the_direction():
    found = analysed(symptom(("return", False, "down"), ("return", True, "unknown"), ("return", True, "up")))
    assert found.drifts == (Drift("return", "unknown"),)


def test_action_sets_are_compared_in_the_order_in_which_they_are_named():
    found = analysed(symptom(available=(7, 1, 5, 0), known=(0, 1, 2, 3)))
    assert (found.added, found.removed) == ((7, 5), (2, 3))


def test_the_same_actions_in_another_order_are_no_change():
    found = analysed(symptom(available=(2, 0, 1)))
    assert (found.added, found.removed) == ((), ())


def test_an_analyzer_that_raises_is_named_with_the_pass():
    class Broken:
        def analyze(self, symptom):
            raise ZeroDivisionError("oh")

    with pytest.raises(PartError, match="analyzer Broken raised ZeroDivisionError: oh, at pass 4"):
        Analyze(Broken(), print).on_symptom(symptom())


def knowledge():
    made = Knowledge(Log(RowLayout(("return", "steps"), 1, 3)))
    made.actions = (0, 1, 2)
    return made


def planner(name="morphin", schedule="exponential", **options):
    spec = PartSpec.model_validate({"name": name, **options})
    return registry.build("planner", spec, schedule=registry.build("schedule", PartSpec(name=schedule)))


def request(number, *, drift=False, added=(), removed=()):
    return ChangeRequest(0, number, (Drift("return", "down"),) if drift else (), added, removed, SIGNALS)


def asked(part, *requests, actions=(0, 1, 2)):
    shared = knowledge()
    shared.actions = actions
    return [part.plan(r, shared) for r in requests]


@pytest.mark.parametrize(("name", "rate"), [("morphin", (0.1, 0.99, 5.0)), ("q_learning", (0.1, 0.1, 0.0))])
def test_plan_0_explores_fully_and_changes_nothing(name, rate):
    plan = planner(name).start(0)
    assert plan == (0, 0, 1.0, rate, (), (), (), False, None)


def test_without_a_change_morphin_follows_its_schedule():
    part = planner()
    assert [round(p.epsilon, 6) for p in asked(part, *(request(n) for n in range(1, 11)))][::9] == [0.956106, 0.645878]


def test_a_drift_resets_exploration_and_asks_for_no_detector_reset():
    part = planner()
    plans = asked(part, request(1), request(2), request(3, drift=True), request(4))
    assert [round(p.epsilon, 6) for p in plans] == [0.956106, 0.914354, 1.0, 0.956106]
    assert [p.reset_detector for p in plans] == [False] * 4


def test_a_new_action_gets_a_row_resets_exploration_and_asks_for_a_detector_reset():
    plans = asked(planner(), request(1), request(2, added=(7, 5)), request(3))
    assert plans[1].add == (7, 5)
    assert [p.epsilon == 1.0 for p in plans] == [False, True, False]
    assert [p.reset_detector for p in plans] == [False, True, False]


def test_a_removed_action_is_dropped_and_exploration_goes_on():
    plans = asked(planner(), request(1), request(2, removed=(1,)))
    assert (plans[1].drop, plans[1].reset_detector) == ((1,), False)
    assert plans[1].epsilon < plans[0].epsilon


def test_respond_to_names_the_changes_that_reset_exploration():
    everything = (
        request(1),
        request(2, drift=True),
        request(3),
        request(4, added=(7,)),
        request(5),
        request(6, removed=(1,)),
    )
    for respond_to, resets, detector in (
        ([], [], []),
        (["drift"], [2], []),
        (["added"], [4], [4]),
        (["removed"], [6], [6]),
        (["drift", "added", "removed"], [2, 4, 6], [4, 6]),
    ):
        plans = asked(planner(respond_to=respond_to), *everything)
        assert [p.pass_no for p in plans if p.epsilon == 1.0] == resets, respond_to
        assert [p.pass_no for p in plans if p.reset_detector] == detector, respond_to
        assert (plans[3].add, plans[5].drop) == ((7,), (1,))


def test_reserve_actions_are_enabled_once_on_the_first_drift():
    plans = asked(
        planner(enable_on_drift=[3, 4]), request(1), request(2, drift=True), request(3, drift=True), request(4)
    )
    assert [p.enable for p in plans] == [(), (3, 4), (), ()]
    assert [p.add for p in plans] == [(), (3, 4), (), ()]


def test_a_new_action_alone_enables_no_reserve():
    plans = asked(planner(enable_on_drift=[3, 4]), request(1, added=(9,)), request(2, drift=True))
    assert [p.enable for p in plans] == [(), (3, 4)]


def test_an_enabled_action_that_has_a_row_already_gets_no_second_one():
    part = planner(enable_on_drift=[2, 3, 4])
    asked_for = asked(part, request(1, drift=True, added=(4,)))[0].add
    assert asked_for == (4, 2, 3)
    table = QTable((0, 1, 2), n_states=1)
    table.add(asked_for)
    assert table.actions == (0, 1, 2, 4, 3)


def test_q_learning_never_responds_and_yet_follows_the_action_set():
    everything = [request(n, drift=n % 2 == 0, added=(n,) * (n == 5), removed=(1,) * (n == 6)) for n in range(1, 9)]
    plans, quiet = (
        asked(planner("q_learning"), *everything),
        asked(planner("q_learning"), *(request(n) for n in range(1, 9))),
    )
    assert [p.epsilon for p in plans] == [p.epsilon for p in quiet]
    assert {p.learning_rate for p in plans} == {(0.1, 0.1, 0.0)}
    assert not any(p.reset_detector or p.enable or p.adopt for p in plans)
    assert (plans[4].add, plans[5].drop) == ((5,), (1,))


@pytest.mark.parametrize("name", ["morphin", "q_learning"])
def test_a_planner_takes_up_where_its_state_was_given(name):
    options = {"enable_on_drift": [3]} if name == "morphin" else {}
    requests = [request(n, drift=n in (3, 8)) for n in range(1, 12)]
    for cut in range(12):
        original, heir = (planner(name, "success", **options) for _ in range(2))
        asked(original, *requests[:cut])
        heir.restore(json.loads(json.dumps(original.state())))
        assert asked(heir, *requests[cut:]) == asked(original, *requests[cut:])


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"alpha": 0.5, "alpha_max": 0.4}, "alpha_max = 0.4 is below alpha = 0.5"),
        ({"enable_on_drift": [3, 3]}, "must be distinct action ids"),
        ({"enable_on_drift": [-1]}, "must be distinct action ids"),
        ({"respond_to": ["drit"]}, "drift, added, removed"),
        ({"alpha": 0.0}, "greater than 0"),
        ({"k": 701.0}, "less than or equal to 700"),
    ],
)
def test_options_that_make_no_sense_are_refused_with_the_reason(options, reason):
    with pytest.raises(ConfigError, match=reason):
        planner(**options)


class Fixed:
    """A planner of one plan."""

    def __init__(self, plan):
        self._plan = plan

    def start(self, loop):
        return self._plan

    def plan(self, request, knowledge):
        if self._plan is None:
            raise ZeroDivisionError("oh")
        return self._plan


def test_plan_keeps_the_plan_in_force_in_knowledge_and_sends_it():
    sent, shared = [], knowledge()
    component = Plan(planner(), shared, sent.append)
    component.start(0)
    component.on_request(request(1))
    assert [p.pass_no for p in sent] == [0, 1]
    assert shared.plan is sent[1]


@pytest.mark.parametrize("epsilon", [-0.1, 1.1, float("nan")])
def test_an_exploration_rate_outside_0_to_1_is_the_planners_fault(epsilon):
    sent, shared = [], knowledge()
    part = Fixed(planner().start(0)._replace(epsilon=epsilon))
    with pytest.raises(PartError, match=r"planner Fixed gave epsilon .* a number in \[0, 1\]"):
        Plan(part, shared, sent.append).on_request(request(1))
    assert (sent, shared.plan) == ([], None)


@pytest.mark.parametrize(
    ("field", "value", "legal"),
    [
        ("add", [7], "a tuple of action ids, each an int"),
        ("add", (np.int64(7),), "a tuple of action ids, each an int"),
        ("drop", None, "a tuple of action ids, each an int"),
        ("enable", (True,), "a tuple of action ids, each an int"),
        ("learning_rate", None, "the learner takes 3 numbers, in a tuple"),
        ("learning_rate", [0.1, 0.1, 0.0], "the learner takes 3 numbers, in a tuple"),
        ("learning_rate", (0.1, None, 0.0), "the learner takes 3 numbers, in a tuple"),
        ("reset_detector", None, "True or False"),
        ("adopt", 12, "the SHA-256 of a remembered Q-table, as text, or None"),
    ],
)
def test_a_value_of_another_type_in_a_plan_is_the_planners_fault(field, value, legal):
    sent, shared = [], knowledge()
    part = Fixed(planner().start(0)._replace(**{field: value}))
    named = field.replace("learning_rate", "the learning rate")
    said = re.escape(f"planner Fixed gave {named} {value!r} for pass 6;") + f".*{legal}"
    with pytest.raises(PartError, match=said):
        Plan(part, shared, sent.append).on_request(request(6))
    assert (sent, shared.plan) == ([], None)


def test_a_planner_that_raises_is_named_with_the_pass():
    with pytest.raises(PartError, match="planner Fixed raised ZeroDivisionError: oh, at pass 6"):
        Plan(Fixed(None), knowledge(), print).on_request(request(6))
