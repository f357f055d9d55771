"""The conformance checks find each fault in a part that has just that one, and none in parts that have none."""

import itertools
import random
from types import SimpleNamespace

import faulty_quiet
import faulty_rules
import numpy as np
import pytest
from mape_runs import Corridor

from adapters.systems import make_system
from knowledge import Drift
from mape import registry
from mape.analyze.changes import Changes, ChangesConfig
from mape.config import SystemConfig
from mape.errors import PartError
from mape.execute.rules import LearnerConfig, QLearning, expected_value
from mape.monitor.page_hinkley import PageHinkley, PageHinkleyConfig, page_hinkley_alarm
from mape.monitor.two_window import TwoWindow, TwoWindowConfig
from mape.plan.exponential import Exponential, ExponentialConfig, exponential_next
from mape.plan.morphin import Morphin, MorphinConfig
from mape.ports import QuietRule
from mape.specs import PartSpec
from mape.testing import (
    CHECKS,
    Finding,
    check_analyzer,
    check_detector,
    check_learner,
    check_planner,
    check_schedule,
    check_system,
    require,
)

MEMBERS = "has the members of the port"
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


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("mapek/Gridworld-v0", {"slip": 0.2, "jump_from": 3, "switch_at": [2], "remove": {"1": 4}}),
        ("mapek/TrafficJunction-v0", {"switch_at": [2, 4], "reserve_from": 3}),
        ("FrozenLake-v1", {}),
    ],
)
def test_systems_that_keep_every_clause_are_found_to_do_so(name, options):
    made = []

    def make():
        made.append(make_system(SystemConfig(id=name, options=options)))
        return made[-1]

    findings = check_system(make)
    rules = made[0].rules is not None
    assert [f.verdict for f in findings] == ["ok"] * 6 + (["ok"] * 2 if rules else ["note"] * 2)


def faults(findings):
    return {finding.check: finding.detail for finding in findings if finding.verdict == "failed"}


def variant(base, *arguments, **members):
    """A maker of `base` with some members replaced."""
    made = type(base.__name__, (base,), members)
    return lambda: made(*arguments)


def without(base, *arguments, member):
    """A maker of `base` without a member."""

    def make():
        part = base(*arguments)
        names = [n for n in dir(part) if not n.startswith("_") and n != member]
        return SimpleNamespace(**{n: getattr(part, n) for n in names})

    return make


def windowed(**members):
    return variant(TwoWindow, TwoWindowConfig(reference=20, recent=5), **members)


def hinkley(**members):
    return variant(PageHinkley, PageHinkleyConfig(), **members)


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


def scheduled(**members):
    return variant(Exponential, ExponentialConfig(), **members)


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
        (scheduled(epsilon=property(lambda self: random.random())), DETERMINISTIC, "two fresh ones"),
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


def planning(**members):
    made = type("Morphin", (Morphin,), members)
    config = MorphinConfig(alpha=0.1, alpha_max=0.9, k=5.0, enable_on_drift=(3, 4))
    return lambda: made(config, Exponential(ExponentialConfig()))


def planned(**fields):
    def plan(self, request, knowledge):
        made = Morphin.plan(self, request, knowledge)
        return made._replace(**{n: f(request, knowledge) for n, f in fields.items()})

    return planning(plan=plan)


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


STAYS = "stays within its states, with finite rewards and known actions"
FORETELLS = "says beforehand which actions an episode offers, or nothing"
PLAYS_THE_SAME = "is deterministic: two fresh ones play the same episodes"
WHATEVER = "plays an episode the same whatever was played before"
BY_RULES = "has rules that equal its steps, bit for bit"
COMPILED = "learns the same Q-table compiled and called"


class Walk(Corridor):
    """The corridor by rules: six cells, from the left end to the right one."""

    n_states, max_steps = 6, 9
    by_step = staticmethod(faulty_rules.step)
    by_rule = staticmethod(faulty_rules.step)

    def __init__(self):
        super().__init__()
        self.first_state = 0
        self.rules = SimpleNamespace(
            params=faulty_rules.WalkParams(6),
            phase=faulty_rules.phase,
            reset=faulty_rules.reset,
            step=self.by_rule,
            explorable=faulty_rules.explorable,
            windows=np.array([[1, 99], [1, 99]]),
            reset_draws=0,
            step_draws=0,
        )

    def begin(self, episode):
        self._cell = 0
        return 0, (0, 1)

    def step(self, action, context):
        self._cell, reward, ended = self.by_step(self.rules.params, 0, self._cell, action, None, 0, context)
        return self._cell, reward, ended, False


class Carrying(Corridor):
    """Its reward grows from episode to episode."""

    played = 0

    def begin(self, episode):
        self.played += 1
        return super().begin(episode)

    def step(self, action, context):
        state, _, ended, truncated = super().step(action, context)
        return state, float(self.played), ended, truncated


class Stateful(Carrying):
    def get_state(self):
        return {"played": self.played}

    def set_state(self, state):
        self.played = state["played"]


def corridor(**members):
    return variant(Corridor, **members)


def spoilt(**fields):
    return lambda: Corridor(spoil=lambda episode, step: fields)


@pytest.mark.parametrize(
    ("make", "check", "says"),
    [
        (without(Corridor, member="explorable"), MEMBERS, "has no explorable()"),
        (corridor(n_states=0), "describes itself in numbers", "n_states is 0"),
        (corridor(max_steps=2.5), "describes itself in numbers", "max_steps is 2.5"),
        (corridor(draws=(0, -1)), "describes itself in numbers", "draws[1] is -1"),
        (corridor(redrivable=None), "describes itself in numbers", "redrivable is None; it is True or False"),
        (without(Corridor, member="get_state"), MEMBERS, "has no get_state()"),
        (corridor(drifts=(5, 3)), "describes itself in numbers", "increasing episodes"),
        (lambda: Corridor(signal_names=("return",)), "describes itself in numbers", "none of return, steps"),
        (lambda: Corridor(signal_names=("a", "a")), "describes itself in numbers", "distinct names"),
        (lambda: Corridor(offers=lambda episode: ()), STAYS, "episode 1 offers ()"),
        (lambda: Corridor(offers=lambda episode: (0, 1, 1)), STAYS, "distinct ints from 0"),
        (lambda: Corridor(offers=lambda episode: (np.int64(0), 1)), STAYS, "distinct ints from 0"),
        (corridor(begin=lambda self, episode: (5, (0, 1))), STAYS, "begin() of episode 1 went to state 5"),
        (spoilt(state=9), STAYS, "went to state 9; states are ints from 0 to 4"),
        (spoilt(state=1.0), STAYS, "went to state 1.0"),
        (spoilt(reward=float("nan")), STAYS, "gave reward nan"),
        (spoilt(reward=None), STAYS, "gave reward None"),
        (
            corridor(step=lambda self, action, context: (*Corridor.step(self, action, context)[:2], 0, False)),
            STAYS,
            "gave terminated 0",
        ),
        (
            lambda: Corridor(signal_names=("cell",), spoil=lambda e, s: {"signal": float("inf")}),
            STAYS,
            "gave signals {'cell': inf}",
        ),
        (
            corridor(available=lambda self, episode: (0,)),
            FORETELLS,
            "available(1) is (0,), and episode 1 offers (0, 1)",
        ),
        (
            lambda: Corridor(spoil=lambda episode, step: {"reward": random.random()}),
            PLAYS_THE_SAME,
            "episode 1 of two fresh ones differs at step 1",
        ),
        (variant(Stateful, set_state=lambda self, state: None), WHATEVER, "get_state() holds all that it carries"),
        (
            variant(Walk, by_rule=staticmethod(faulty_rules.step_with_another_reward)),
            BY_RULES,
            "by step() and by rules",
        ),
        (variant(Walk, draws=(1, 0)), BY_RULES, "draws says (1, 0)"),
        (
            variant(
                Walk,
                by_step=staticmethod(faulty_rules.overflowing_step),
                by_rule=staticmethod(faulty_rules.overflowing_step),
            ),
            COMPILED,
            "episode 1 learns",
        ),
    ],
)
def test_a_system_with_a_fault_is_told_its_fault(make, check, says):
    assert says in faults(check_system(make))[check]


def verdicts(findings):
    return {finding.check: finding.verdict for finding in findings}


def test_a_system_whose_episodes_depend_on_those_before_is_noted_as_not_resumable():
    (finding,) = (f for f in check_system(Carrying) if f.check == WHATEVER)
    assert finding.verdict == "note"
    assert finding.detail.startswith("not resumable: episode")


def test_a_system_that_cannot_be_driven_again_says_so_and_is_noted():
    (finding,) = (f for f in check_system(corridor(redrivable=False)) if f.check == WHATEVER)
    assert finding.verdict == "note"
    assert finding.detail.startswith("not redrivable, as it says itself (redrivable = False)")


def test_a_system_that_gives_and_takes_its_state_is_resumable():
    assert verdicts(check_system(Stateful))[WHATEVER] == "ok"


def test_a_system_without_rules_is_noted_and_not_failed():
    findings = verdicts(check_system(Corridor))
    assert (findings[BY_RULES], findings[COMPILED]) == ("note", "note")
    assert set(findings.values()) == {"ok", "note"}


def test_every_system_that_a_check_makes_is_closed():
    closed, made = [], []

    class Closing(Corridor):
        def __init__(self):
            super().__init__()
            made.append(self)

        def close(self):
            closed.append(self)

    check_system(Closing)
    assert closed == made != []


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
