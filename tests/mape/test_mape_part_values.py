"""What a part returns outside of its contract is refused by its value, with the part's name and the pass."""

import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from mape_runs import corridor_loop

from knowledge import ChangeRequest, Drift
from mape.analyze.changes import Changes
from mape.errors import MapekError, NonFiniteError, PartError
from mape.execute.rules import LearnerConfig, QLearning
from mape.monitor.page_hinkley import PageHinkley, PageHinkleyConfig
from mape.plan.exponential import Exponential, ExponentialConfig
from mape.plan.morphin import Morphin, MorphinConfig
from mape.testing import check_analyzer, check_detector, check_learner, check_planner, check_schedule


def run_with(monkeypatch, kind, made, passes=3):
    """Run with a part of one's own, which `made` gives: in place of one of the config's."""
    monkeypatch.setitem(sys.modules, "parts_of_ones_own", SimpleNamespace(Own=made))
    name = "parts_of_ones_own:Own"
    over = {
        "detector": {"monitor": {"detectors": [{"name": name}]}},
        "analyzer": {"analyze": {"name": name}},
        "planner": {"plan": {"name": name}},
        "schedule": {"plan": {"name": "morphin", "schedule": {"name": name}}},
        "learner": {"learner": {"name": name}},
    }[kind]
    loop = corridor_loop(**over)
    loop.run(passes)
    return loop


def refused(monkeypatch, kind, made):
    with pytest.raises(MapekError) as error:
        run_with(monkeypatch, kind, made)
    assert isinstance(error.value, (PartError, NonFiniteError))
    return str(error.value)


def detecting(**members):
    class Own(PageHinkley):
        Config = None

        def __init__(self):
            super().__init__(PageHinkleyConfig())

        locals().update(members)

    return Own


ALARMS = [None, 1, 0, 0.5, math.nan, "yes", np.array([True]), np.float64(1.0), []]


@pytest.mark.parametrize("alarm", ALARMS, ids=repr)
def test_an_alarm_is_a_truth_value_and_nothing_that_stands_for_one(monkeypatch, alarm):
    own = detecting(update=lambda self, x: alarm)
    said = refused(monkeypatch, "detector", own)
    assert [part for part in ("detector Own", "True or False", "pass 1") if part not in said] == []
    assert {f.verdict for f in check_detector(own)} >= {"failed"}


def test_an_alarm_of_numpys_is_one(monkeypatch):
    loop = run_with(monkeypatch, "detector", detecting(update=lambda self, x: np.bool_(True)))
    (reading,) = loop.log.window[0].symptom.readings
    assert reading.alarm is True


@pytest.mark.parametrize(
    "statistic", ["3.0", np.array([1.0]), 1j, math.inf, 10**400, []], ids=lambda value: repr(value)[:9]
)
def test_a_statistic_is_one_finite_number_or_none(monkeypatch, statistic):
    said = refused(monkeypatch, "detector", detecting(statistic=statistic))
    assert [part for part in ("detector Own", "finite number or None", "pass 1") if part not in said] == []


@pytest.mark.parametrize("statistic", [3, np.float32(0.5), np.int64(7), np.array(2.0)], ids=repr)
def test_a_statistic_of_any_library_is_the_number_that_it_is(monkeypatch, statistic):
    loop = run_with(monkeypatch, "detector", detecting(statistic=statistic))
    (reading,) = loop.log.window[0].symptom.readings
    assert (type(reading.statistic), reading.statistic) == (float, float(statistic))


def test_a_side_that_a_detector_only_later_forgets_is_refused_where_it_does(monkeypatch):
    def update(self, x):
        self.direction = "sideways"
        return False

    said = refused(monkeypatch, "detector", detecting(update=update))
    assert [part for part in ("'sideways'", "down, up, unknown", "pass 1") if part not in said] == []


def analyzing(**fields):
    class Own(Changes):
        def analyze(self, symptom):
            return super().analyze(symptom)._replace(**fields)

    return Own


REQUESTS = [
    ({"added": (7,)}, "(7,)"),
    ({"added": [1]}, "[1]"),
    ({"added": (0,)}, "(0,)"),
    ({"removed": (0,)}, "(0,)"),
    ({"removed": (1.0,)}, "(1.0,)"),
    ({"removed": "01"}, "'01'"),
    ({"drifts": ("return",)}, "('return',)"),
    ({"drifts": [Drift("return", "down")]}, "[Drift("),
    ({"drifts": (Drift("load", "down"),)}, "'load'"),
    ({"drifts": (Drift("return", "sideways"),)}, "'sideways'"),
]


@pytest.mark.parametrize(("fields", "says"), REQUESTS, ids=lambda value: str(value)[:30])
def test_a_request_asks_for_what_its_symptom_tells(monkeypatch, fields, says):
    said = refused(monkeypatch, "analyzer", analyzing(**fields))
    assert [part for part in ("analyzer Own", says, "pass 1") if part not in said] == []
    assert {f.verdict for f in check_analyzer(analyzing(**fields))} >= {"failed"}


def planning(**fields):
    class Own(Morphin):
        Config = None

        def __init__(self, schedule):
            super().__init__(MorphinConfig(), schedule)

        def plan(self, request, knowledge):
            return super().plan(request, knowledge)._replace(**fields)

    return Own


PLANS = [
    ({"epsilon": 1.5}, "1.5"),
    ({"epsilon": -0.1}, "-0.1"),
    ({"epsilon": True}, "True"),
    ({"epsilon": "0.5"}, "'0.5'"),
    ({"epsilon": math.nan}, "nan"),
    ({"epsilon": np.array([0.5])}, "0.5"),
    ({"learning_rate": (0.1, True, 5.0)}, "True"),
    ({"learning_rate": ("0.1", 0.9, 5.0)}, "'0.1'"),
    ({"learning_rate": (0.1, 0.9, 1j)}, "1j"),
    ({"add": (-1,)}, "(-1,)"),
    ({"add": (3, 3)}, "(3, 3)"),
    ({"add": (3.0,)}, "(3.0,)"),
    ({"drop": (True,)}, "(True,)"),
    ({"enable": "3"}, "'3'"),
    ({"reset_detector": 1}, "1"),
    ({"reset_detector": None}, "None"),
    ({"adopt": b"ab"}, "b'ab'"),
]


@pytest.mark.parametrize(("fields", "says"), PLANS, ids=str)
def test_a_plan_holds_what_its_fields_say(monkeypatch, fields, says):
    said = refused(monkeypatch, "planner", planning(**fields))
    name = "the learning rate" if "learning_rate" in fields else next(iter(fields))
    assert [part for part in ("planner Own", name, says, "pass 1") if part not in said] == []
    made = planning(**fields)
    assert {f.verdict for f in check_planner(lambda: made(Exponential(ExponentialConfig())))} >= {"failed"}


@pytest.mark.parametrize("epsilon", [1.01, -1e-9, True, "1", None, math.inf, 0.5j], ids=repr)
def test_a_schedules_epsilon_is_a_rate(monkeypatch, epsilon):
    class Own(Exponential):
        Config = None

        def __init__(self):
            super().__init__(ExponentialConfig())

        @property
        def epsilon(self):
            return epsilon

    said = refused(monkeypatch, "schedule", Own)
    assert [part for part in (repr(epsilon), "[0, 1]") if part not in said] == []
    assert {f.verdict for f in check_schedule(Own)} >= {"failed"}


def learning(**rules):
    class Own(QLearning):
        Config = None

        def __init__(self):
            super().__init__(LearnerConfig())

        locals().update({name: staticmethod(rule) for name, rule in rules.items()})

    return Own


def raises(*numbers):
    raise ZeroDivisionError("no rate")


@pytest.mark.parametrize("name", ["value", "step_size"])
@pytest.mark.parametrize(
    ("gives", "says"),
    [(None, "None"), ("1.0", "'1.0'"), (1j, "1j"), (np.array([1.0]), "[1.0]"), ([0.5], "[0.5]")],
    ids=repr,
)
def test_a_learners_rule_gives_one_number_and_what_it_does_is_not_told_as_the_systems(monkeypatch, name, gives, says):
    said = refused(monkeypatch, "learner", learning(**{name: lambda *numbers: gives}))
    expected = (f"{name} of learner Own", says, "one real number", "episode 1 at step 1", "0 passes before")
    assert [part for part in expected if part not in said] == []
    assert "corridor" not in said
    assert {f.verdict for f in check_learner(learning(**{name: lambda *numbers: gives}))} >= {"failed"}


@pytest.mark.parametrize("name", ["value", "step_size"])
def test_what_a_learners_rule_raises_is_told_as_the_learners(monkeypatch, name):
    said = refused(monkeypatch, "learner", learning(**{name: raises}))
    expected = (f"{name} of learner Own raised ZeroDivisionError: no rate", "episode 1 at step 1")
    assert [part for part in expected if part not in said] == []
    assert "corridor" not in said


@pytest.mark.parametrize("size", [math.nan, math.inf])
def test_a_step_size_that_is_no_number_is_told_with_the_action_whose_value_it_spoils(monkeypatch, size):
    said = refused(monkeypatch, "learner", learning(step_size=lambda td_error, rate: size))
    assert [part for part in ("Q-value of action", "episode 1 at step 1", "step size") if part not in said] == []


def test_requests_of_what_the_symptom_tells_pass(monkeypatch):
    class Own(Changes):
        def analyze(self, symptom):
            return ChangeRequest(symptom.loop, symptom.pass_no, (Drift("td_error", "up"),), (), (), symptom.signals)

    loop = run_with(monkeypatch, "analyzer", Own)
    assert [passed.request.drifts for passed in loop.log.window] == [(Drift("td_error", "up"),)] * 3
