"""The conformance checks find each fault in a part that has just that one, and none in parts that have none."""

import itertools
import random

import faulty_rules
import numpy as np
import pytest
from faulty_parts import MEMBERS, faults, hinkley, planned, planning, scheduled, variant, without

from knowledge import Drift
from mape import registry
from mape.analyze.changes import Changes, ChangesConfig
from mape.errors import PartError
from mape.execute.rules import LearnerConfig, QLearning, expected_value
from mape.monitor.page_hinkley import PageHinkley, PageHinkleyConfig
from mape.monitor.two_window import TwoWindow, TwoWindowConfig
from mape.plan.exponential import Exponential, ExponentialConfig
from mape.plan.morphin import Morphin, MorphinConfig
from mape.specs import PartSpec
from mape.testing import (
    CHECKS,
    Finding,
    check_analyzer,
    check_detector,
    check_learner,
    check_planner,
    check_schedule,
    require,
)

DETERMINISTIC = "is deterministic: two fresh ones agree, step by step"
PLAIN = "gives its state as plain JSON, and as a copy"
TAKES_UP = "takes up where its state was given, fresh or used"


def built(kind, name):
    extra = {"schedule": registry.build("schedule", PartSpec(name="success"))} if kind == "planner" else {}
    return registry.build(kind, PartSpec(name=name), **extra)


BUILT_IN = [
    (kind, name)
    for kind, parts in registry.PARTS.items()
    for name, entry in parts.items()
    if entry.target.startswith("mape.")
]


@pytest.mark.parametrize(("kind", "name"), BUILT_IN)
def test_every_part_that_is_built_in_keeps_every_clause(kind, name):
    findings = CHECKS[kind](lambda: built(kind, name))
    assert {finding.verdict for finding in findings} == {"ok"}
    require(findings)


def test_there_is_a_check_for_every_kind_of_part():
    assert set(CHECKS) == {*registry.PARTS, "system"}


def windowed(**members):
    return variant(TwoWindow, TwoWindowConfig(reference=20, recent=5), **members)


def keeps_its_minimum(self):
    self._state[:3] = (0.0,) * 3


def restores_half(self, state):
    self._state[:2] = state["n"], state["mean"]


NUMBERS = itertools.count()


@pytest.mark.parametrize(
    ("make", "check", "says"),
    [
        (without(PageHinkley, PageHinkleyConfig(), member="statistic"), MEMBERS, "has no statistic"),
        (hinkley(reset=3), MEMBERS, "reset is 3, not a method"),
        (
            hinkley(update=lambda self, x: np.bool_(PageHinkley.update(self, x))),
            "gives plain readings: a bool, and a finite statistic or None",
            "a bool; return bool",
        ),
        (
            hinkley(update=lambda self, x: None),
            "gives plain readings: a bool, and a finite statistic or None",
            "returned None, a NoneType",
        ),
        (
            hinkley(statistic=float("nan")),
            "gives plain readings: a bool, and a finite statistic or None",
            "statistic is nan",
        ),
        (
            hinkley(statistic="high"),
            "gives plain readings: a bool, and a finite statistic or None",
            "statistic is 'high'",
        ),
        (
            hinkley(direction="sideways"),
            "gives plain readings: a bool, and a finite statistic or None",
            "one of down, up, unknown",
        ),
        (
            hinkley(statistic=property(lambda self: random.random())),
            DETERMINISTIC,
            "at step 0 two fresh ones give",
        ),
        (hinkley(statistic=property(lambda self: next(NUMBERS))), DETERMINISTIC, "share nothing between objects"),
        (hinkley(state=lambda self: (self._state[0],)), PLAIN, "comes back from JSON as something else"),
        (hinkley(state=lambda self: {1: self._state[0]}), PLAIN, "text as keys"),
        (hinkley(state=lambda self: {"n": float("nan")}), PLAIN, "is no plain JSON"),
        (hinkley(state=lambda self: self), PLAIN, "is no plain JSON"),
        (hinkley(state=vars), PLAIN, "is no plain JSON"),
        (
            windowed(
                update=lambda self, x: self.__dict__.setdefault("kept", []).append(x) or TwoWindow.update(self, x),
                state=lambda self: {"values": self.__dict__.setdefault("kept", []), "z": TwoWindow.state(self)["z"]},
            ),
            PLAIN,
            "state() returns a copy",
        ),
        (hinkley(restore=lambda self, state: None), TAKES_UP, "restored before step"),
        (hinkley(restore=restores_half), TAKES_UP, "restore() sets all of it"),
        (
            windowed(restore=lambda self, state: [self.update(value) for value in state["values"]] and None),
            TAKES_UP,
            "a used one restored before step",
        ),
        (
            hinkley(reset=lambda self: None),
            "forgets on reset the values that it has seen",
            "reset() sets all that update() writes",
        ),
        (hinkley(reset=keeps_its_minimum), "forgets on reset the values that it has seen", "different values before"),
        (
            windowed(
                reset=lambda self: (
                    self._state.__setitem__(1, self._state[1] - 1) if self._state[1] else TwoWindow.reset(self)
                )
            ),
            "forgets on reset the values that it has seen",
            "after it",
        ),
        (
            hinkley(update=lambda self, x: 1 / 0),
            "gives plain readings: a bool, and a finite statistic or None",
            "ZeroDivisionError was raised",
        ),
    ],
)
def test_a_detector_with_a_fault_is_told_its_fault(make, check, says):
    assert says in faults(check_detector(make))[check]


def test_a_detector_for_zeros_and_ones_is_checked_on_such_a_stream():
    def update(self, x):
        if x not in (0.0, 1.0):
            raise ValueError("not 0 or 1")
        return PageHinkley.update(self, x)

    make = hinkley(update=update)
    assert "ValueError was raised: not 0 or 1" in str(faults(check_detector(make)))
    assert faults(check_detector(make, [float(i % 3 == 0) for i in range(60)])) == {}


def changes(analyze):
    return variant(Changes, ChangesConfig(), analyze=analyze)


def requested(**fields):
    def analyze(self, symptom):
        return Changes.analyze(self, symptom)._replace(**{n: f(symptom) for n, f in fields.items()})

    return changes(analyze)


FITS = "gives change requests that fit their symptom"


@pytest.mark.parametrize(
    ("make", "check", "says"),
    [
        (without(Changes, ChangesConfig(), member="analyze"), MEMBERS, "has no analyze()"),
        (changes(lambda self, symptom: None), FITS, "return a knowledge.ChangeRequest"),
        (requested(pass_no=lambda s: s.pass_no + 1), FITS, "does not hand on loop, pass and signals"),
        (requested(signals=lambda s: {}), FITS, "does not hand on loop, pass and signals"),
        (requested(drifts=lambda s: (Drift("noise", "up"),)), FITS, "name each signal of the run at most once"),
        (requested(drifts=lambda s: (Drift("return", "up"),) * 2), FITS, "name each signal of the run at most once"),
        (requested(drifts=lambda s: ("return",)), FITS, "as knowledge.Drift"),
        (requested(drifts=lambda s: (Drift("return", "sideways"),)), FITS, "cannot be sent"),
        (requested(added=lambda s: s.available), FITS, "added is available and not known"),
        (requested(removed=lambda s: s.known), FITS, "removed is known and not available"),
        (requested(added=lambda s: [a for a in s.available if a not in s.known]), FITS, "arrives as"),
        (requested(drifts=lambda s: random.choice([(), (Drift("return", "up"),)])), DETERMINISTIC, "two fresh ones"),
        (
            changes(
                lambda self, s: Changes.analyze(self, s)._replace(
                    drifts=(Drift("return", "up"),)
                    * (self.__dict__.setdefault("n", itertools.count()).__next__() % 5 == 0)
                )
            ),
            TAKES_UP,
            "restored before step",
        ),
    ],
)
def test_an_analyzer_with_a_fault_is_told_its_fault(make, check, says):
    assert says in faults(check_analyzer(make))[check]


@pytest.mark.parametrize(
    ("make", "check", "says"),
    [
        (without(Exponential, ExponentialConfig(), member="advance"), MEMBERS, "has no advance()"),
        (scheduled(epsilon=1.5), "keeps epsilon in [0, 1]", "epsilon is 1.5"),
        (scheduled(epsilon=None), "keeps epsilon in [0, 1]", "epsilon is None"),
        (
            scheduled(epsilon=property(lambda self: 1.0 - 0.1 * self._state[0])),
            "keeps epsilon in [0, 1]",
            "a number in [0, 1]",
        ),
        (scheduled(epsilon=property(lambda self: random.random())), DETERMINISTIC, "when it is read again"),
        (scheduled(state=lambda self: self._state[0] and float("inf")), PLAIN, "is no plain JSON"),
        (scheduled(restore=lambda self, state: None), TAKES_UP, "restored before step"),
        (
            scheduled(
                advance=lambda self, r: self._state.__setitem__(0, self._state[0] + (r > 0)), reset=lambda self: None
            ),
            "starts anew on reset, whatever the returns before it",
            "reset() forgets what was counted",
        ),
    ],
)
def test_a_schedule_with_a_fault_is_told_its_fault(make, check, says):
    assert says in faults(check_schedule(make))[check]


def forgets_the_reserve(self, state):
    self.schedule.restore(state["schedule"])


EXECUTABLE = "gives plans that can be executed, with epsilon in [0, 1]"


@pytest.mark.parametrize(
    ("make", "check", "says"),
    [
        (
            without(Morphin, MorphinConfig(), Exponential(ExponentialConfig()), member="start"),
            MEMBERS,
            "has no start()",
        ),
        (planning(start=lambda self, loop: None), EXECUTABLE, "return a knowledge.ChangePlan"),
        (planning(start=lambda self, loop: Morphin.start(self, 0)), EXECUTABLE, "says loop 0, pass 0; hand them on"),
        (planning(plan=lambda self, request, knowledge: request), EXECUTABLE, "return a knowledge.ChangePlan"),
        (planned(pass_no=lambda r, k: 0), EXECUTABLE, "hand them on"),
        (planned(epsilon=lambda r, k: -0.1), EXECUTABLE, "epsilon is -0.1"),
        (planned(epsilon=lambda r, k: float("nan")), EXECUTABLE, "epsilon is nan"),
        (planned(learning_rate=lambda r, k: (0.1,)), EXECUTABLE, "cannot be executed"),
        (planned(learning_rate=lambda r, k: (0.1, float("inf"), 5.0)), EXECUTABLE, "cannot be sent"),
        (planned(learning_rate=lambda r, k: [0.1, 0.9, 5.0]), EXECUTABLE, "arrives as"),
        (planned(add=lambda r, k: (-1,)), EXECUTABLE, "cannot be executed"),
        (planned(drop=lambda r, k: (77,)), EXECUTABLE, "drops [77], which have no row"),
        (planned(adopt=lambda r, k: "0" * 64), EXECUTABLE, "cannot be executed: no Q-table"),
        (planned(epsilon=lambda r, k: random.random()), DETERMINISTIC, "two fresh ones"),
        (planning(state=lambda self: {"schedule": {}, "to_enable": self._to_enable}), PLAIN, "comes back from JSON"),
        (planning(restore=forgets_the_reserve), TAKES_UP, "restored before step"),
    ],
)
def test_a_planner_with_a_fault_is_told_its_fault(make, check, says):
    assert says in faults(check_planner(make))[check]


def test_a_planner_may_remember_tables_and_adopt_them():
    def plan(self, request, knowledge):
        made = Morphin.plan(self, request, knowledge)
        key = knowledge.remember(knowledge.q_table())
        return made._replace(adopt=key) if request.drifts else made

    assert faults(check_planner(planning(plan=plan))) == {}


def learning(**members):
    return variant(QLearning, LearnerConfig(discount=0.9, bootstrap_terminal=False), **members)


NAMES = "names its learning-rate parameters, a discount and bootstrap_terminal"
PURE = "has pure rules with finite results"
SAME_BITS = "gives the same bits compiled as in plain Python"


def sealed(**members):
    """A learner whose constants are the class's, whatever its config says."""
    base = type("Sealed", (), {"rate_names": ("a", "b", "c"), "discount": 0.9, "bootstrap_terminal": False})
    rules = {"value": staticmethod(expected_value), "step_size": QLearning.__dict__["step_size"]}
    return type("Sealed", (base,), rules | members)


@pytest.mark.parametrize(
    ("make", "check", "says"),
    [
        (sealed(value=None), MEMBERS, "value is None, not a method"),
        (sealed(rate_names=["a"]), NAMES, "rate_names is ['a']"),
        (sealed(rate_names=()), NAMES, "rate_names is ()"),
        (sealed(discount=1.5), NAMES, "discount is 1.5"),
        (sealed(bootstrap_terminal=1), NAMES, "bootstrap_terminal is 1"),
        (learning(value=staticmethod(faulty_rules.writes_q)), PURE, "a rule wrote into q"),
        (learning(value=staticmethod(faulty_rules.infinite)), PURE, "value gave inf"),
        (learning(step_size=staticmethod(faulty_rules.counts)), PURE, "the same numbers gave two results"),
        (
            learning(value=staticmethod(lambda q, rows, count, state, best, epsilon: 0.5)),
            SAME_BITS,
            "cannot be compiled",
        ),
        (learning(step_size=staticmethod(faulty_rules.no_rule_of_numbers)), SAME_BITS, "cannot be compiled by Numba"),
        (learning(value=staticmethod(faulty_rules.overflows)), SAME_BITS, "value gives 1.44e+20 in Python and -3.57"),
    ],
)
def test_a_learner_with_a_fault_is_told_its_fault(make, check, says):
    assert says in faults(check_learner(make))[check]


def test_a_maker_that_fails_is_one_finding():
    (finding,) = check_detector(lambda: 1 / 0)
    assert finding == Finding(MEMBERS, "failed", "ZeroDivisionError was raised: division by zero")


def test_a_finding_reads_as_one_line():
    assert str(Finding("keeps epsilon in [0, 1]", "ok")) == "ok      keeps epsilon in [0, 1]"
    assert str(Finding("a", "failed", "b")) == "failed  a: b"


def test_require_raises_with_all_that_failed_and_with_nothing_else():
    findings = [
        Finding("one", "failed", "x"),
        Finding("two", "ok"),
        Finding("three", "note", "y"),
        Finding("four", "failed", "z"),
    ]
    with pytest.raises(PartError, match=r"^failed  one: x\nfailed  four: z$"):
        require(findings)
    require(findings[1:3])


def test_the_planner_check_follows_the_plans_that_it_is_given():
    seen = []

    def plan(self, request, knowledge):
        seen.append((request.pass_no, request.added, request.removed, knowledge.actions))
        return Morphin.plan(self, request, knowledge)

    check_planner(planning(plan=plan))
    assert (7, (), (), (0, 1, 2, 3, 4)) in seen
    assert (14, (7,), (), (0, 1, 2, 3, 4)) in seen
    assert (15, (), (), (0, 1, 2, 3, 4, 7)) in seen
    assert (20, (), (2,), (0, 1, 2, 3, 4, 7)) in seen
