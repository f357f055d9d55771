"""Parts that are wrong in a way that no single script of values or passes shows; each is found by the clause for it."""

import pytest
from faulty_parts import faults, planning, scheduled, variant
from hypothesis import given, settings
from hypothesis import strategies as st
from mape_runs import Corridor

from mape import registry
from mape.analyze.changes import Changes, ChangesConfig
from mape.execute.rules import LearnerConfig, QLearning
from mape.plan.morphin import Morphin
from mape.specs import PartSpec
from mape.testing import check_analyzer, check_detector, check_learner, check_planner, check_schedule, check_system

FORGETS = "forgets on reset the values that it has seen"


class Steps:
    """Alarms when a sum of steps to one side is beyond a threshold; `keeps` is what its reset forgets to forget."""

    statistic = None

    def __init__(self, side=1.0, threshold=900.0, keeps=("total", "last")):
        self.direction = "up" if side > 0.0 else "down"
        self.side, self.threshold, self.keeps = side, threshold, keeps
        self.total, self.last = 0.0, None

    def update(self, x):
        if self.last is not None:
            self.total = max(0.0, self.total + self.side * (x - self.last) - 1.0)
        self.last = x
        return self.total > self.threshold

    def reset(self):
        if "total" not in self.keeps:
            self.total = 0.0
        if "last" not in self.keeps:
            self.last = None

    def state(self):
        return [self.total, self.last]

    def restore(self, state):
        self.total, self.last = state


class Row:
    """Alarms at the eighth value in a row on one side of a limit, once; its reset does nothing."""

    statistic = None

    def __init__(self, below, limit, length=8):
        self.direction = "down" if below else "up"
        self.below, self.limit, self.length, self.count = below, limit, length, 0

    def update(self, x):
        self.count = self.count + 1 if (x < self.limit) == self.below else 0
        return self.count == self.length

    def reset(self):
        pass

    def state(self):
        return self.count

    def restore(self, state):
        self.count = state


class ForgetfulRow(Row):
    def reset(self):
        self.count = 0


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("keeps", [("total", "last"), ("total",), ("last",)])
def test_a_sum_of_steps_that_a_reset_keeps_is_found_on_either_side(side, keeps):
    assert "reset() sets all" in faults(check_detector(lambda: Steps(side, keeps=keeps)))[FORGETS]


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_sum_of_steps_that_is_forgotten_is_found_to_be(side):
    assert faults(check_detector(lambda: Steps(side, keeps=()))) == {}


def forgets(make):
    (finding,) = (finding for finding in check_detector(make) if finding.check == FORGETS)
    return finding


@pytest.mark.parametrize("below", [True, False])
@pytest.mark.parametrize("limit", [-200.0, 48.0, 52.0])
def test_a_row_that_a_reset_does_not_end_is_found_on_either_side(below, limit):
    assert "reset() sets all" in forgets(lambda: Row(below, limit)).detail
    assert forgets(lambda: ForgetfulRow(below, limit)) == (FORGETS, "ok", "")


# A row of values above the mean of noise is so rare that its readings may tell nothing; its states do.
@settings(max_examples=12)
@given(st.booleans(), st.sampled_from([-9000.0, -4000.0, 50.0, 9000.0, 9200.0]), st.integers(3, 12))
def test_no_row_that_a_reset_does_not_end_passes_without_a_word(below, limit, length):
    assert forgets(lambda: Row(below, limit, length)).verdict != "ok"
    assert forgets(lambda: ForgetfulRow(below, limit, length)).verdict == "ok"


@pytest.mark.parametrize("name", list(registry.PARTS["schedule"]))
def test_a_schedule_that_counts_on_over_its_reset_is_found(name):
    made = type(registry.build("schedule", PartSpec(name=name)))
    config = made.Config()
    found = faults(check_schedule(variant(made, config, reset=lambda self: None)))
    if name == "constant":
        assert found == {}  # it has nothing to begin anew
    else:
        assert "reset() forgets what was counted" in found["starts anew on reset, whatever the returns before it"]


def test_a_schedule_that_moves_when_it_is_read_is_found():
    def epsilon(self):
        self._state[0] += 1.0
        return 1.0 / (1.0 + self._state[0])

    found = faults(check_schedule(scheduled(epsilon=property(epsilon))))
    assert "when it is read again" in found["keeps epsilon in [0, 1]"]


FITS = "gives change requests that fit their symptom"


def scales(self, symptom):
    symptom.signals["return"] /= 100.0
    return Changes.analyze(self, symptom)


def looks_at_the_first(self, symptom):
    assert symptom.readings[0].signal
    return Changes.analyze(self, symptom)


@pytest.mark.parametrize(
    ("analyze", "says"),
    [(scales, "analyze() wrote"), (looks_at_the_first, "IndexError was raised")],
)
def test_an_analyzer_that_writes_into_the_log_or_needs_a_detector_is_found(analyze, says):
    assert says in faults(check_analyzer(variant(Changes, ChangesConfig(), analyze=analyze)))[FITS]


EXECUTABLE = "gives plans that can be executed, with epsilon in [0, 1]"


def writes_signals(self, request, knowledge):
    request.signals["return"] = 0.0
    return Morphin.plan(self, request, knowledge)


def writes_knowledge(self, request, knowledge):
    knowledge.plan = Morphin.plan(self, request, knowledge)
    return knowledge.plan


def drops_all(self, request, knowledge):
    return Morphin.plan(self, request, knowledge)._replace(drop=knowledge.actions, add=())


@pytest.mark.parametrize(
    ("plan", "says"),
    [
        (writes_signals, "plan() wrote"),
        (writes_knowledge, "into the knowledge"),
        (drops_all, "at least one must stay"),
    ],
)
def test_a_planner_that_writes_into_what_it_reads_or_leaves_no_action_is_found(plan, says):
    assert says in faults(check_planner(planning(plan=plan)))[EXECUTABLE]


def of_all_rows(q, rows, count, state, best, epsilon):
    value = q[rows[0], state]
    for row in rows:
        value = max(value, q[row, state])
    return value


def of_the_whole_table(q, rows, count, state, best, epsilon):
    value = q[0, state]
    for row in range(q.shape[0]):
        value = max(value, q[row, state])
    return value


@pytest.mark.parametrize("value", [of_all_rows, of_the_whole_table])
def test_a_learner_that_reads_actions_which_are_not_offered_is_found(value):
    made = variant(QLearning, LearnerConfig(), value=staticmethod(value))
    assert "rows[:count]" in faults(check_learner(made))["reads the rows of the actions on offer alone"]


def test_a_system_that_sets_its_signals_in_place_of_adding_them_is_found():
    def step(self, action, context):
        context[:] = 0.0
        return Corridor.step(self, action, context)

    found = faults(check_system(variant(Corridor, lambda episode: (0, 1), lambda e, s: {}, ("cell",), step=step)))
    assert "a step adds to the context" in found["adds its signals to those of the steps before"]
