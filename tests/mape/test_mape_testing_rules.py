"""The conformance checks hold a declared rule against its methods: the same bits, or the fault is told."""

import faulty_quiet
import pytest
from faulty_parts import faults, hinkley, planned, planning, scheduled, variant

from knowledge import Drift
from mape.analyze.changes import Changes
from mape.monitor.page_hinkley import PageHinkley, page_hinkley_alarm
from mape.plan.exponential import Exponential, ExponentialConfig, exponential_next
from mape.plan.morphin import Morphin, MorphinConfig
from mape.ports import QuietRule
from mape.testing import check_analyzer, check_detector, check_planner, check_schedule

BY_RULE = "has a rule that does what its methods do, in Python and compiled"


def ruled(rule, **members):
    """A Page-Hinkley test that declares another rule than its own."""
    return hinkley(quiet=property(lambda self: QuietRule(rule, self._state, self._params)), **members)


def declared(make_rule):
    return hinkley(quiet=property(make_rule))


class Counting:
    """Counts in whole numbers, in its rule and without."""

    direction, quiet = "up", property(lambda self: QuietRule(faulty_quiet.counts, self.seen))

    def __init__(self):
        self.seen, self.statistic = [0.0], None

    def update(self, x):
        alarm, self.statistic, _ = faulty_quiet.counts(self.seen, (), x)
        return alarm

    def reset(self):
        self.seen[:] = [0.0]

    def state(self):
        return [*self.seen]

    def restore(self, state):
        self.seen[:] = state


class Growing(Counting):
    quiet = property(lambda self: QuietRule(faulty_quiet.grows, self.seen))

    def update(self, x):
        alarm, self.statistic, _ = faulty_quiet.grows(self.seen, (), x)
        return alarm


def counts_beside(self, x):
    self.beside = getattr(self, "beside", 0) + 1
    return PageHinkley.update(self, x)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (hinkley(quiet=3), "quiet is 3; it is a mape.ports.QuietRule, or None"),
        (
            declared(lambda self: QuietRule(page_hinkley_alarm, [*self._state], self._params)),
            "after step 0 its methods have quiet.state[0] at 1.0, its rule in Python at 0.0",
        ),
        (
            declared(lambda self: QuietRule(page_hinkley_alarm, (*self._state,), self._params)),
            "quiet.state is a tuple; it is the list on which the methods work",
        ),
        (declared(lambda self: QuietRule(page_hinkley_alarm, self._state, ("0.5", 300))), "quiet.params holds '0.5'"),
        (
            declared(lambda self: QuietRule(page_hinkley_alarm, self._state, (0.4, 300.0))),
            "after step 0 its methods have quiet.state[2] at -0.5, its rule in Python at -0.4",
        ),
        (ruled(faulty_quiet.names_no_side), "its rule in Python (False, 0.0, 'unknown')"),
        (ruled(faulty_quiet.names_a_side_that_there_is_not), "its rule names the side 7"),
        (ruled(faulty_quiet.knows_no_statistic), "its rule in Python (False, None, 'down')"),
        (ruled(faulty_quiet.gives_none), "its rule gives None; it gives numbers alone, and NaN for no statistic"),
        (ruled(faulty_quiet.never_alarms), "its methods give (True, "),
        (ruled(faulty_quiet.alarms_early), "does not alarm"),
        (
            ruled(faulty_quiet.counts_twice),
            "after step 0 its methods have quiet.state[0] at 1.0, its rule in Python at",
        ),
        (ruled(lambda state, params, x: page_hinkley_alarm(state, params, x)), "<lambda> cannot be compiled"),
        (ruled(faulty_quiet.makes_an_array), "cannot be compiled by Numba"),
        (ruled(faulty_quiet.makes_an_array), "A rule makes no list, array or text"),
        (Counting, "its methods give (False, 1.6e+19, 'up'), its rule compiled (False, -2.4467440737095516e+18, 'up')"),
        (Growing, "quiet.state has 2 numbers, and had 1; their number is fixed"),
        (
            ruled(
                page_hinkley_alarm,
                update=counts_beside,
                state=lambda self: PageHinkley.state(self) | {"beside": getattr(self, "beside", 0)},
            ),
            "in Python it ends in another state than by its methods",
        ),
    ],
)
def test_a_detector_whose_rule_does_something_else_is_told_so(make, says):
    assert says in faults(check_detector(make))[BY_RULE]


def test_a_detector_whose_rule_is_its_method_keeps_the_clause():
    assert faults(check_detector(ruled(page_hinkley_alarm))) == {}


@pytest.mark.parametrize(
    ("check", "make", "says"),
    [
        (
            check_detector,
            hinkley(),
            "detector PageHinkley declares no rule of its own (where that of its base holds for it, say "
            "quiet = Base.quiet), so that its passes are made in Python",
        ),
        (check_detector, hinkley(quiet=None), "detector PageHinkley declares no rule, so that"),
        (
            check_planner,
            lambda: Morphin(MorphinConfig(), Undeclared(ExponentialConfig())),
            "schedule Undeclared declares",
        ),
    ],
)
def test_a_part_that_declares_no_rule_is_noted_and_not_failed(check, make, says):
    (finding,) = (f for f in check(make) if f.check == BY_RULE)
    assert finding.verdict == "note"
    assert says in finding.detail


class Undeclared(Exponential):
    """A schedule whose rule is that of its base, without saying so."""


def next_by(rule):
    return scheduled(quiet=property(lambda self: QuietRule(rule, self._state, self._params)))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (
            next_by(faulty_quiet.stands_still),
            "after step 0 its methods have quiet.state[0] at 1.0, its rule in Python at 0",
        ),
        (next_by(faulty_quiet.decays_faster), "at step 1 its methods give 0.956"),
    ],
)
def test_a_schedule_whose_rule_does_something_else_is_told_so(make, says):
    assert says in faults(check_schedule(make))[BY_RULE]


def test_a_schedule_whose_rule_is_its_method_keeps_the_clause():
    assert faults(check_schedule(next_by(exponential_next))) == {}


def asked(**fields):
    """A planner whose plans have other fields than those of which its rule knows."""
    made = planned(**fields)
    type(made()).quiet = Morphin.quiet
    return made


def half_way(self):
    return QuietRule(faulty_quiet.decays_half_way, self.schedule._state, self.schedule._params)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (asked(epsilon=lambda r, k: 0.5), "at step 1 its methods give ChangePlan("),
        (asked(learning_rate=lambda r, k: (0.1 / r.pass_no, 0.9, 5.0)), "learning_rate=(0.05, 0.9, 5.0)"),
        (asked(reset_detector=lambda r, k: r.pass_no == 9), "at step 9 its methods give ChangePlan("),
        (planning(quiet=property(half_way)), "epsilon=0.478"),
    ],
)
def test_a_planner_whose_rule_does_something_else_is_told_so(make, says):
    assert says in faults(check_planner(make))[BY_RULE]


def test_a_planner_may_do_in_other_passes_what_its_rule_knows_nothing_of():
    def rate(request, knowledge):
        rates = (0.2, 0.9, 5.0) if request.drifts else (0.1, 0.9, 5.0)
        return rates if request.drifts or request.pass_no < 6 else knowledge.plan.learning_rate

    assert faults(check_planner(asked(learning_rate=rate))) == {}


class Low(Changes):
    """Calls it a drift if the return is low, or was so for the third time since it called it a drift."""

    def __init__(self, rule, floor):
        self.rule, self.floor, self.low = rule, floor, [0.0]

    @property
    def quiet(self):
        return QuietRule(self.rule, self.low, (self.floor,))

    def analyze(self, symptom):
        request = Changes.analyze(self, symptom)
        if request.drifts or request.added or request.removed or not self.changed([*symptom.signals.values()]):
            return request
        return request._replace(drifts=(Drift("return", "down"),))

    def changed(self, signals):
        if changed := self.rule(self.low, (self.floor,), signals):
            self.low[0] = 0.0
        return changed

    def state(self):
        return [*self.low]

    def restore(self, state):
        self.low[:] = state


@pytest.mark.parametrize("rule", [faulty_quiet.is_low, faulty_quiet.counts_low])
def test_an_analyzer_whose_rule_says_when_it_would_ask_for_a_change_keeps_the_clause(rule):
    assert faults(check_analyzer(lambda: Low(rule, -20.0))) == {}


@pytest.mark.parametrize(
    ("members", "says"),
    [
        ({"quiet": Changes.quiet}, "its methods give ChangeRequest("),
        (
            {"quiet": property(lambda self: QuietRule(faulty_quiet.counts_low, self.low, (-90.0,)))},
            "its methods have quiet.state[0] at 1.0, its rule in Python at 0.0",
        ),
    ],
)
def test_an_analyzer_whose_rule_does_something_else_is_told_so(members, says):
    assert says in faults(check_analyzer(variant(Low, faulty_quiet.counts_low, -20.0, **members)))[BY_RULE]
