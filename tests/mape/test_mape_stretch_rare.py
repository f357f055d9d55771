"""What is rare in a run, or wrong with a part of one's own, is the same with compiled stretches as without."""

import contextlib
import math

import numpy as np
import pytest
import stretch_parts as own
from knowledge_masks import actions_of
from mape_runs import GRID, TRAFFIC, config, hashes, loop_of
from stretch_parts import Ruled
from stretch_runs import Run, alike

from knowledge.rows import UP
from managed_systems.rules import ALWAYS
from mape.errors import ConfigError, ManagedSystemError, PartError
from mape.monitor.page_hinkley import PageHinkley
from mape.plan.exponential import Exponential
from mape.tables import merge

RULED = {"name": "ruled", "episodes": 10_000, "system": {"id": "ruled"}}
RUN, ON = [("run", 60)], [("run", 5)]


def watched(*detectors, **over):
    return merge(RULED, {"monitor": {"detectors": list(detectors)}, **over})


def part(name, **options):
    return {"name": f"stretch_parts:{name}", **options}


def ruled(*given, **options):
    return lambda config: Ruled(*given, **options)


def rows_of(run):
    return np.frombuffer(b"".join(run.rows), run.loop.log.layout.dtype)


# Rules that fail


@pytest.mark.parametrize("at", [1, 33])
@pytest.mark.parametrize(
    ("does", "says"),
    [
        (own.RAISES, "PartError: detector Watch raised ValueError: the watch has stopped, at pass {at} on td_error = "),
        (own.INFINITE, "PartError: detector Watch raised ValueError: its statistic is inf, not a finite number or"),
        (own.NO_SIDE, "PartError: detector Watch raised ValueError: its direction is 'nowhere', none of"),
    ],
)
def test_a_detector_that_fails_fails_at_its_pass_with_its_sentence(does, says, at):
    table = watched(part("Watch", signal="td_error"), part("Watch", signal="cell", at=at, does=does))
    table["monitor"]["detectors"].reverse()
    table["monitor"]["detectors"][0]["signal"] = "td_error"
    run, _ = alike(table, RUN, ON, make=ruled())
    assert run.errors[0].startswith(says.format(at=at))
    assert run.loop.log.passes == at - 1
    assert run.errors[1].startswith(f"BusError: Observation {at + 1} is refused as a gap")


@pytest.mark.parametrize(
    ("does", "reading"),
    [(own.NOTHING, (False, False)), (own.NONE, (False, True)), (own.ALARMS, (True, False))],
)
def test_a_statistic_that_is_none_and_an_alarm_stand_in_the_row_of_their_pass(does, reading):
    run, _ = alike(watched(part("Watch", signal="cell", at=33, does=does)), RUN, make=ruled())
    row = rows_of(run)[32]
    assert (row["alarm"][0], np.isnan(row["statistic"][0])) == reading
    assert run.loop.log.passes == 60


class Shy(own.Watch):
    """Cannot be asked for its statistic between a reset and the next value."""

    quiet = own.Watch.quiet
    resets = 0

    def reset(self):
        super().reset()
        self.resets += 1

    @property
    def statistic(self):
        return super().statistic if self.resets == 1 or 1.0 / self._numbers[0] else None


def test_a_statistic_is_not_asked_for_before_there_is_a_value():
    detector = {"name": "test_mape_stretch_rare:Shy", "at": 7, "does": own.ALARMS}
    run, _ = alike(watched(detector), RUN, make=ruled())
    assert (run.errors, run.loop.obstacles()) == ([], [])
    assert rows_of(run)["alarm"].sum() == 8


@pytest.mark.parametrize(
    ("epsilon", "says"),
    [
        (1.5, "PartError: planner Headstrong gave epsilon 1.5 for pass 33; an exploration rate is a number in [0, 1]"),
        (-0.5, "PartError: planner Headstrong gave epsilon -0.5 for pass 33; an exploration rate is a number in [0, 1"),
        (9.0, "PartError: planner Headstrong raised ValueError: no plan comes to mind, at pass 33."),
        (0.0, None),
        (-0.0, None),
        (1.0, None),
    ],
)
def test_a_planner_that_goes_too_far_is_refused_at_its_pass(epsilon, says):
    run, _ = alike(RULED | {"plan": part("Headstrong", at=33, epsilon=epsilon)}, RUN, ON, make=ruled())
    if says is None:
        assert run.errors == []
        assert rows_of(run)["next_epsilon"][32] == epsilon
    else:
        assert run.errors[0].startswith(says)
        assert run.loop.log.passes == 32


@pytest.mark.parametrize(
    ("goal", "says"),
    [
        (8.0, "NonFiniteError: the Q-value of action "),
        (10.0, "PartError: step_size of learner Stumbling raised ValueError: too great a step, in episode"),
        (5.0, None),
    ],
)
def test_a_learner_that_fails_costs_nothing(goal, says):
    table = RULED | {"learner": {"name": "stretch_parts:Stumbling"}}
    run, _ = alike(table, RUN, ON, make=ruled(reward=0.0, goals=(1.0, goal)))
    assert run.errors == ([] if says is None else run.errors[:1] * 2)
    assert (says is None) == (run.loop.log.passes == 65)
    assert all(error.startswith(says) for error in run.errors)


def test_an_analyzer_that_sees_a_change_where_no_detector_alarms_is_asked_itself():
    run, _ = alike(RULED | {"analyze": part("Fussy", at=33, most=7.0)}, RUN, make=ruled())
    rows = rows_of(run)
    seen = rows["pass"][rows["drift"][:, 0] == UP].tolist()
    assert seen == rows["pass"][(rows["signals"][:, 0] > 7.0) | (rows["pass"] == 33)].tolist()
    assert 33 in seen
    assert 3 < len(seen) < 50


def test_a_planner_that_takes_up_remembered_tables_goes_on_with_them():
    table = watched({"name": "oracle", "episodes": [10, 11, 20, 40]}, plan=part("Nostalgic"))
    run, _ = alike(table, RUN, make=ruled())
    assert run.loop.obstacles() == []
    assert np.flatnonzero(rows_of(run)["adopt"] != np.void(bytes(32))).tolist() == [10, 19, 39]


FAULTS = {
    own.REWARD_NAN: "NonFiniteError: ruled gave reward nan for action",
    own.REWARD_INFINITE: "NonFiniteError: ruled gave reward -inf for action",
    own.TOO_FAR: "ManagedSystemError: ruled went to state 8 in episode",
    own.BELOW: "ManagedSystemError: ruled went to state -1 in episode",
    own.BREAKS: "ManagedSystemError: ruled raised ValueError: the wheel came off, in episode",
    own.STARTS_OUTSIDE: "ManagedSystemError: ruled went to state 6 in episode",
    own.SIGNAL_INFINITE: "NonFiniteError: ruled gave cell = inf in episode",
}


@pytest.mark.parametrize("at", [1, 33])
@pytest.mark.parametrize("does", FAULTS)
def test_an_episode_that_fails_costs_nothing_and_fails_again(does, at):
    run, _ = alike(RULED, RUN, ON, make=ruled(at, does))
    assert run.errors[0].startswith(FAULTS[does])
    assert run.errors[1] == run.errors[0]
    assert run.loop.log.passes == at - 1
    before = Run(RULED, ["python"], make=ruled())
    before.run(at - 1)
    assert hashes(run.loop) == hashes(before.loop)


def test_an_episode_fails_while_detectors_have_seen_nothing_of_it():
    run, _ = alike(watched(part("Watch", signal="cell")), RUN, make=ruled(33, own.BREAKS))
    assert run.loop.monitor.state()[0][0] == 32.0


def test_a_reset_that_raises_is_told_with_the_same_sentence():
    alike(RULED, RUN, make=ruled(33, own.RESET_BREAKS))


# Rules and numbers that change


@pytest.mark.parametrize("engines", [("auto", "auto"), ("python", "auto"), ("auto", "python")])
@pytest.mark.parametrize("detector", ["Watch", "Longer", "Wavering"])
def test_numbers_that_a_part_puts_in_the_place_of_its_own_are_seen(detector, engines):
    script = [("run", 30), ("take_up",), ("run", 30), ("elsewhere",), ("run", 30)]
    run, _ = alike(watched(part(detector)), script, engines=engines, make=ruled())
    assert run.loop.log.passes == 90


def test_a_part_that_no_longer_declares_a_rule_is_named_from_then_on():
    run, _ = alike(watched(part("Wavering")), [("run", 12)], make=ruled())
    assert run.loop.monitor.detectors[0][1].quiet is None
    assert run.loop.obstacles() == ["detector monitor.0 Wavering declares no rule"]
    assert run.loop.stretches() is None


@pytest.mark.parametrize(
    ("over", "obstacle"),
    [
        ({"monitor": {"detectors": [part("Jumpy")]}}, "detector monitor.0 Jumpy declares no rule"),
        ({"plan": part("Gentle")}, "planner Gentle declares no rule"),
        ({"plan": {"name": "morphin", "schedule": part("Halved")}}, "schedule Halved declares no rule"),
    ],
)
def test_a_rule_that_is_inherited_is_not_taken_for_that_of_the_subclass(over, obstacle):
    run, _ = alike(merge(RULED, over), RUN, make=ruled())
    assert run.loop.obstacles() == [obstacle]
    with pytest.raises(ConfigError, match=rf"engine 'compiled' needs rules that can be compiled, and {obstacle}\."):
        Run(merge(RULED, over), ["compiled"], make=ruled()).run(1)


class Misspelt(PageHinkley):
    @property
    def quiet(self):
        return self._rule


class MisspeltSchedule(Exponential):
    @property
    def quiet(self):
        return self._rule


@pytest.mark.parametrize(
    ("name", "over"),
    [
        ("Misspelt", {"monitor": {"detectors": ["test_mape_stretch_rare:Misspelt"]}}),
        ("MisspeltSchedule", {"plan": {"name": "morphin", "schedule": "test_mape_stretch_rare:MisspeltSchedule"}}),
    ],
)
def test_a_part_that_raises_when_it_is_asked_for_its_rule_is_not_taken_for_one_without(name, over):
    with pytest.raises(PartError, match=rf"^{name} raised AttributeError: '{name}' object has no attribute '_rule'"):
        Run(merge(RULED, over), ["auto"], make=ruled()).run(1)
    plain = Run(merge(RULED, over), ["python"], make=ruled())
    plain.run(3)
    assert plain.loop.log.passes == 3


class Counted(PageHinkley):
    """Counts the calls of its `update`, which its rule does not."""

    calls = 0
    quiet = PageHinkley.quiet

    def update(self, x):
        self.calls += 1
        return super().update(x)


def test_quiet_passes_are_made_without_a_call_of_the_parts():
    table = watched({"name": "test_mape_stretch_rare:Counted", "threshold": 20.0}, {"name": "oracle", "episodes": [33]})
    run, plain = alike(table, [("run", 400)], make=ruled())
    alarms = int(rows_of(run)["alarm"].any(axis=1).sum())
    counted, called = (one.loop.monitor.detectors[0][1].calls for one in (run, plain))
    assert called == 400
    assert 1 < alarms < 40
    # After an alarm comes a plan with which the detectors are as they were; no further pass is made by the components.
    assert counted == alarms


def test_parts_with_and_without_a_rule_take_turns():
    swaps = [
        {"pass": 11, "part": "monitor", "to": part("Jumpy")},
        {"pass": 23, "part": "plan.schedule", "to": part("Halved")},
        {"pass": 35, "part": "monitor", "to": "page_hinkley"},
        {"pass": 36, "part": "plan.schedule", "to": "exponential"},
        {"pass": 48, "part": "plan", "to": {"name": "q_learning", "alpha": 0.7}},
    ]
    run, _ = alike(watched("page_hinkley", swap=swaps), RUN, make=ruled())
    assert len(run.swaps) == 5
    assert run.loop.obstacles() == []


# Numbers at the ends of their range

LEAST, HUGE = 5e-324, 1e160
WATCHING = [
    {"name": "page_hinkley", "signal": "return", "delta": 0.0, "threshold": 1e300},
    {"name": "two_window", "signal": "return", "reference": 4, "recent": 2},
    {"name": "two_window", "signal": "td_error", "reference": 4, "recent": 2},
]


@pytest.mark.parametrize(
    ("reward", "goals"),
    [
        (-0.0, (-0.0, -0.0)),
        (0.0, (-0.0, 0.0)),
        (LEAST, (-LEAST, 1e-310)),
        (-1e-300, (1e300, -1e-300)),
        (0.0, (HUGE, -HUGE)),
        (HUGE, (0.0, 0.0)),
        (-HUGE, (HUGE, math.nextafter(HUGE, 0.0))),
        (2.0**53, (1.0, -1.0)),
    ],
)
def test_rewards_at_the_ends_of_their_range_leave_the_same_bits(reward, goals):
    learner = {"name": "q_learning", "discount": 1.0}
    run, _ = alike(watched(*WATCHING, learner=learner), [("run", 90)], make=ruled(reward=reward, goals=goals))
    assert run.loop.obstacles() == []


def test_a_page_hinkley_sum_that_overflows_is_refused_at_its_pass():
    # Goals far above the mean before them: the sum falls below all numbers, and its height above its minimum is NaN.
    table = watched(WATCHING[0], learner={"name": "q_learning", "discount": 0.0})
    run, _ = alike(table, [("run", 400)], make=ruled(goals=(1.5e308, 1.5e308), cells=12))
    assert run.errors[0].startswith("PartError: detector PageHinkley raised ValueError: its statistic is nan, not a")
    assert 1 < run.loop.log.passes < 400


def test_a_window_that_takes_over_fewer_values_than_it_holds_reads_the_same_until_it_is_full():
    longer = {"name": "two_window", "reference": 8, "recent": 4, "threshold": 1e9}
    shorter = {**longer, "reference": 3, "recent": 2}
    alike(watched(shorter, swap=[{"pass": 21, "part": "monitor", "to": longer}]), RUN, make=ruled())


# Actions

FOREVER = (1, ALWAYS)


@pytest.mark.parametrize(
    "windows",
    [
        {0: FOREVER, 1: (20, ALWAYS)},
        {1: FOREVER, 0: (20, 40)},
        {0: (1, 30), 1: (20, ALWAYS), 2: (25, 50)},
        {0: FOREVER, 1: (1, 20), 64: FOREVER, 130: (25, 40), 65: (30, ALWAYS)},
        {63: FOREVER, 64: FOREVER, 127: FOREVER, 128: FOREVER, 191: (7, 8)},
    ],
)
def test_tables_of_one_row_and_actions_of_many_words_come_and_go(windows):
    table, script = merge(RULED, {"system": {"max_actions": 192}}), [*RUN, ("elsewhere",), *RUN]
    run, _ = alike(table, script, engines=("auto", "auto"), make=ruled(windows=windows))
    for row in rows_of(run):
        number = int(row["pass"])
        offered = {action for action, (first, last) in windows.items() if first <= number <= last}
        assert set(actions_of(row["available"])) == offered
    assert set(run.loop.execute.q_table.actions) == offered


def test_actions_that_a_planner_leaves_out_of_the_table_are_news_in_each_pass():
    windows = {0: FOREVER, 1: (1, 40), 2: (20, ALWAYS)}
    run, _ = alike(RULED | {"plan": part("Headstrong", follows=False)}, RUN, make=ruled(windows=windows))
    rows = rows_of(run)
    assert [actions_of(mask) for mask in rows["added"]] == [()] * 19 + [(2,)] * 41
    assert [actions_of(mask) for mask in rows["removed"]] == [()] * 40 + [(1,)] * 20


# Signals, loops, listeners


def test_signals_of_the_systems_own_are_watched():
    detectors = [{"name": "page_hinkley", "signal": f"arrivals_{k}", "delta": 0.0, "threshold": 3.0} for k in (1, 2)]
    run, _ = alike(merge(TRAFFIC, {"monitor": {"detectors": detectors}}), [("run", 200)])
    alarms = rows_of(run)["alarm"].sum(axis=0)
    assert (alarms > 2).all()
    assert (alarms < 100).all()


def test_the_loops_of_a_trial_are_apart():
    table = merge(GRID, {"loops": 3})
    runs = [alike(table, RUN, trial=1, loop=loop)[0] for loop in range(3)]
    assert [run.loop.log.window[-1].plan.loop for run in runs] == [3, 4, 5]
    assert len({run.loop.execute.q_table.sha256() for run in runs}) == 3


def test_a_listener_of_rows_may_ask_for_traces():
    def run(engine):
        one = Run(RULED, [engine], make=ruled())
        one.loop.log.on_rows(lambda rows: one.trace(int(rows["pass"][-1]) + 2, 3))
        one.run(1200)
        return one

    compiled, plain = run("auto"), run("python")
    assert [number for number, _ in plain.traces] == [514, 515, 516, 1026, 1027, 1028]
    assert compiled.seen() == plain.seen()


def test_who_listens_between_two_runs_hears_every_record_from_then_on():
    run, _ = alike(RULED, [*RUN, ("listen",), *RUN], make=ruled())
    assert len(run.records) == 240


class Stopped(BaseException):
    """Neither a part's fault nor the system's."""


@pytest.mark.parametrize("raised", [RuntimeError, KeyboardInterrupt, Stopped])
@pytest.mark.parametrize("segment", [1, 7, 64])
@pytest.mark.parametrize("engine", ["auto", "python"])
def test_a_listener_of_rows_that_raises_loses_nothing_and_the_run_goes_on(monkeypatch, engine, segment, raised):
    monkeypatch.setattr("knowledge.log.SEGMENT", segment)
    chosen = config(GRID, episodes=150, execute={"engine": engine})
    whole, loop, heard, also, calls = loop_of(chosen), loop_of(chosen), [], [], []

    def hear(rows):
        calls.append(len(rows))
        if len(calls) % 3 == 1:
            raise raised("not now")
        heard.extend(rows["pass"].tolist())

    loop.log.on_rows(lambda rows: also.extend(rows["pass"].tolist()))
    loop.log.on_rows(hear)
    failed = 0
    while loop.log.passes < 150:
        passes = loop.log.passes
        try:
            loop.run(150 - loop.execute.passes)
        except raised:
            failed += 1
            assert loop.log.passes == loop.execute.passes >= passes
    with pytest.raises(raised) if len(calls) % 3 == 0 else contextlib.nullcontext():
        loop.log.flush()
    loop.log.flush()
    whole.run(150)
    assert failed > 0
    assert heard == also == list(range(1, 151))
    assert hashes(loop) == hashes(whole)
    assert list(loop.log.window) == list(whole.log.window)


# Ctrl-C


@pytest.mark.filterwarnings("ignore:Cannot cache compiled function:numba.core.errors.NumbaWarning")
@pytest.mark.parametrize("alarm_at", [0, 34, 50])
@pytest.mark.parametrize("at", [2, 33])
def test_ctrl_c_during_a_compiled_stretch_is_heard_after_it_and_the_run_goes_on(at, alarm_at):
    interrupting = {"name": "interrupting_rule:Interrupting", "at": at}
    table = watched(interrupting, part("Watch", at=alarm_at, does=own.ALARMS))
    run = Run(table, ["auto"], make=ruled())
    with pytest.raises(KeyboardInterrupt):
        run.run(60)
    assert run.loop.log.passes == run.loop.execute.passes == (alarm_at or 60)
    run.run(60 - run.loop.log.passes)
    interrupting["at"] = 0
    whole = Run(table, ["auto"], make=ruled())
    whole.run(60)
    assert run.seen() == whole.seen()


@pytest.mark.filterwarnings("ignore:Cannot cache compiled function:numba.core.errors.NumbaWarning")
def test_ctrl_c_in_a_stretch_that_ends_with_a_failing_episode_goes_before_the_failure():
    run = Run(watched({"name": "interrupting_rule:Interrupting", "at": 20}), ["auto"], make=ruled(33, own.BREAKS))
    with pytest.raises(KeyboardInterrupt):
        run.run(60)
    with pytest.raises(ManagedSystemError, match="the wheel came off, in episode 33"):
        run.run(60)
    whole = Run(RULED, ["python"], make=ruled())
    whole.run(32)
    assert run.loop.execute.q_table.sha256() == whole.loop.execute.q_table.sha256()
