import numpy as np
import pytest
from mape_runs import GRID, TRAFFIC, Standing, config, corridor_loop, hashes, loop_of

from adapters.systems import make_system
from knowledge import STAGES, ChangePlan, Log, RowLayout
from mape.bus import LocalBus
from mape.errors import BusError, ConfigError
from mape.trials import run_trial


@pytest.mark.parametrize("base", [GRID, TRAFFIC], ids=["gridworld", "junction"])
def test_a_pass_is_its_four_records_in_their_order(base):
    loop = loop_of(config(base))
    assert loop.advance() == loop.log.find(ChangePlan, 0)
    for number in range(1, 4):
        for kind in STAGES:
            record = loop.advance()
            assert (type(record), record.loop, record.pass_no) == (kind, 0, number)
            assert record is loop.log.find(kind, number)
    assert loop.log.passes == 3


def test_advancing_record_by_record_is_the_same_as_running():
    stepped, ran = loop_of(config()), loop_of(config())
    for _ in range(1 + 4 * 6):
        stepped.advance()
    ran.run(6)
    assert hashes(stepped) == hashes(ran)


def test_observation_n_is_episode_n_under_plan_n_minus_1():
    loop = loop_of(config())
    loop.run(10)
    plans = [loop.log.find(ChangePlan, 0), *(finished.plan for finished in loop.log.window)]
    for number, (seen, symptom, request, plan) in enumerate(loop.log.window, 1):
        assert {r.pass_no for r in (seen, symptom, request, plan)} == {number}
        assert (seen.plan, seen.epsilon) == (number - 1, plans[number - 1].epsilon)
        assert seen.reset_detector == plans[number - 1].reset_detector


@pytest.mark.parametrize("base", [GRID, TRAFFIC], ids=["gridworld", "junction"])
def test_the_same_seed_gives_the_same_hashes_and_another_seed_trial_or_loop_another(base):
    def run(seed=0, **arguments):
        loop = loop_of(config(base, seed=seed, loops=2), **arguments)
        loop.run(10)
        return hashes(loop)

    assert run() == run()
    assert run(trial=3) == run(trial=3)
    runs = [run(), run(seed=1), run(trial=1), run(trial=2)]
    assert len({log for log, _ in runs}) == len({table for _, table in runs}) == 4
    assert run(loop=1)[1] not in {table for _, table in runs}


def test_runs_cut_into_pieces_are_the_run_in_one_piece():
    pieces, whole = loop_of(config()), loop_of(config())
    for passes in (1, 0, 3, 6):
        pieces.run(passes)
    whole.run(10)
    assert hashes(pieces) == hashes(whole)


def test_uniforms_are_the_same_stream_whether_drawn_at_once_or_pass_by_pass(monkeypatch):
    whole = loop_of(config(TRAFFIC))
    whole.run(10)
    for at_once in (1, 100):
        monkeypatch.setattr("mape.execute.uniforms.DRAWS_AT_ONCE", at_once)
        parts = loop_of(config(TRAFFIC))
        parts.run(10)
        assert hashes(parts) == hashes(whole)


@pytest.mark.parametrize("engine", ["compiled", "python"])
@pytest.mark.parametrize("base", [GRID, TRAFFIC], ids=["gridworld", "junction"])
def test_q_change_is_the_largest_change_of_the_table_over_the_episode(base, engine):
    loop = loop_of(config(base, execute={"engine": engine}))
    for _ in range(10):
        before = loop.execute.q_table.copy()
        loop.run(1)
        after = loop.execute.q_table
        kept = [after.actions.index(action) for action in before.actions]
        change = np.abs(after.values[kept] - before.values).max()
        assert loop.log.window[-1].observation.signals["q_change"] == change > 0.0


def test_a_rise_and_a_fall_of_one_value_within_an_episode_count_from_end_to_end():
    loop = corridor_loop(Standing(), learner={"name": "q_learning", "discount": 0.0})
    rows = []
    loop.execute.record_trace(1, 1, lambda number, trace: rows.extend(trace.tolist()))
    loop.run(1)
    change = loop.log.window[0].observation.signals["q_change"]
    assert change == np.abs(loop.execute.q_table.values).max()
    assert max(abs(td_error * alpha) for *_, td_error, alpha in rows) > change


def test_a_detector_on_a_signal_that_the_run_does_not_have_is_refused_before_the_run():
    chosen = config(monitor={"detectors": [{"name": "page_hinkley", "signal": "arrivals_1"}]})
    with pytest.raises(ConfigError, match="watches signal 'arrivals_1'; mapek/Gridworld-v0 has return, steps"):
        loop_of(chosen)


def test_a_detector_may_watch_a_signal_of_the_systems_own():
    chosen = config(TRAFFIC, monitor={"detectors": [{"name": "two_window", "signal": "arrivals_2"}]})
    loop = loop_of(chosen)
    loop.run(2)
    seen, symptom, *_ = loop.log.window[-1]
    assert symptom.readings[0].value == seen.signals["arrivals_2"]


def test_a_drift_of_the_reward_is_met_in_the_pass_that_sees_it():
    chosen = config(monitor={"detectors": [{"name": "oracle", "episodes": [4]}]})
    loop = loop_of(chosen)
    loop.run(6)
    fourth = loop.log.window[3]
    assert fourth.symptom.readings[0].alarm
    assert [drift.signal for drift in fourth.request.drifts] == ["return"]
    assert fourth.plan.epsilon == loop.log.window[4].observation.epsilon == 1.0
    assert [finished.plan.epsilon == 1.0 for finished in loop.log.window] == [False] * 3 + [True] + [False] * 2


def test_new_actions_reset_the_detector_before_the_next_observation():
    chosen = config(
        system={"options": {"jump_from": 4}}, monitor={"detectors": [{"name": "page_hinkley", "threshold": 1e6}]}
    )
    loop = loop_of(chosen)
    loop.run(6)
    assert [finished.observation.reset_detector for finished in loop.log.window] == [False] * 4 + [True, False]
    assert loop.monitor.detectors[0][1].state()["n"] == 2.0


@pytest.mark.parametrize("engine", ["compiled", "python"])
def test_every_loop_of_a_trial_has_a_stream_of_its_own_and_its_units_number_in_the_records(engine):
    chosen = config(TRAFFIC, trials=2, loops=3, execute={"engine": engine})
    found = {}
    for trial in range(2):
        for number in range(3):
            loop = loop_of(chosen, trial=trial, loop=number)
            loop.run(6)
            found[hashes(loop)] = chosen.unit(trial, number)
            assert {record.loop for finished in loop.log.window for record in finished} == {3 * trial + number}
    assert list(found.values()) == list(range(6))


def test_the_first_loop_of_each_trial_is_the_trial_without_others():
    for trial in range(2):
        alone = loop_of(config(trials=2), trial=trial)
        first = loop_of(config(trials=2, loops=5), trial=trial)
        alone.run(8)
        first.run(8)
        assert hashes(alone) == hashes(first)


def test_a_trial_says_which_of_its_loops_it_ran_and_what_swaps_have_handed_over():
    swaps = [{"pass": 2, "part": "plan", "to": "morphin"}, {"pass": 3, "part": "plan", "to": "q_learning"}]
    result = run_trial(config(trials=2, loops=3, swap=swaps), 1, make_system, loop=2)
    assert (result.trial, result.loop, result.handed_over) == (1, 2, (True, False))
    plain = run_trial(config(), 0, make_system)
    assert (plain.loop, plain.handed_over) == (0, ())


def test_a_unit_that_fails_is_named_by_its_trial_and_loop():
    watching = {"detectors": [{"name": "page_hinkley", "signal": "noise"}]}
    for loops, name in ((1, "trial 1: "), (2, "trial 1, loop 0: ")):
        with pytest.raises(ConfigError, match=f"^{name}detector"):
            run_trial(config(trials=2, loops=loops, monitor=watching), 1, make_system)


def test_a_free_running_config_is_refused_with_the_command_that_runs_it():
    with pytest.raises(ConfigError, match=r"^free-running needs processes: mapek up\."):
        loop_of(config(execute={"mode": "free", "rate": 5.0}))


def plan(number, **fields):
    return ChangePlan(0, number, 0.5, (0.1,), (), (), (), False, None)._replace(**fields)


def bus():
    return LocalBus(Log(RowLayout(("return",), 0, 1)))


def test_the_bus_delivers_what_was_appended_once_and_in_order():
    made, got = bus(), []
    made.subscribe(ChangePlan, lambda record: got.append(("first", record)))
    made.subscribe(ChangePlan, lambda record: got.append(("second", record)))
    made.send(plan(0))
    made.send(plan(0))
    assert got == []
    assert made.run() == 1
    assert got == [("first", plan(0)), ("second", plan(0))]
    assert (made.run(), made.deliver()) == (0, None)


@pytest.mark.parametrize(
    ("record", "reason"),
    [
        (plan(3), "ChangePlan 3 is refused as a gap"),
        (plan(0, epsilon=0.1), "ChangePlan 0 is refused as a conflict"),
        (plan(0, loop=1), "a record of loop 1 was sent to the log of loop 0"),
        (plan(-1), "passes are counted from 1"),
    ],
)
def test_the_bus_refuses_what_is_not_in_order(record, reason):
    made = bus()
    made.send(plan(0))
    with pytest.raises(BusError, match=reason):
        made.send(record)
    assert made.run() == 1


def test_a_plan_that_no_row_holds_is_refused_with_the_way_out():
    with pytest.raises(BusError, match=r"ChangePlan 0 is refused: action id 70 is outside 0 \.\. 63"):
        bus().send(plan(0, add=(70,)))


def test_a_closed_bus_delivers_nothing_more():
    made = bus()
    made.subscribe(ChangePlan, lambda record: pytest.fail("delivered after close"))
    made.send(plan(0))
    made.close()
    assert made.run() == 0


def test_a_listener_that_fails_costs_no_row_and_no_record():
    disturbed, undisturbed = (loop_of(config(episodes=600)) for _ in range(2))
    heard, also = [], []
    faults = iter([True])

    def fragile(rows):
        if next(faults, False):
            raise OSError("no room")
        heard.extend(rows["pass"].tolist())

    disturbed.log.on_rows(lambda rows: also.extend(rows["pass"].tolist()))
    disturbed.log.on_rows(fragile)
    with pytest.raises(OSError, match="no room"):
        disturbed.run(600)
    assert disturbed.log.passes == 512
    assert disturbed.execute.plan.pass_no == 512
    disturbed.log.flush()
    undisturbed.run(512)
    assert heard == also == list(range(1, 513))
    assert disturbed.log.sha256() == undisturbed.log.sha256()
