"""The ledger's four answers, and that a new one over the same file is the old one."""

import json
import tempfile
from pathlib import Path

import pytest
from bus_records import MAKERS, TOLD, new_ledger, new_log, observation, plan, request, run_of, symptom
from hypothesis import given
from hypothesis import strategies as st

from adapters.stores import Snapshot, Store, Swap
from adapters.stores import ledger as ledger_module
from adapters.stores.begun import begins, begun, go_on
from adapters.stores.ledger import Conflict, Ledger, differences
from knowledge import STAGES, Ack, MalformedRecord, QTable, to_json
from mape.errors import BusError, ResultsError


@pytest.fixture
def ledger():
    ledger = new_ledger()
    yield ledger
    ledger.store.close()


@pytest.fixture
def small_window(monkeypatch):
    monkeypatch.setattr(ledger_module, "WINDOW", 2)


def take(ledger, record, **other):
    stage = STAGES.index(type(record))
    return ledger.take(other.get("loop", record.loop), other.get("stage", stage), to_json(record))


def bodies(ledger, loop=0):
    return ledger.since(loop, dict.fromkeys(range(4), 0), 10_000)


# The four answers.


def test_records_are_taken_in_order_and_each_is_counted(ledger):
    assert ledger.last(0) == (0, 0, 0, -1)
    for record in run_of(3):
        assert take(ledger, record) == (Ack.OK, record.pass_no)
    assert ledger.last(0) == (3, 3, 3, 3)
    assert bodies(ledger) == [to_json(record).decode() for record in run_of(3)]


def test_the_hash_is_that_of_the_log(ledger):
    log = new_log()
    for record in run_of(5):
        take(ledger, record)
        log.append(record)
        assert ledger.sha256(0) == log.sha256(), record


def test_a_record_that_is_there_is_a_duplicate_however_old_it_is(ledger, small_window):
    for record in run_of(9):
        take(ledger, record)
    before = bodies(ledger)
    for record in run_of(9):
        assert take(ledger, record) == (Ack.DUPLICATE, 9)
    assert bodies(ledger) == before


@pytest.mark.parametrize("number", [0, 1, 8, 9])
def test_another_record_in_its_place_is_a_conflict_that_names_what_differs(ledger, small_window, number):
    for record in run_of(9):
        take(ledger, record)
    sentence = rf"ChangePlan {number} of loop 0 differs from the one in the log: epsilon is 0\.5 there, and 0\.25 here"
    with pytest.raises(Conflict, match=sentence):
        take(ledger, plan(number, epsilon=0.25))
    if number:
        other = observation(number, 99.0)._replace(steps=4)
        with pytest.raises(Conflict, match=r'steps is 3 there, and 4 here; signals is \{"return": .* and \{"return"'):
            take(ledger, other)


def test_the_same_record_in_other_bytes_is_a_conflict(ledger):
    take(ledger, plan(0))
    spaced = json.dumps(json.loads(to_json(plan(0)))).encode()
    assert spaced != to_json(plan(0))
    with pytest.raises(Conflict, match="differs from the one in the log in the way it is written"):
        ledger.take(0, 3, spaced)


def test_a_record_before_its_time_is_a_gap_and_changes_nothing(ledger):
    assert take(ledger, observation(1)) == (Ack.GAP, 0)
    take(ledger, plan(0))
    for record, last in [(observation(2), 0), (symptom(1), 0), (request(1), 0), (plan(1), 0), (plan(10**30), 0)]:
        assert take(ledger, record) == (Ack.GAP, last)
    assert bodies(ledger) == [to_json(plan(0)).decode()]
    assert take(ledger, observation(1)) == (Ack.OK, 1)


def test_a_stage_that_hands_on_other_signals_is_in_conflict(ledger):
    take(ledger, plan(0))
    take(ledger, observation(1))
    with pytest.raises(Conflict, match="Symptom 1 is refused: it hands on other signals or action sets"):
        take(ledger, symptom(1)._replace(signals={"return": 9.0}))
    assert take(ledger, symptom(1)) == (Ack.OK, 1)


@pytest.mark.parametrize(
    ("record", "other", "sentence"),
    [
        (plan(0), {"stage": 0}, "a ChangePlan came where only a Observation is taken"),
        (plan(0), {"loop": 1}, "ChangePlan of loop 0 came under the key of loop 1"),
        (plan(0, loop=2), {}, "loop 2; this run has loops 0 to 1"),
        (plan(-1), {}, "passes are counted from 1"),
        (observation(0), {}, "passes are counted from 1"),
        (observation(-3), {}, "passes are counted from 1"),
        (plan(0)._replace(learning_rate=(0.1, 0.2)), {}, "ChangePlan 0 does not fit the run's layout"),
        (plan(0)._replace(add=(64,)), {}, r"action id 64 is outside 0 \.\. 63"),
        (plan(0)._replace(adopt="zz"), {}, "ChangePlan 0 does not fit"),
        (observation(1)._replace(signals={"reward": 1.0}), {}, "has signals reward; the run's are, in this order, ret"),
        (observation(1)._replace(signals={}), {}, "has signals none"),
        (observation(1)._replace(steps=1 << 70), {}, "Observation 1 does not fit"),
    ],
)
@pytest.mark.parametrize("free", [False, True])
def test_what_does_not_fit_is_refused_with_a_sentence_and_changes_nothing(record, other, sentence, free):
    ledger = new_ledger(units=2, free=free)
    take(ledger, plan(0, loop=1))
    before = (ledger.last(0), ledger.last(1), bodies(ledger), bodies(ledger, 1))
    with pytest.raises((ValueError, BusError), match=sentence):
        take(ledger, record, **other)
    assert (ledger.last(0), ledger.last(1), bodies(ledger), bodies(ledger, 1)) == before


def test_before_a_layout_is_told_nothing_is_taken():
    ledger = new_ledger(begun=False)
    with pytest.raises(ValueError, match="the run has not begun: no Execute has told yet"):
        take(ledger, plan(0))
    assert ledger.last(0) == (0, 0, 0, -1)
    assert not ledger.complete


def test_a_run_has_one_layout(ledger):
    ledger.begin(TOLD.model_dump(mode="json"))
    with pytest.raises(BusError, match="its managed system is another one"):
        ledger.begin({**TOLD.model_dump(mode="json"), "signals": ["reward"]})


def test_loops_do_not_wait_for_each_other():
    ledger = new_ledger(units=2)
    for record in run_of(2, loop=1):
        assert take(ledger, record).ack is Ack.OK
    assert (ledger.last(0), ledger.last(1)) == ((0, 0, 0, -1), (2, 2, 2, 2))
    assert bodies(ledger) == []


# Free-running.


def test_a_free_running_loop_has_no_hash_and_no_stage_waits_for_the_next():
    ledger = new_ledger(free=True)
    take(ledger, plan(0))
    assert [take(ledger, observation(number)).ack for number in (1, 2, 3)] == [Ack.OK] * 3
    assert take(ledger, symptom(1)) == (Ack.OK, 1)
    assert ledger.last(0) == (3, 1, 0, 0)
    assert ledger.sha256(0) is None


def test_what_was_dropped_is_written_down_and_gone_past():
    ledger = new_ledger(free=True)
    assert ledger.drop(0, 1, 2) == (Ack.GAP, 0)
    take(ledger, plan(0))
    take(ledger, observation(1))
    assert ledger.drop(0, 2, 9) == (Ack.OK, 9)
    assert ledger.drop(0, 2, 9) == (Ack.DUPLICATE, 9)
    assert take(ledger, observation(10)) == (Ack.OK, 10)
    with pytest.raises(Conflict, match="episodes 5 to 12 were not all dropped"):
        ledger.drop(0, 5, 12)
    with pytest.raises(Conflict, match="Observation 4 of loop 0 was dropped from the log, and is sent now"):
        take(ledger, observation(4))
    take(ledger, symptom(1))
    with pytest.raises(Conflict, match="stands for an episode that was dropped"):
        take(ledger, symptom(2))
    assert take(ledger, symptom(10)) == (Ack.OK, 10)
    assert ledger.store.dropped(0) == [(2, 9)]


def test_in_lockstep_nothing_is_dropped(ledger):
    take(ledger, plan(0))
    with pytest.raises(MalformedRecord, match="nothing is dropped in lockstep"):
        ledger.drop(0, 1, 2)


# A new ledger over the same file.


class Restarted:
    """A ledger that is made anew over its file again and again, as by a Knowledge that dies between two commits."""

    def __init__(self, folder, free):
        self.path, self.free = Path(folder) / "log.sqlite", free
        self.ledger = new_ledger(self.path, units=2, free=free)

    def again(self):
        self.ledger.store.close()
        self.ledger = new_ledger(self.path, units=2, free=self.free)


def outcome(ledger, do):
    try:
        return do(ledger)
    except (ValueError, BusError) as error:
        return type(error).__name__, str(error)


def seen(ledger):
    return [(ledger.last(loop), ledger.sha256(loop), bodies(ledger, loop)) for loop in range(2)]


def next_of(ledger, loop, free):
    """Make a record that is in order."""
    last = ledger.last(loop)
    if last[3] < 0:
        return plan(0, loop=loop)
    if free:
        return observation(last[0] + 1, loop=loop)
    stage = next((stage for stage in (1, 2, 3) if last[stage] < last[stage - 1]), 0)
    return MAKERS[stage](last[stage] + 1, loop=loop)


loops = st.integers(0, 1)
in_order = st.tuples(st.just("next"), loops)
anything = st.tuples(st.integers(0, 3), loops, st.integers(-6, 2), st.booleans())
drops = st.tuples(st.just("drop"), loops, st.integers(-2, 2), st.integers(0, 3))
restarts = st.tuples(st.just("restart"))


def steps(*more):
    return st.lists(st.one_of(in_order, in_order, anything, restarts, *more), max_size=80)


def play(script, free):
    """Do the same to a ledger that lives on in memory, and to one that is restarted, and hold them together."""
    living = new_ledger(units=2, free=free)
    with tempfile.TemporaryDirectory() as folder:
        other = Restarted(folder, free)
        for number, (what, *how) in enumerate(script):
            if what == "restart":
                other.ledger.commit()
                other.again()
            elif what == "drop":
                loop, offset, length = how
                first = living.last(loop)[0] + offset
                do = lambda ledger, a=first, b=first + length, loop=loop: ledger.drop(loop, a, b)  # noqa: E731
                assert outcome(living, do) == outcome(other.ledger, do), f"step {number}"
            else:
                if what == "next":
                    record = next_of(living, how[0], free)
                else:
                    loop, offset, changed = how
                    record = MAKERS[what](living.last(loop)[what] + offset, loop=loop)
                    if changed:
                        record = record._replace(
                            **{"epsilon": 0.125} if what in (0, 3) else {"signals": {"return": 7.0}}
                        )
                do = lambda ledger, record=record: take(ledger, record)  # noqa: E731
                assert outcome(living, do) == outcome(other.ledger, do), f"step {number}"
            assert [other.ledger.last(loop) for loop in range(2)] == [living.last(loop) for loop in range(2)]
        other.ledger.commit()
        other.again()
        assert seen(other.ledger) == seen(living)
        other.ledger.store.close()
    living.store.close()


@given(steps())
def test_a_lockstep_log_goes_on_after_a_restart_as_if_there_had_been_none(script):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ledger_module, "WINDOW", 2)
        play(script, free=False)


@given(steps(drops))
def test_a_free_running_log_goes_on_after_a_restart_as_if_there_had_been_none(script):
    play(script, free=True)


@given(st.integers(0, 41), st.integers(1, 4))
def test_at_any_cut_the_hash_and_the_next_answer_are_the_same(cut, window):
    records = run_of(10)
    log = new_log()
    for record in records[:cut]:
        log.append(record)
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(ledger_module, "WINDOW", window)
        first = new_ledger(Path(folder) / "l")
        for record in records[:cut]:
            take(first, record)
        first.commit()
        first.store.close()
        second = new_ledger(Path(folder) / "l")
        assert second.sha256(0) == log.sha256()
        for record in records[:cut]:
            assert take(second, record).ack is Ack.DUPLICATE
        for record in records[cut:]:
            assert take(second, record).ack is Ack.OK
            log.append(record)
        assert second.sha256(0) == log.sha256()
        second.store.close()


def test_what_was_rolled_back_is_not_in_the_next_ledger(ledger):
    for record in run_of(1):
        take(ledger, record)
    ledger.commit()
    for record in (observation(2), symptom(2)):
        take(ledger, record)
    ledger.store.roll_back()
    again = Ledger(ledger.store, 1, 1000)
    assert again.last(0) == (1, 1, 1, 1)
    assert take(again, observation(2, 8.0)) == (Ack.OK, 2)


def test_a_log_with_a_hole_or_with_other_rows_is_not_gone_on_with(tmp_path):
    for number, damage in enumerate(
        [
            "DELETE FROM records WHERE pass = 3 AND stage = 1",
            "DELETE FROM records WHERE pass = 2",
            "DELETE FROM records WHERE pass = 0",
            "UPDATE records SET row = zeroblob(length(row)) WHERE pass = 2",
            "UPDATE records SET row = NULL WHERE pass = 4",
            "UPDATE records SET body = '{}' WHERE pass = 4",
        ]
    ):
        path = tmp_path / str(number)
        ledger = new_ledger(path)
        for record in run_of(4):
            take(ledger, record)
        ledger.commit()
        ledger.store.close()
        with Store(path) as store:
            store._write(damage)
            store.commit()
            with pytest.raises(ResultsError, match="holds no whole log"):
                Ledger(store, 1, 1000)


# States, swaps, events.


def q_table():
    return QTable((0, 1), 2)


def test_a_state_is_kept_only_of_what_the_log_holds(ledger):
    for record in run_of(2):
        take(ledger, record)
    assert ledger.keep("monitor", Snapshot(0, "monitor", 3, {}, None), 1) == (Ack.GAP, 2)
    assert ledger.store.snapshot(0, "monitor") is None
    assert ledger.keep("monitor", Snapshot(0, "monitor", 2, {}, None), 1) == (Ack.OK, 2)


def test_a_run_is_complete_when_every_loop_has_its_q_table_at_the_end(tmp_path):
    ledger = new_ledger(tmp_path / "l", units=2, episodes=1)
    for loop in range(2):
        for record in run_of(1, loop=loop):
            take(ledger, record)
        assert not ledger.complete
        ledger.keep("execute", Snapshot(loop, "execute", 1, {}, q_table(), final=True), 0)
    assert ledger.complete
    ledger.commit()
    ledger.store.close()
    again = new_ledger(tmp_path / "l", units=2, episodes=1)
    assert again.complete
    again.store.close()


def test_a_final_state_before_the_last_plan_is_not_the_end(ledger):
    take(ledger, plan(0))
    take(ledger, observation(1))
    with pytest.raises(MalformedRecord, match="not the last one of 1000"):
        ledger.keep("execute", Snapshot(0, "execute", 1, {}, q_table(), final=True), 0)
    assert not ledger.complete


def test_only_executes_state_ends_a_run(ledger):
    for record in run_of(1):
        take(ledger, record)
    ledger.keep("plan", Snapshot(0, "plan", 1, {}, None, final=True), 3)
    assert not ledger.complete


def test_epochs_count_on_after_a_restart(tmp_path):
    ledger = new_ledger(tmp_path / "l")
    assert [ledger.epoch("plan"), ledger.join("plan"), ledger.join("plan"), ledger.epoch("plan")] == [0, 1, 2, 2]
    ledger.commit()
    ledger.store.close()
    again = new_ledger(tmp_path / "l")
    assert [again.epoch("plan"), again.join("plan"), again.epoch("monitor")] == [2, 3, 0]
    again.store.close()


def test_of_refusals_only_the_first_are_noted_and_all_are_counted(ledger, monkeypatch):
    monkeypatch.setattr(ledger_module, "EVENTS_KEPT", 3)
    for number in range(5):
        ledger.note("plan", "refused", str(number))
    ledger.note("plan", "joined", "still noted")
    assert [event.text for event in ledger.store.events()] == ["0", "1", "2", "still noted"]
    assert ledger.refused == 5


def test_a_swap_of_a_loop_that_is_not_there_is_refused(ledger):
    with pytest.raises(ValueError, match="loop 7; this run has loops 0 to 0"):
        ledger.swapped(Swap(7, 1, "plan", {}, False, False))
    ledger.swapped(Swap(0, 1, "plan", {}, False, False))
    assert len(ledger.store.swaps()) == 1


def test_differences_name_fields_that_only_one_has():
    assert differences('{"a": 1}', '{"b": 2}') == ": a is 1 there, and null here; b is null there, and 2 here"


def test_each_episode_that_was_begun_and_not_heard_of_is_told_when_a_run_goes_on(ledger):
    begins(ledger.store, 0, 3)  # of one that runs freely: 1 and 2 were driven, and their Observations lost
    for _ in range(2):
        go_on(ledger)
        assert [(event.kind, event.pass_no) for event in ledger.store.events()] == [
            ("aborted", 3), ("aborted", 2), ("aborted", 1)
        ]  # fmt: skip
    assert begun(ledger.store, 0) == 0
