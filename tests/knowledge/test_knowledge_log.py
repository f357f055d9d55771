import hashlib
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from knowledge_strategies import one_pass, plan

import knowledge.log
from knowledge import STAGES, Ack, ChangePlan, ChangeRequest, Log, Observation, RowLayout, Symptom
from knowledge.log import Pass


def fresh(window=256):
    return Log(RowLayout(("return",), detectors=1, rates=3), window=window)


def filled(passes, window=256, listener=None):
    log = fresh(window)
    if listener is not None:
        log.on_rows(listener)
    for record in run_of(passes):
        assert log.append(record) is Ack.OK
    return log


def run_of(passes):
    return [plan(0), *(record for n in range(1, passes + 1) for record in one_pass(n, alarm=n % 5 == 0))]


def test_the_records_of_a_run_are_taken_in_their_order():
    log = filled(7)
    assert log.passes == 7
    assert log.window[-1] == one_pass(7)


def test_a_record_sent_again_is_a_duplicate_and_changes_nothing():
    log = filled(4)
    before = log.sha256()
    for number in range(1, 5):
        for record in one_pass(number):
            assert log.append(record) is Ack.DUPLICATE
    assert log.append(plan(0)) is Ack.DUPLICATE
    assert (log.passes, log.sha256()) == (4, before)


def test_a_record_of_the_open_pass_sent_again_is_a_duplicate():
    log = filled(2)
    seen, symptom, _, _ = one_pass(3)
    log.append(seen)
    assert log.append(seen) is Ack.DUPLICATE
    log.append(symptom)
    assert log.append(seen) is Ack.DUPLICATE
    assert log.append(symptom) is Ack.DUPLICATE


def test_a_record_before_its_turn_is_a_gap_and_changes_nothing():
    log = filled(2)
    before = log.sha256()
    early = (*one_pass(3)[1:], *one_pass(4), *one_pass(9))
    assert {log.append(record) for record in early} == {Ack.GAP}
    assert (log.passes, log.sha256()) == (2, before)
    assert log.append(one_pass(3)[0]) is Ack.OK


def test_nothing_comes_before_plan_0():
    log = fresh()
    assert {log.append(record) for record in one_pass(1)} == {Ack.GAP}
    assert log.append(plan(0)) is Ack.OK


@pytest.mark.parametrize("number", [0, -1, -2])
def test_passes_are_counted_from_1(number):
    with pytest.raises(ValueError, match="counted from 1"):
        fresh().append(one_pass(1)[0]._replace(pass_no=number))
    with pytest.raises(ValueError, match="counted from 1"):
        filled(2).append(one_pass(1)[0]._replace(pass_no=number))


def test_another_record_in_a_taken_place_is_a_conflict():
    log = filled(3)
    before = log.sha256()
    assert log.append(plan(0, epsilon=0.25)) is Ack.CONFLICT
    assert log.append(one_pass(2)[0]._replace(steps=1)) is Ack.CONFLICT
    assert log.append(one_pass(3)[3]._replace(epsilon=0.0)) is Ack.CONFLICT
    log.append(one_pass(4)[0])
    assert log.append(one_pass(4)[0]._replace(steps=1)) is Ack.CONFLICT
    assert log.sha256() == before


def test_a_record_older_than_the_window_is_a_duplicate_without_a_comparison():
    log = filled(10, window=3)
    assert log.append(one_pass(7)[0]._replace(steps=1)) is Ack.DUPLICATE
    assert log.append(one_pass(8)[0]._replace(steps=1)) is Ack.CONFLICT


def test_a_stage_that_hands_on_other_signals_or_actions_is_in_conflict():
    seen, symptom, request, chosen = one_pass(1)
    log = filled(0)
    log.append(seen)
    assert log.append(symptom._replace(signals={"return": 0.0})) is Ack.CONFLICT
    assert log.append(symptom._replace(available=(0,))) is Ack.CONFLICT
    assert log.append(symptom._replace(known=(0, 1, 2))) is Ack.CONFLICT
    assert log.append(symptom) is Ack.OK
    assert log.append(request._replace(signals={"return": 0.0})) is Ack.CONFLICT
    assert log.append(request) is Ack.OK
    assert log.append(chosen) is Ack.OK
    assert log.sha256() == filled(1).sha256()


def test_what_is_handed_on_may_be_an_equal_copy():
    seen, symptom, request, chosen = one_pass(1)
    log = filled(0)
    for record in (
        seen,
        symptom._replace(signals=dict(seen.signals)),
        request._replace(signals=dict(seen.signals)),
        chosen,
    ):
        assert log.append(record) is Ack.OK


def test_a_record_of_another_loop_is_refused():
    with pytest.raises(ValueError, match="loop 1 was sent to the log of loop 0"):
        filled(1).append(one_pass(2)[0]._replace(loop=1))


def test_a_plan_that_does_not_fit_the_layout_is_refused_and_its_place_stays_free():
    log = filled(1)
    seen, symptom, request, chosen = one_pass(2)
    for record in (seen, symptom, request):
        log.append(record)
    before = log.sha256()
    for bad in (chosen._replace(learning_rate=(0.1,)), chosen._replace(add=(64,)), chosen._replace(adopt="no hash")):
        with pytest.raises(ValueError, match=r"layout|outside|hexadecimal"):
            log.append(bad)
    assert (log.passes, log.sha256()) == (1, before)
    assert log.append(chosen) is Ack.OK
    assert log.sha256() == filled(2).sha256()


def test_the_window_holds_the_newest_passes():
    log = filled(10, window=4)
    assert [finished.observation.pass_no for finished in log.window] == [7, 8, 9, 10]


def test_find_returns_a_record_by_kind_and_number():
    log = filled(10, window=4)
    log.append(one_pass(11)[0])
    assert log.find(ChangePlan, 0) == plan(0)
    assert log.find(Symptom, 8) == one_pass(8)[1]
    assert log.find(Observation, 11) == one_pass(11)[0]
    for kind, number in ((Symptom, 11), (Observation, 6), (Observation, 12), (Observation, 0), (ChangeRequest, -1)):
        assert log.find(kind, number) is None


def test_since_yields_what_follows_in_order():
    log = filled(4)
    log.append(one_pass(5)[0])
    log.append(one_pass(5)[1])
    everything = [plan(0), *(r for n in range(1, 5) for r in one_pass(n)), *one_pass(5)[:2]]
    assert list(log.since(0)) == everything
    assert list(log.since(3, 2)) == everything[1 + 2 * 4 + 2 :]
    assert list(log.since(5)) == everything[-2:]
    assert list(log.since(5, 1)) == everything[-1:]
    assert list(log.since(6)) == []
    assert list(log.since(9, 3)) == []


def test_since_says_what_has_left_the_window():
    with pytest.raises(LookupError, match="the oldest pass in memory is 7"):
        list(filled(10, window=4).since(6))
    assert len(list(filled(10, window=4).since(7))) == 16


@given(st.integers(0, 40), st.sampled_from([1, 2, 7, 512]))
def test_the_hash_is_that_of_the_schema_plan_0_and_the_rows_as_numpy_reads_them(passes, segment):
    segments = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(knowledge.log, "SEGMENT", segment)
        log = filled(passes, listener=lambda rows: segments.append(rows.copy()))
        log.flush()
    layout = log.layout
    start = np.zeros(1, layout.dtype)
    start["next_epsilon"] = 0.5
    start["statistic"] = np.nan
    start["direction"] = 3
    start["learning_rate"] = (0.1, 0.9, 5.0)
    digest = hashlib.sha256(layout.schema + start.tobytes())
    for rows in segments:
        digest.update(np.ascontiguousarray(rows).tobytes())
    assert log.sha256() == digest.hexdigest()
    assert sum(map(len, segments)) == passes


def test_the_hash_does_not_depend_on_when_rows_are_handed_on():
    plain = filled(9)
    flushed = fresh()
    flushed.append(plan(0))
    for number in range(1, 10):
        for record in one_pass(number, alarm=number % 5 == 0):
            flushed.append(record)
            flushed.flush()
    assert plain.sha256() == flushed.sha256()


def test_asking_for_the_hash_does_not_change_it():
    log = filled(3)
    assert log.sha256() == log.sha256() == filled(3).sha256()


def test_the_hash_tells_runs_apart():
    hashes = {filled(passes).sha256() for passes in range(5)}
    other = fresh()
    other.append(plan(0, epsilon=0.25))
    hashes.add(other.sha256())
    wider = Log(RowLayout(("cost",), detectors=1, rates=3))
    wider.append(plan(0))
    hashes.add(wider.sha256())
    assert len(hashes) == 7


def test_segments_reach_every_listener_once_and_cannot_be_written(monkeypatch):
    monkeypatch.setattr(knowledge.log, "SEGMENT", 4)
    seen, also = [], []
    log = fresh()
    log.on_rows(lambda rows: seen.extend(rows["pass"].tolist()))
    log.on_rows(lambda rows: also.append(rows.flags.writeable))
    log.append(plan(0))
    for number in range(1, 11):
        for record in one_pass(number):
            log.append(record)
    assert seen == list(range(1, 9))
    log.flush()
    log.flush()
    assert seen == list(range(1, 11))
    assert also == [False] * 3


def test_a_row_says_what_its_pass_was():
    rows = []
    filled(5, listener=lambda segment: rows.append(segment.copy())).flush()
    row = rows[0][4]
    assert (row["pass"], row["plan"], row["steps"], row["epsilon"], row["next_epsilon"]) == (5, 4, 15, 0.5, 0.2)
    assert row["signals"].tolist() == [-5.0]
    assert (row["value"][0], row["alarm"][0], row["direction"][0], row["drift"][0]) == (-5.0, True, 1, 1)
    assert np.isnan(row["statistic"][0])
    assert row["add"].tolist() == [0b100]


def states(log):
    """What two logs that are the same must agree on, besides what they answer."""
    return log.sha256(), log.passes, list(log.window), log.last_row(), list(log.since(log.passes + 1))


@given(st.data(), st.integers(0, 9), st.integers(0, 6), st.sampled_from([1, 3, 512]))
def test_a_log_restored_at_any_record_answers_and_hashes_as_the_one_that_went_on(data, passes, window, segment):
    run = run_of(passes)
    cut = data.draw(st.integers(1, len(run)))
    # Some are sent again, some come too early, some are another record in the same place.
    sent = [item for item in run[cut:] for _ in range(data.draw(st.integers(1, 2)))]
    strays = data.draw(st.lists(st.tuples(st.integers(0, len(sent)), st.sampled_from(run), st.booleans())))
    for at, stray, other in strays:
        sent.insert(at, stray._replace(signals={"return": 0.5}) if other and hasattr(stray, "signals") else stray)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(knowledge.log, "SEGMENT", segment)
        log, rows, told = fresh(window), rows_of((cut - 1) // 4), []
        for record in run[:cut]:
            log.append(record)
        again = fresh(window)
        again.on_rows(lambda segment: told.extend(segment["pass"].tolist()))
        again.restore(plan(0), iter(rows), list(log.window), list(log.since(log.passes + 1)))
        assert states(again) == states(log)
        assert [again.append(record) for record in sent] == [log.append(record) for record in sent]
        assert states(again) == states(log)
        again.flush()
    assert told == list(range(len(rows) + 1, again.passes + 1))


def rows_of(passes):
    log, rows = fresh(), []
    for record in run_of(passes):
        log.append(record)
        rows.append(log.last_row())
    return rows[4::4]  # after each plan but the first


def test_a_log_before_plan_0_is_restored_as_a_fresh_one():
    log = fresh()
    log.restore(None, [], [], [])
    assert log.sha256() == fresh().sha256()
    assert log.append(plan(0)) is Ack.OK


def test_a_log_is_restored_without_the_records_that_are_not_kept():
    log = fresh()
    log.restore(plan(0), rows_of(6), [one_pass(6)], [])
    assert (log.sha256(), log.passes, list(log.window)) == (filled(6).sha256(), 6, [one_pass(6)])
    log = fresh()
    log.restore(plan(0), rows_of(6), [], [])
    assert (log.sha256(), log.last_row()) == (filled(6).sha256(), rows_of(6)[-1])
    assert log.append(one_pass(6)[0]) is Ack.DUPLICATE
    assert log.append(one_pass(7)[0]) is Ack.OK


@pytest.mark.parametrize(
    ("start", "rows", "passes", "open_records", "why"),
    [
        (None, rows_of(1), [], [], "row 1 of the restored log is not the packed row of pass 1"),
        (None, [], [], one_pass(1)[:1], "Observation 1 does not come next in the restored log: gap"),
        (plan(0), rows_of(3)[1:], [], [], "row 1 .* is not the packed row of pass 1"),
        (plan(0), [rows_of(1)[0][:-1]], [], [], "row 1 .* is not the packed row of pass 1"),
        (plan(0), [*rows_of(2), b""], [], [], "row 3 .* is not the packed row of pass 3"),
        (plan(0), rows_of(1), [one_pass(1), one_pass(2)], [], "2 finished passes were given with the rows of 1"),
        (plan(0), rows_of(3), [one_pass(2)], [], "Observation 2 does not come next in the restored log: duplicate"),
        (plan(0), rows_of(2), [one_pass(2, value=7.0)], [], "the records of pass 2 do not give its row"),
        (plan(0), rows_of(2), [], one_pass(3)[1:], "Symptom 3 does not come next in the restored log: gap"),
        (plan(1), [], [], [], "ChangePlan 1 does not come next in the restored log: gap"),
    ],
)
def test_what_is_no_run_is_not_restored(start, rows, passes, open_records, why):
    with pytest.raises(ValueError, match=why):
        fresh().restore(start, rows, passes, open_records)


def test_only_a_fresh_log_is_restored_into():
    with pytest.raises(ValueError, match="a log of 2 passes cannot be restored into; make a fresh one"):
        filled(2).restore(plan(0), [], [], [])


def test_the_last_row_is_that_of_the_newest_finished_pass_whether_it_was_handed_on_or_not():
    log = fresh()
    with pytest.raises(LookupError, match="plan 0 makes the first"):
        log.last_row()
    log.append(plan(0))
    assert log.last_row() == log.layout.pack_start(plan(0))
    for record in one_pass(1):
        log.append(record)
    row = log.last_row()
    assert np.frombuffer(row, log.layout.dtype)["pass"].tolist() == [1]
    log.flush()
    log.append(one_pass(2)[0])
    assert log.last_row() == row


def of_row(row):
    number = int(row["pass"])
    return Pass(*one_pass(number, alarm=number % 5 == 0))


def packed(first, count):
    """The rows of `count` passes from number `first` on."""
    rows = rows_of(first + count - 1)[first - 1 :]
    return np.frombuffer(b"".join(rows), fresh().layout.dtype)


deeds = st.one_of(
    st.tuples(st.just("rows"), st.integers(0, 9)),
    st.tuples(st.just("rows"), st.integers(0, 9)),
    st.tuples(st.just("records"), st.integers(1, 9)),
    st.tuples(st.just("look"), st.integers(-1, 60)),
    st.tuples(st.just("flush"), st.just(0)),
    st.tuples(st.just("listen"), st.just(0)),
)


@given(st.lists(deeds, max_size=20), st.sampled_from([0, 1, 4, 256]), st.sampled_from([1, 3, 16, 512]))
def test_a_log_of_rows_and_records_is_the_log_of_records_alone(todo, window, segment):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(knowledge.log, "SEGMENT", segment)
        mixed, plain = fresh(window), fresh(window)
    heard = ([], [])

    def listen():
        for log, told in zip((mixed, plain), heard, strict=True):
            log.on_rows(lambda rows, own=told: own.append(rows.tobytes()))

    listen()
    run = iter(run_of(200))
    for log in (mixed, plain):
        log.append(plan(0))
    assert next(run) == plan(0)
    for deed, number in todo:
        if deed == "rows":
            for record in () if not mixed.open_records else itertools.islice(run, 4 - len(mixed.open_records)):
                assert mixed.append(record) is plain.append(record) is Ack.OK
            count = min(number, mixed.room())
            if plain.passes + count > 199:
                break
            mixed.extend(packed(mixed.passes + 1, count), of_row)
            for record in itertools.islice(run, 4 * count):
                plain.append(record)
        elif deed == "records":
            for record in itertools.islice(run, number):
                assert mixed.append(record) is plain.append(record) is Ack.OK
        elif deed == "look":
            for kind in STAGES:
                assert mixed.find(kind, number) == plain.find(kind, number)
            from_there = max(0, number)
            if from_there > plain.passes - min(window, plain.passes):
                assert list(mixed.since(from_there, 1)) == list(plain.since(from_there, 1))
        elif deed == "flush":
            mixed.flush()
            plain.flush()
        else:
            listen()
        assert (mixed.sha256(), mixed.passes, mixed.last_row()) == (plain.sha256(), plain.passes, plain.last_row())
    sent_again = one_pass(max(1, mixed.passes), alarm=max(1, mixed.passes) % 5 == 0)[1]
    assert mixed.append(sent_again) is plain.append(sent_again)
    assert states(mixed) == states(plain)
    for log in (mixed, plain):
        log.flush()
    assert heard[0] == heard[1]


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        (lambda: packed(4, 2), "rows of other passes than 5"),
        (lambda: packed(6, 2), "rows of other passes than 5"),
        (lambda: packed(5, 3)[::2], "rows of other passes than 5"),
        (lambda: packed(5, 2)[::-1], "rows of other passes than 5"),
        (lambda: np.zeros(1, Log(RowLayout(("cost",), 1, 2)).layout.dtype), "rows of other passes than 5"),
        (lambda: packed(5, 5), "5 rows were sent to a log that has room for 4"),
    ],
)
def test_rows_that_do_not_come_next_are_refused_and_change_nothing(monkeypatch, rows, says):
    monkeypatch.setattr(knowledge.log, "SEGMENT", 8)
    heard = []
    log = filled(4, listener=lambda segment: heard.append(len(segment)))
    before = states(log)
    with pytest.raises(ValueError, match=says):
        log.extend(rows(), of_row)
    assert (states(log), heard) == (before, [])
    log.extend(packed(5, 4), of_row)
    assert states(log) == states(filled(8))


def test_a_full_log_that_is_sent_rows_refuses_them_and_does_not_hand_on_what_it_has(monkeypatch):
    monkeypatch.setattr(knowledge.log, "SEGMENT", 4)
    heard = []
    log = filled(4, listener=lambda segment: heard.append(len(segment)))
    with pytest.raises(ValueError, match="1 rows were sent to a log that has room for 0"):
        log.extend(packed(5, 1), of_row)
    assert heard == []
    assert log.room() == 4
    assert heard == [4]


def test_rows_are_no_part_of_a_pass_that_is_begun_nor_of_a_log_without_plan_0():
    log = filled(2)
    log.append(one_pass(3)[0])
    before = states(log)
    for number in (3, 4):
        with pytest.raises(ValueError, match="rows of other passes"):
            log.extend(packed(number, 1), of_row)
    assert states(log) == before
    with pytest.raises(ValueError, match="rows of other passes"):
        fresh().extend(packed(1, 1), of_row)


@pytest.mark.parametrize("after", ["rows", "records"])
def test_rows_that_have_left_the_window_are_let_go_unread(after):
    log, read = filled(0, window=4), []

    def reading(row):
        read.append(int(row["pass"]))
        return of_row(row)

    log.extend(packed(1, 6), reading)
    if after == "rows":
        log.extend(packed(7, 5), reading)
    else:
        for record in run_of(11)[1 + 4 * 6 :]:
            log.append(record)
    assert [finished.observation.pass_no for finished in log.window] == [8, 9, 10, 11]
    assert 1 not in read


def test_a_listener_that_fails_when_room_is_asked_for_is_offered_the_segment_again(monkeypatch):
    monkeypatch.setattr(knowledge.log, "SEGMENT", 4)
    heard, fails = [], [True]

    def hear(rows):
        if fails.pop():
            fails.append(False)
            raise OSError("disk full")
        fails.append(False)
        heard.extend(rows["pass"].tolist())

    log = filled(0, listener=hear)
    log.extend(packed(1, 4), of_row)
    with pytest.raises(OSError, match="disk full"):
        log.room()
    before = log.sha256()
    assert log.room() == 4
    assert (heard, log.sha256()) == ([1, 2, 3, 4], before)
