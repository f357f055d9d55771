import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from mape_runs import GRID, TRAFFIC, Corridor, Standing, config, corridor_loop, hashes, loop_of

from knowledge import ChangePlan, Knowledge, Log, QTable, RowLayout
from mape.errors import ConfigError, ManagedSystemError, NonFiniteError, PartError
from mape.execute import Execute
from mape.execute.component import SIGNALS
from mape.execute.rules import alpha_star
from mape.registry import build
from mape.specs import PartSpec


def once(episode, step, **spoilt):
    """Spoil that step of that episode the first time that it comes."""
    left = [spoilt]
    return lambda e, s: left.pop() if (e, s) == (episode, step) and left else {}


def failing(error, episode, step):
    left = [error]

    def spoil(e, s):
        if (e, s) == (episode, step) and left:
            raise left.pop()
        return {}

    return spoil


def after(passes, corridor=None, **over):
    loop = corridor_loop(corridor, **over)
    loop.run(passes)
    return loop


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_reward_that_is_not_finite_is_refused_by_its_value_and_nothing_of_the_episode_is_learnt(bad):
    before = hashes(after(3))
    loop = after(3, Corridor(spoil=once(4, 2, reward=bad)))
    with pytest.raises(
        NonFiniteError, match=rf"corridor gave reward {bad} for action [01] in episode 4 at step 2; .*3 passes"
    ):
        loop.run(1)
    assert hashes(loop) == before
    assert loop.execute.passes == loop.log.passes == 3


def test_a_system_that_raises_leaves_the_q_table_as_before_the_episode():
    before = hashes(after(3))
    loop = after(3, Corridor(spoil=failing(ZeroDivisionError("oh"), 4, 2)))
    with pytest.raises(ManagedSystemError, match="corridor raised ZeroDivisionError: oh, in episode 4 at step 2"):
        loop.run(1)
    assert hashes(loop) == before


def test_values_that_an_episode_wrote_many_times_are_as_before_it_when_it_fails():
    before = hashes(after(3, Standing()))
    loop = after(3, Standing(spoil=once(4, 11, reward=math.nan)))
    with pytest.raises(NonFiniteError, match="in episode 4 at step 11"):
        loop.run(1)
    assert hashes(loop) == before


def test_an_interrupt_leaves_the_q_table_as_before_the_episode_and_goes_through():
    before = hashes(after(3))
    loop = after(3, Corridor(spoil=failing(KeyboardInterrupt(), 4, 2)))
    with pytest.raises(KeyboardInterrupt):
        loop.run(1)
    assert hashes(loop) == before


@pytest.mark.parametrize("failures", [1, 2])
@pytest.mark.parametrize("episode", [1, 4])
def test_a_run_that_goes_on_after_a_failed_episode_is_the_run_without_the_failure(episode, failures):
    left = [ZeroDivisionError("oh")] * failures

    def spoil(e, s):
        if (e, s) == (episode, 2) and left:
            raise left.pop()
        return {}

    loop = corridor_loop(Corridor(spoil=spoil))
    loop.run(episode - 1)
    fresh = QTable((0, 1), loop.system.n_states)
    for _ in range(failures):
        before = fresh.sha256() if episode == 1 else loop.execute.q_table.sha256()
        with pytest.raises(ManagedSystemError):
            loop.run(1)
        assert loop.execute.q_table.sha256() == before
    loop.run(10 - episode + 1)
    assert hashes(loop) == hashes(after(10))


def test_a_reset_that_raises_is_named_and_can_be_tried_again():
    def offers(episode, left=[1]):  # noqa: B006 (remembers that it has raised)
        if episode == 3 and left:
            left.pop()
            raise OSError("gone")
        return 0, 1

    loop = after(2, Corridor(offers=offers))
    with pytest.raises(
        ManagedSystemError, match=r"corridor raised OSError: gone, at the reset of episode 3\. The 2 passes"
    ):
        loop.run(1)
    loop.run(3)
    assert hashes(loop) == hashes(after(5))


@pytest.mark.parametrize("state", [-1, 5, 10**9])
def test_a_state_outside_the_table_is_refused_and_nothing_of_the_episode_is_learnt(state):
    before = hashes(after(3))
    loop = after(3, Corridor(spoil=once(4, 2, state=state)))
    with pytest.raises(
        ManagedSystemError, match=rf"went to state {state} in episode 4 at step 2; its states are 0 \.\. 4"
    ):
        loop.run(1)
    assert hashes(loop) == before


@pytest.mark.parametrize("engine", ["compiled", "python"])
def test_q_values_that_diverge_are_refused_with_the_td_error_by_both_engines(engine):
    options = {"size": [1, 3], "start": [0, 1], "goals": [[0, 2], [0, 0]], "switch_at": [4], "max_steps": 1}
    huge = {"goal_reward": 1.7e308, "step_reward": -1.7e308}
    chosen = config(
        system={"options": options | huge},
        monitor={"detectors": []},
        plan={"name": "q_learning", "alpha": 1.0, "schedule": {"name": "constant", "epsilon": 1.0}},
        execute={"engine": engine},
    )
    loop = loop_of(chosen)
    with pytest.raises(NonFiniteError, match=r"the TD error became -?inf in episode \d+ at step 1"):
        loop.run(30)
    assert np.isfinite(loop.execute.q_table.values).all()
    assert loop.log.passes == loop.execute.passes >= 3


@pytest.mark.parametrize("engine", ["compiled", "python"])
def test_a_return_that_overflows_is_refused_though_each_reward_is_finite(engine):
    options = {
        "size": [1, 9],
        "start": [0, 0],
        "goals": [[0, 8]],
        "switch_at": [],
        "max_steps": 5,
        "step_reward": -1e308,
    }
    chosen = config(
        system={"options": options}, monitor={"detectors": []}, plan={"name": "q_learning"}, execute={"engine": engine}
    )
    loop = loop_of(chosen)
    before = loop.execute.q_table.sha256()
    with pytest.raises(NonFiniteError, match="the return of episode 1 became -inf"):
        loop.run(1)
    assert loop.execute.q_table.sha256() == before


@pytest.mark.parametrize("when", [1, 4])
def test_a_system_without_any_action_is_refused(when):
    system = Corridor(offers=lambda episode: () if episode == when else (0, 1))
    with pytest.raises(ManagedSystemError, match=f"offers no action in episode {when}"):
        after(5, system)


@pytest.mark.parametrize("bad", [-1, 8, 1000])
@pytest.mark.parametrize("when", [1, 4])
def test_an_action_id_that_no_record_holds_is_refused_with_the_way_out(bad, when):
    system = Corridor(offers=lambda episode: (0, bad) if episode == when else (0, 1))
    way_out = "Raise system.max_actions" if bad > 0 else "Let its action space begin at 0"
    with pytest.raises(ManagedSystemError, match=f"offers action {bad} in episode {when}; .* from 0 to 7. {way_out}"):
        after(5, system, system={"max_actions": 8})


def test_an_action_that_is_offered_twice_is_refused():
    with pytest.raises(ManagedSystemError, match="name each action once"):
        after(1, Corridor(offers=lambda episode: (0, 1, 0)))


def test_an_action_set_without_a_known_action_is_refused():
    with pytest.raises(ManagedSystemError, match="of which the Q-table knows none"):
        after(5, Corridor(offers=lambda episode: (0, 1) if episode < 4 else (2, 3)))


@pytest.mark.parametrize("base", [GRID, TRAFFIC], ids=["gridworld", "junction"])
def test_a_table_that_grows_keeps_what_was_learnt_and_starts_new_rows_at_zero(base):
    new = {"jump_from": 6} if base is GRID else {"reserve_from": 6}
    plain = loop_of(config(base, monitor={"detectors": []}))
    loop = loop_of(config(base, monitor={"detectors": []}, system={"options": new}))
    known = loop.execute.q_table.actions
    loop.run(6)
    plain.run(6)
    added = tuple(a for a in loop.execute.q_table.actions if a not in known)
    assert added == ((4, 5, 6, 7) if base is GRID else (3, 4))
    assert loop.execute.q_table.values[: len(known)].tobytes() == plain.execute.q_table.values.tobytes()
    assert not loop.execute.q_table.values[len(known) :].any()
    sixth = loop.log.window[5]
    assert (sixth.observation.known, sixth.request.added, sixth.plan.add) == (known, added, added)
    loop.run(4)
    assert loop.execute.q_table.values[len(known) :].any()
    assert loop.log.window[6].observation.known == (*known, *added)


def test_an_action_that_appears_is_not_tried_in_the_episode_that_reports_it():
    tried = {}
    loop = corridor_loop(Corridor(offers=lambda episode: (0, 1) if episode < 4 else (0, 1, 2)))
    loop.execute.record_trace(1, 9, lambda number, trace: tried.setdefault(number, set(trace[:, 1].tolist())))
    loop.run(9)
    assert 2.0 not in tried[4]
    assert 2.0 in set().union(*(tried[n] for n in range(5, 10)))


def test_an_action_set_that_shrinks_drops_its_rows_and_the_others_are_kept():
    offers = {1: (0, 1, 2), 4: (0, 2)}
    tried = {}
    system = Corridor(offers=lambda episode: offers[4 if episode >= 4 else 1])
    loop = corridor_loop(system)
    loop.execute.record_trace(1, 9, lambda number, trace: tried.setdefault(number, set(trace[:, 1].tolist())))
    loop.run(3)
    assert loop.execute.q_table.actions == (0, 1, 2)
    loop.run(1)
    assert loop.execute.q_table.actions == loop.knowledge.actions == (0, 2)
    fourth = loop.log.window[3]
    assert (fourth.observation.available, fourth.observation.known) == ((0, 2), (0, 1, 2))
    assert (fourth.request.removed, fourth.plan.drop) == ((1,), (1,))
    loop.run(5)
    assert 1.0 in tried[3]
    assert all(1.0 not in tried[n] for n in range(4, 10))


def test_reserve_actions_are_enabled_when_a_plan_says_so_and_are_no_news_afterwards():
    chosen = config(TRAFFIC, monitor={"detectors": [{"name": "oracle", "episodes": [3]}]})
    loop = loop_of(chosen)
    loop.run(5)
    third, fourth = loop.log.window[2], loop.log.window[3]
    assert (third.plan.enable, third.plan.add) == ((3, 4), (3, 4))
    assert fourth.observation.available == fourth.observation.known == (0, 1, 2, 3, 4)
    assert fourth.request.added == ()


def test_enabling_what_the_system_does_not_hold_is_the_plans_fault():
    chosen = config(
        monitor={"detectors": [{"name": "oracle", "episodes": [2]}]}, plan={"name": "morphin", "enable_on_drift": [9]}
    )
    with pytest.raises(PartError, match=r"plan 2 cannot be executed: .*no actions in reserve"):
        loop_of(chosen).run(3)


class Rememberer:
    """Remembers the table of pass 3 and takes it up again at pass 6."""

    def __init__(self, schedule):
        self.epsilon = schedule.epsilon

    def start(self, loop):
        return ChangePlan(loop, 0, 0.5, (0.1, 0.9, 5.0), (), (), (), False, None)

    def plan(self, request, knowledge):
        number, adopt = request.pass_no, None
        if number == 3:
            self.key = knowledge.remember(knowledge.q_table())
        if number == 6:
            adopt = self.key
        if number == 8:
            adopt = "0" * 64
        return ChangePlan(request.loop, number, 0.5, (0.1, 0.9, 5.0), request.added, request.removed, (), False, adopt)

    def state(self):
        return None

    def restore(self, state):
        pass


def test_a_remembered_table_can_be_adopted_by_its_hash(monkeypatch):
    monkeypatch.setitem(sys.modules, "rememberer", SimpleNamespace(Rememberer=Rememberer))
    loop = loop_of(config(plan={"name": "rememberer:Rememberer"}, monitor={"detectors": []}))
    loop.run(3)
    third = loop.execute.q_table.copy()
    loop.run(2)
    assert loop.execute.q_table.sha256() != third.sha256()
    loop.run(1)
    assert loop.execute.q_table.sha256() == third.sha256()
    loop.run(1)
    change = np.abs(loop.execute.q_table.values - third.values).max()
    assert loop.log.window[-1].observation.signals["q_change"] == change > 0
    with pytest.raises(PartError, match=r"plan 8 cannot be executed: .*no Q-table 000000000000"):
        loop.run(1)


def execute_on(system, unit=0, **arguments):
    knowledge = Knowledge(Log(RowLayout(SIGNALS + system.signal_names, 0, 3), unit))
    sent = []
    learner = build("learner", PartSpec(name="q_learning"))
    return Execute(system, learner, knowledge, sent.append, **arguments), sent, knowledge


def first_plan(**fields):
    return ChangePlan(0, 0, 1.0, (0.1, 0.99, 5.0), (), (), (), False, None)._replace(**fields)


def test_there_is_no_episode_without_a_plan():
    execute, sent, _ = execute_on(Corridor())
    with pytest.raises(PartError, match="no plan is in force"):
        execute.drive()
    assert sent == []


def test_a_plan_with_another_number_of_learning_rates_is_refused_with_their_names():
    execute, _, _ = execute_on(Corridor())
    with pytest.raises(PartError, match="has 1 learning-rate parameters; the learner takes 3: alpha, alpha_max, k"):
        execute.adopt(first_plan(learning_rate=(0.1,)))


@pytest.mark.parametrize("fields", [{"drop": (7,)}, {"adopt": "0" * 64}])
def test_a_plan_that_cannot_be_executed_changes_nothing(fields):
    execute, _, knowledge = execute_on(Corridor())
    with pytest.raises(PartError, match="plan 0 cannot be executed"):
        execute.adopt(first_plan(add=(5,), **fields))
    before = QTable((0, 1), 5).sha256()
    assert (execute.q_table.sha256(), knowledge.actions) == (before, (0, 1))


def test_a_remembered_table_of_another_system_is_refused():
    execute, _, knowledge = execute_on(Corridor())
    key = knowledge.remember(QTable((0, 1), 9))
    with pytest.raises(PartError, match="adopts a Q-table of 9 states; corridor has 5"):
        execute.adopt(first_plan(adopt=key))


def test_the_compiled_engine_needs_rules():
    with pytest.raises(ConfigError, match="engine 'compiled' needs a system that offers its rules; corridor does not"):
        execute_on(Corridor(), engine="compiled")


def test_knowledge_reads_a_copy_of_the_table_at_the_end_of_the_last_episode():
    execute, _, knowledge = execute_on(Corridor())
    execute.adopt(first_plan())
    execute.drive()
    copy = knowledge.q_table()
    assert copy.sha256() == execute.q_table.sha256()
    copy.values[:] = 7.0
    assert knowledge.q_table().sha256() == execute.q_table.sha256() != copy.sha256()


def test_the_signals_are_return_steps_td_error_and_change_and_then_the_systems_own():
    execute, sent, _ = execute_on(Corridor(signal_names=("cell",)), max_actions=8)
    rows = []
    execute.record_trace(1, 1, lambda number, trace: rows.extend(trace.tolist()))
    execute.adopt(first_plan())
    before = np.zeros((2, 5))
    execute.drive()
    signals = sent[0].signals
    assert list(signals) == [*SIGNALS, "cell"]
    assert signals["steps"] == sent[0].steps == len(rows)
    assert signals["td_error"] == pytest.approx(np.mean([abs(row[4]) for row in rows]), rel=1e-12)
    assert signals["q_change"] == np.abs(execute.q_table.values - before).max()
    reached = [row[0] for row in rows[1:]]
    ended = rows[-1][0] == 3.0 and rows[-1][1] == 1.0
    last = 4.0 if ended else max(rows[-1][0] + (1.0 if rows[-1][1] else -1.0), 0.0)
    assert signals["cell"] == pytest.approx(np.mean([*reached, last]), rel=1e-12)
    assert signals["return"] == (10.0 - (len(rows) - 1) if ended else -float(len(rows)))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_signal_that_is_not_finite_is_refused_and_nothing_of_the_episode_is_learnt(bad):
    execute, sent, _ = execute_on(Corridor(signal_names=("cell",), spoil=once(3, 1, signal=bad)))
    execute.adopt(first_plan())
    execute.drive()
    execute.drive()
    before = execute.q_table.sha256()
    with pytest.raises(NonFiniteError, match=f"corridor gave cell = {bad} in episode 3; signals are finite"):
        execute.drive()
    assert (execute.q_table.sha256(), len(sent), execute.passes) == (before, 2, 2)


def test_an_observation_says_under_which_plan_the_episode_was_driven():
    execute, sent, _ = execute_on(Corridor(), unit=4)
    execute.adopt(first_plan())
    execute.drive()
    execute.adopt(first_plan(pass_no=1, epsilon=0.25, reset_detector=True))
    execute.drive()
    execute.drive()
    assert [(o.loop, o.pass_no, o.plan, o.epsilon, o.reset_detector) for o in sent] == [
        (4, 1, 0, 1.0, False),
        (4, 2, 1, 0.25, True),
        (4, 3, 1, 0.25, True),
    ]


def test_each_episode_gets_a_seed_and_a_number_of_its_own_by_seed_loop_and_trial():
    def begun(**arguments):
        system = Corridor()
        execute, _, _ = execute_on(system, **arguments)
        execute.adopt(first_plan())
        for _ in range(5):
            execute.drive()
        return [(e.number, e.seed) for e in system.begun]

    assert [number for number, _ in begun()] == [1, 2, 3, 4, 5]
    assert begun() == begun()
    runs = [begun(), begun(seed=1), begun(trial=1), begun(loop=1)]
    assert len({seed for run in runs for _, seed in run}) == 20


@pytest.mark.parametrize("engine", ["compiled", "python"])
@pytest.mark.parametrize("base", [GRID, TRAFFIC], ids=["gridworld", "junction"])
def test_the_steps_of_a_trace_lead_from_one_q_table_to_the_next(base, engine):
    loop = loop_of(config(base, monitor={"detectors": []}, execute={"engine": engine}))
    traces = {}
    loop.execute.record_trace(3, 6, lambda number, trace: traces.setdefault(number, trace.copy()))
    loop.run(2)
    table = loop.execute.q_table.copy()
    for number in range(3, 7):
        loop.run(1)
        seen, chosen = loop.log.window[-1].observation, loop.log.window[-2].plan
        assert len(traces[number]) == seen.steps
        row_of = {action: row for row, action in enumerate(table.actions)}
        for state, action, exploratory, q, td_error, alpha in traces[number].tolist():
            at = row_of[int(action)], int(state)
            if not exploratory:
                assert table.values[at] == table.values[:, at[1]].max()
            assert alpha == alpha_star(td_error, chosen.learning_rate)
            table.values[at] += alpha * td_error
            assert q == table.values[at]
        assert table.sha256() == loop.execute.q_table.sha256()
    assert sorted(traces) == [3, 4, 5, 6]


def test_the_mask_limits_the_greedy_choice_too_where_config_says_so():
    def greedy_moves_against_walls(mask_greedy):
        options = {"size": [3, 3], "start": [0, 0], "goals": [[2, 2]], "switch_at": [], "step_reward": 1.0}
        chosen = config(
            system={"options": options},
            monitor={"detectors": []},
            plan={"name": "q_learning", "schedule": {"name": "constant", "epsilon": 0.0}},
            execute={"mask_greedy": mask_greedy},
        )
        loop = loop_of(chosen)
        rows = []
        loop.execute.record_trace(1, 5, lambda number, trace: rows.extend(trace.tolist()))
        loop.run(5)
        moves = loop.system.rules.params.moves
        return sum(moves[int(row[1]), int(row[0])] == row[0] for row in rows)

    assert greedy_moves_against_walls(mask_greedy=False) > 0
    assert greedy_moves_against_walls(mask_greedy=True) == 0


def test_a_system_with_the_ports_members_alone_runs_and_is_reset_once_per_episode():
    corridor = Corridor()
    loop = corridor_loop(corridor)
    loop.run(5)
    assert [episode.number for episode in corridor.begun] == [1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    "refused",
    [
        {"drop": (1,), "learning_rate": (0.1, 0.2)},
        {"drop": (1,), "learning_rate": (math.nan, 0.9, 5.0)},
        {"add": (5,), "drop": (0, 1)},
        {"drop": (1,), "adopt": "ab" * 32},
    ],
)
def test_a_plan_that_is_refused_changes_nothing(refused):
    loop = corridor_loop()
    loop.run(2)
    execute = loop.execute
    before = (execute.plan, execute.q_table.actions, execute.q_table.sha256(), loop.knowledge.actions)
    with pytest.raises(PartError, match="plan 3"):
        execute.adopt(execute.plan._replace(pass_no=3, **refused))
    assert (execute.plan, execute.q_table.actions, execute.q_table.sha256(), loop.knowledge.actions) == before
    loop.run(3)
    assert loop.log.passes == 5


def test_a_system_that_raises_while_it_enables_is_named():
    class Stuck(Corridor):
        def enable(self, actions):
            raise RuntimeError("relay stuck")

    loop = corridor_loop(Stuck())
    loop.run(1)
    with pytest.raises(ManagedSystemError, match=r"corridor raised RuntimeError: relay stuck.*\(7,\) of plan 2"):
        loop.execute.adopt(loop.execute.plan._replace(pass_no=2, add=(7,), enable=(7,)))
    assert loop.execute.q_table.actions == (0, 1)
