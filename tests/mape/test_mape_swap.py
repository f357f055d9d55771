"""A part is replaced between two passes, with the state of the one before where both give it in the same format."""

import re
import sys
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mape_runs import GRID, TRAFFIC, config, hashes, loop_of

from mape import registry
from mape.analyze.changes import Changes
from mape.config import SwapConfig
from mape.errors import ConfigError, PartError, UnknownName
from mape.execute.rules import QLearning
from mape.monitor.page_hinkley import PageHinkley
from mape.parts import config_at, make, owner, parts_in, with_part
from mape.plan.exponential import Exponential
from mape.plan.morphin import Morphin
from mape.plan.q_learning import QLearningPlanner
from mape.specs import PartSpec
from mape.swap import replace_part, swap_sentence, vet

NEVER = {"name": "page_hinkley", "threshold": 1e6}


def spec(name, **options):
    return PartSpec.model_validate({"name": name, **options})


def swap(number, part, to):
    return {"pass": number, "part": part, "to": to}


def after(passes, base=GRID, **over):
    loop = loop_of(config(base, **over))
    loop.run(passes)
    return loop


def component(loop, part):
    return getattr(loop, owner(part))


def part_of(loop, part):
    return {
        "monitor": lambda: loop.monitor.detectors[0][1],
        "analyze": lambda: loop.analyze.analyzer,
        "plan": lambda: loop.plan.planner,
        "plan.schedule": lambda: loop.plan.planner.schedule,
        "learner": lambda: loop.execute.learner,
    }[part]()


@pytest.fixture
def own(monkeypatch):
    """Make classes nameable as ``own:NAME``."""

    def name(**classes):
        monkeypatch.setitem(sys.modules, "own", SimpleNamespace(**classes))

    return name


@pytest.mark.parametrize("part", ["monitor", "monitor.0", "analyze", "plan", "plan.schedule", "learner"])
def test_a_part_that_takes_the_place_of_its_like_changes_no_bit(part):
    loop, whole = after(6), after(20)
    now = parts_in(loop.config)[part][1]
    assert replace_part(component(loop, part), part, now, loop.config) == (part != "learner")
    loop.run(14)
    assert hashes(loop) == hashes(whole)


@pytest.mark.parametrize(
    ("part", "to", "handed_over"),
    [
        ("monitor", {"name": "page_hinkley", "threshold": 5.0}, True),
        ("monitor", {"name": "page_hinkley", "signal": "return"}, True),
        ("monitor", {"name": "page_hinkley", "signal": "steps"}, False),
        ("monitor", "two_window", False),
        ("analyze", "mape.analyze.changes:Changes", True),
        ("plan", {"name": "morphin", "k": 9.0}, True),
        ("plan", {"name": "morphin", "schedule": {"name": "exponential", "decay": 1.0}}, True),
        ("plan", {"name": "morphin", "schedule": "success"}, False),
        ("plan", "q_learning", False),
        ("plan.schedule", {"name": "exponential", "decay": 0.5}, True),
        ("plan.schedule", "geometric", False),
        ("learner", "expected_sarsa", False),
    ],
)
def test_state_is_handed_over_where_both_give_it_in_the_same_format(part, to, handed_over):
    loop = after(8)
    before = None if part == "learner" else part_of(loop, part).state()
    chosen = SwapConfig.model_validate(swap(9, part, to)).to
    fresh = None if part == "learner" else make(*parts_in(with_part(loop.config, part, chosen))[part]).state()
    assert replace_part(component(loop, part), part, chosen, loop.config) == handed_over
    if part != "learner":
        assert part_of(loop, part).state() == (before if handed_over else fresh)


def test_a_state_without_a_format_is_not_handed_over(own):
    class Quiet(PageHinkley):
        state_format = None

    own(Quiet=Quiet)
    loop = after(5, monitor={"detectors": ["own:Quiet"]})
    assert not replace_part(loop.monitor, "monitor", spec("own:Quiet"), loop.config)
    assert loop.monitor.detectors[0][1].state()["n"] == 0


def test_rivers_detectors_are_rebuilt():
    loop = after(5, monitor={"detectors": ["adwin"]})
    assert not replace_part(loop.monitor, "monitor", spec("adwin"), loop.config)


def test_a_new_detector_watches_the_signal_of_the_old_one_unless_another_is_named():
    loop = after(3, monitor={"detectors": [NEVER, NEVER | {"signal": "steps"}]})
    replace_part(loop.monitor, "monitor.1", spec("two_window", reference=3), loop.config)
    assert [(name, type(one).__name__) for name, one in loop.monitor.detectors] == [
        ("return", "PageHinkley"),
        ("steps", "TwoWindow"),
    ]
    replace_part(loop.monitor, "monitor.0", spec("oracle", signal="td_error"), loop.config)
    assert [name for name, _ in loop.monitor.detectors] == ["td_error", "steps"]
    loop.run(3)
    assert [r.signal for r in loop.log.window[-1].symptom.readings] == ["td_error", "steps"]


def test_a_new_planner_has_the_schedule_in_force_unless_another_is_named():
    loop = after(3)
    replace_part(loop.plan, "plan", spec("q_learning"), loop.config)
    assert type(loop.plan.planner.schedule) is Exponential
    replace_part(loop.plan, "plan.schedule", spec("constant", epsilon=0.3), loop.config)
    replace_part(loop.plan, "plan", spec("morphin"), loop.config)
    assert loop.plan.planner.schedule.epsilon == 0.3
    replace_part(loop.plan, "plan", spec("morphin", schedule={"name": "constant", "epsilon": 0.6}), loop.config)
    replace_part(loop.plan, "plan", spec("q_learning"), loop.config)
    assert loop.plan.planner.schedule.epsilon == 0.6


def test_a_planner_that_is_swapped_in_is_started_and_its_first_plan_is_not_put_in_force(own):
    begun = []

    class Telling(QLearningPlanner):
        def start(self, loop):
            begun.append(loop)
            return super().start(loop)

    own(Telling=Telling)
    loop = loop_of(config(loops=3), trial=1, loop=2)
    loop.run(4)
    replace_part(loop.plan, "plan", spec("own:Telling"), loop.config)
    assert begun == [5]
    assert loop.knowledge.plan.pass_no == loop.execute.plan.pass_no == 4


@pytest.mark.parametrize("engine", ["compiled", "python"])
def test_a_learner_that_is_swapped_in_learns_the_next_episode_and_the_table_goes_on(engine):
    loop = after(5, execute={"engine": engine}, learner={"name": "q_learning", "discount": 0.5})
    table = loop.execute.q_table.sha256()
    replace_part(loop.execute, "learner", spec("expected_sarsa", discount=0.0), loop.config)
    assert loop.execute.q_table.sha256() == table
    rows = []
    loop.execute.record_trace(6, 6, lambda number, trace: rows.extend(trace.tolist()))
    before = loop.execute.q_table.copy()
    loop.run(1)
    values = before.values
    for state, action, _, q, td_error, _ in rows:
        at = before.actions.index(int(action)), int(state)
        assert td_error + values[at] in (-1.0, 100.0)  # with discount 0 the target is the reward
        values[at] = q


@pytest.mark.parametrize(("engine", "other"), [("compiled", "python"), ("python", "compiled")])
def test_swaps_of_learners_give_the_same_bits_on_both_engines(engine, other):
    swaps = [swap(3, "learner", "expected_sarsa"), swap(7, "learner", {"name": "q_learning", "discount": 0.4})]
    runs = [after(10, TRAFFIC, swap=swaps, execute={"engine": name}) for name in (engine, other)]
    assert hashes(runs[0]) == hashes(runs[1])


class Lacking:
    """Has not what any part has."""


class TwoRates(QLearning):
    rate_names = ("alpha", "beta")


class TwoNumbers(Morphin):
    def start(self, loop):
        return super().start(loop)._replace(learning_rate=(0.1, 0.2))


class AlwaysTwo(TwoNumbers):
    def plan(self, request, knowledge):
        return super().plan(request, knowledge)._replace(learning_rate=(0.1, 0.2))


class Unstarted(Morphin):
    def start(self, loop):
        raise OSError("not today")


class Wild(Morphin):
    def start(self, loop):
        return super().start(loop)._replace(epsilon=2.0)


class Sideless(PageHinkley):
    direction = "left"


class Stubborn(PageHinkley):
    def restore(self, state):
        raise KeyError("mean")


class StubbornChanges(Changes):
    def restore(self, state):
        raise ValueError("no")


class StubbornExponential(Exponential):
    def restore(self, state):
        raise ValueError("no")


class Unrulable(QLearning):
    def __init__(self, config):
        super().__init__(config)
        self.value = lambda q, rows, count, state, best, epsilon: 0.0


OWN = [
    Lacking, TwoRates, TwoNumbers, AlwaysTwo, Unstarted, Wild, Sideless, Stubborn, StubbornChanges,
    StubbornExponential, Unrulable,
]  # fmt: skip


@pytest.mark.parametrize(
    ("part", "to", "error", "says"),
    [
        ("monitor", "page_hinkly", UnknownName, "did you mean 'page_hinkley'"),
        ("monitor", "own:Lacking", ConfigError, "has no direction, statistic, update, reset"),
        ("analyze", "own:Lacking", ConfigError, "has no analyze"),
        ("plan", "own:Lacking", ConfigError, "has no start, plan"),
        ("plan.schedule", "own:Lacking", ConfigError, "has no epsilon, advance, reset"),
        ("learner", "own:Lacking", ConfigError, "has no rate_names"),
        ("monitor", {"name": "page_hinkley", "threshold": -1.0}, ConfigError, "greater than 0"),
        ("monitor", {"name": "page_hinkley", "signal": "noise"}, ConfigError, "watches signal 'noise'; the run has"),
        ("monitor", "own:Sideless", PartError, "watches the side 'left'"),
        ("monitor", "own:Stubborn", PartError, "Stubborn raised KeyError: 'mean', at restore"),
        ("monitor.1", "two_window", UnknownName, "Known: .*monitor.0.* The run has 1 detectors"),
        ("analyze", "own:StubbornChanges", PartError, "StubbornChanges raised ValueError: no"),
        ("plan", "own:TwoNumbers", PartError, "the learner takes 3 numbers"),
        ("plan", "own:Unstarted", PartError, "raised OSError: not today"),
        ("plan", "own:Wild", PartError, "epsilon 2.0"),
        ("plan", {"name": "morphin", "schedule": {"decoy": 1.0}}, ConfigError, "did you mean 'decay'"),
        ("plan", {"name": "morphin", "schedule": "own:StubbornExponential"}, PartError, "raised ValueError: no"),
        ("plan.schedule", "own:StubbornExponential", PartError, "StubbornExponential raised ValueError: no"),
        (
            "learner",
            "own:TwoRates",
            PartError,
            r"takes 2 learning-rate parameters \(alpha, beta\), the one before it 3",
        ),
        ("learner", "own:Unrulable", ConfigError, "cannot be compiled: a rule is a module-level function"),
        ("planner", "morphin", UnknownName, "unknown part 'planner'; did you mean 'plan'"),
    ],
)
def test_a_part_that_cannot_be_let_in_leaves_the_old_one_as_it_was(own, part, to, error, says):
    own(**{one.__name__: one for one in OWN})
    loop, whole = after(6), after(20)
    chosen = spec(to) if isinstance(to, str) else spec(**to)
    with pytest.raises(error, match=says):
        replace_part(
            loop.execute if part == "learner" else getattr(loop, part.partition(".")[0], loop.plan),
            part,
            chosen,
            loop.config,
            signals=loop.log.layout.signals,
        )
    loop.run(14)
    assert hashes(loop) == hashes(whole)


def test_a_part_is_replaced_in_its_own_component_only():
    loop = after(2)
    with pytest.raises(ConfigError, match="part 'learner' is Execute's; Plan cannot replace it"):
        replace_part(loop.plan, "learner", spec("expected_sarsa"), loop.config)


def test_a_planner_without_a_schedule_of_its_own_is_told_from_one_with(own):
    class Bare(QLearningPlanner):
        def __init__(self, config, schedule):
            super().__init__(config, schedule)
            self.kept = schedule
            del self.schedule

    own(Bare=Bare)
    loop = loop_of(config(plan={"name": "own:Bare"}))
    with pytest.raises(PartError, match="planner Bare keeps no schedule in an attribute `schedule`"):
        replace_part(loop.plan, "plan.schedule", spec("constant"), loop.config)


def test_without_a_detector_or_with_two_there_is_no_part_monitor():
    for watched, known in (
        ([], r"Known: analyze, learner, plan, plan\.schedule\."),
        ([NEVER, NEVER], "monitor.0, mon"),
    ):
        loop = after(1, monitor={"detectors": watched})
        with pytest.raises(UnknownName, match=known):
            replace_part(loop.monitor, "monitor", spec("two_window"), loop.config)


@pytest.mark.parametrize(
    ("part", "name"),
    [
        ("monitor", "monitor"), ("monitor.0", "monitor"), ("monitor.12", "monitor"), ("analyze", "analyze"),
        ("plan", "plan"), ("plan.schedule", "plan"), ("learner", "execute"),
    ],
)  # fmt: skip
def test_every_part_has_an_owner(part, name):
    assert owner(part) == name


@pytest.mark.parametrize("part", ["", "monitor.", "monitor.-1", "monitor.01", "monitor.x", "execute", "schedule"])
def test_what_is_no_part_is_asked_back_with_the_parts(part):
    with pytest.raises(UnknownName, match=r"Known: analyze, learner, monitor, monitor\.0, plan, plan\.schedule"):
        owner(part)


def told(loop):
    heard = []
    loop.on_swap(lambda swap, handed_over: heard.append((loop.log.passes, swap.part, swap.to.name, handed_over)))
    return heard


SWAPS = [
    swap(7, "monitor", "two_window"),
    swap(1, "plan.schedule", {"name": "exponential", "decay": 0.5}),
    swap(7, "learner", "expected_sarsa"),
    swap(4, "plan", {"name": "morphin", "alpha": 0.4}),
]
MADE = [
    (0, "plan.schedule", "exponential", True),
    (3, "plan", "morphin", True),
    (6, "monitor", "two_window", False),
    (6, "learner", "expected_sarsa", False),
]


@settings(max_examples=15)
@given(st.lists(st.integers(0, 10), max_size=6))
def test_swaps_are_made_before_their_pass_however_the_run_is_cut(pieces):
    whole, cut = loop_of(config(swap=SWAPS)), loop_of(config(swap=SWAPS))
    heard = told(cut)
    whole.run(10)
    for passes in [*pieces, 10]:
        cut.run(min(passes, 10 - cut.log.passes))
    assert heard == MADE
    assert hashes(cut) == hashes(whole)


def test_swaps_are_made_before_their_pass_record_by_record_too():
    ran, stepped = loop_of(config(swap=SWAPS)), loop_of(config(swap=SWAPS))
    heard = told(stepped)
    ran.run(10)
    for _ in range(1 + 4 * 10):
        stepped.advance()
    assert heard == MADE
    assert hashes(stepped) == hashes(ran)


def test_a_swap_is_the_replacement_by_hand_between_two_passes():
    planned, by_hand = loop_of(config(swap=SWAPS)), loop_of(config())
    planned.run(10)
    for number in range(1, 11):
        for one in sorted(SWAPS, key=lambda one: one["pass"]):
            if one["pass"] == number:
                chosen = SwapConfig.model_validate(one)
                replace_part(component(by_hand, chosen.part), chosen.part, chosen.to, by_hand.config)
        by_hand.run(1)
    assert hashes(planned) == hashes(by_hand)


def test_up_to_a_swap_a_run_is_the_run_without_it():
    plain, swapped = after(6), after(6, swap=SWAPS[:1])
    assert hashes(plain) == hashes(swapped)


def test_a_swap_that_fails_is_still_to_be_made_and_the_passes_before_it_stand(own):
    refusals = iter([True])

    class Moody(PageHinkley):
        def restore(self, state):
            if next(refusals, False):
                raise ValueError("not yet")
            super().restore(state)

    own(Moody=Moody)
    loop, whole = (loop_of(config(swap=[swap(5, "monitor", to)])) for to in ("own:Moody", "page_hinkley"))
    with pytest.raises(PartError, match="Moody raised ValueError: not yet"):
        loop.run(10)
    assert loop.log.passes == 4
    loop.run(6)
    whole.run(10)
    assert hashes(loop) == hashes(whole)


def test_the_parts_that_serve_a_pass_are_those_that_swaps_have_brought():
    chosen = config(swap=SWAPS)
    assert [config_at(chosen, n).plan.options.get("alpha") for n in (3, 4)] == [None, 0.4]
    last = config_at(chosen, 10)
    assert (last.monitor.detectors[0].name, last.monitor.detectors[0].signal) == ("two_window", "return")
    assert (last.learner.name, last.plan.schedule.options) == ("expected_sarsa", {"decay": 0.5})


def test_a_sound_candidate_has_no_faults():
    for part, name in (
        ("monitor", "two_window"), ("analyze", "changes"), ("plan", "q_learning"), ("plan.schedule", "success"),
        ("learner", "expected_sarsa"),
    ):  # fmt: skip
        assert vet(part, spec(name), config()) == []


def test_every_built_in_part_says_in_what_format_it_gives_its_state():
    for kind in ("detector", "analyzer", "schedule", "planner"):
        for name, entry in registry.PARTS[kind].items():
            if entry.target.startswith("mape."):
                options = {"schedule": registry.build("schedule", spec("exponential"))} if kind == "planner" else {}
                assert "/1" in registry.build(kind, spec(name), **options).state_format


@pytest.mark.parametrize(
    ("part", "to", "says"),
    [
        (
            "monitor",
            "own:Stubborn",
            "detector 'own:Stubborn' breaks a clause of its contract, takes up where its state",
        ),
        ("monitor", "own:Lacking", "has no direction"),
        ("monitor.3", "two_window", "unknown part 'monitor.3'"),
        ("plan", "own:Wild", "epsilon is 2.0"),
        ("plan", "own:TwoNumbers", "cannot be executed"),
        ("plan", "own:AlwaysTwo", "does not fit the run: it has 2 learning-rate parameters, the run 3"),
        ("learner", "own:TwoRates", "IndexError was raised"),
        ("learner", "own:Unrulable", "gives the same bits compiled as in plain Python: .*cannot be compiled"),
        ("plan.schedule", {"name": "constant", "epsilon": 3.0}, "less than or equal to 1"),
    ],
)
def test_a_candidate_is_told_its_faults_in_sentences(own, part, to, says):
    own(**{one.__name__: one for one in OWN})
    found = vet(part, spec(to) if isinstance(to, str) else spec(**to), config())
    assert found != []
    assert re.search(says, "\n".join(found))


@pytest.mark.parametrize(
    ("made", "handed_over", "sentence"),
    [
        (swap(5, "plan", "q_learning"), False, "pass 5: plan is now q_learning, without the state of the one before"),
        (
            swap(9, "monitor.1", {"name": "oracle", "episodes": [3]}),
            True,
            "pass 9: monitor.1 is now oracle (episodes = [3]), with the state of the one before",
        ),
        (
            swap(2, "learner", "expected_sarsa"),
            False,
            "pass 2: learner is now expected_sarsa, and the Q-table goes on",
        ),
    ],
)
def test_a_swap_reads_as_a_sentence(made, handed_over, sentence):
    assert swap_sentence(SwapConfig.model_validate(made), handed_over) == sentence
