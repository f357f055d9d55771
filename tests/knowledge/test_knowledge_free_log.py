import pytest
from hypothesis import given
from hypothesis import strategies as st
from knowledge_strategies import one_pass, plan

from knowledge import STAGES, Ack, ChangePlan, ChangeRequest, FreeLog, Observation, Symptom


def record(stage, number):
    return plan(0) if (stage, number) == (3, 0) else one_pass(1)[stage]._replace(pass_no=number)


def started():
    log = FreeLog()
    assert log.append(plan(0)) is Ack.OK
    return log


def lasts(log):
    return [log.last(kind) for kind in STAGES]


class EveryNumber:
    """The log as one would write it down: every number that was taken, and every one that was dropped."""

    def __init__(self):
        self.taken = [set(), set(), set(), set()]
        self.dropped = set()

    def append(self, stage, number):
        newest = max(self.taken[stage], default=-1)
        if stage == 0:
            newest = max(newest, *self.dropped, -1)
        if number <= newest:
            return Ack.DUPLICATE
        if (stage, number) != (3, 0):
            if stage > 0 and number in self.dropped:
                return Ack.CONFLICT
            before = set(range(1, number)) - self.dropped
            there = self.taken[stage - 1] if stage > 0 else {number}
            if 0 not in self.taken[3] or number not in there or not before <= self.taken[stage]:
                return Ack.GAP
        self.taken[stage].add(number)
        return Ack.OK

    def drop(self, first, last):
        driven = self.taken[0] | self.dropped
        newest = max(driven, default=0)
        if last <= newest:
            return Ack.DUPLICATE
        if 0 not in self.taken[3] or first > newest + 1:
            return Ack.GAP
        if first <= newest:
            return Ack.CONFLICT
        self.dropped |= set(range(first, last + 1))
        return Ack.OK


steps = st.one_of(
    st.tuples(st.integers(0, 3), st.integers(-1, 3)),  # a stage, and how far from its newest number
    st.tuples(st.just("drop"), st.tuples(st.integers(-1, 2), st.integers(0, 3))),
)


@given(st.lists(steps, max_size=60), st.booleans())
def test_the_numbers_answer_as_a_log_would_that_kept_every_one(script, begun):
    log, naive = FreeLog(), EveryNumber()
    if begun:
        assert log.append(plan(0)) is naive.append(3, 0)
    for what, how in script:
        if what == "drop":
            first = max(1, log.last(Observation) + how[0])
            assert log.drop(first, first + how[1]) is naive.drop(first, first + how[1])
        else:
            number = max(0 if what == 3 else 1, log.last(STAGES[what]) + how)
            assert log.append(record(what, number)) is naive.append(what, number), (what, number)
        under_way = naive.taken[0] - set(range(log.last(ChangePlan) + 1))
        assert len(log.dropped) <= len(under_way) + 1
        again = FreeLog.restore(0, lasts(log), log.dropped)
        assert (lasts(again), again.dropped) == (lasts(log), log.dropped)
    every_one = [(number, number) for number in naive.dropped]
    assert FreeLog.restore(0, lasts(log), every_one).dropped == log.dropped


def test_no_stage_waits_for_the_next_one():
    log = started()
    assert [log.append(record(0, number)) for number in range(1, 5)] == [Ack.OK] * 4
    assert [log.append(record(1, number)) for number in range(1, 4)] == [Ack.OK] * 3
    assert log.append(record(2, 1)) is Ack.OK
    assert lasts(log) == [4, 3, 1, 0]


def test_a_stage_does_not_go_ahead_of_the_one_before():
    log = started()
    assert {log.append(record(stage, 1)) for stage in (1, 2, 3)} == {Ack.GAP}
    log.append(record(0, 1))
    assert {log.append(record(stage, 1)) for stage in (2, 3)} == {Ack.GAP}


def test_what_was_dropped_is_gone_past_by_every_stage_and_then_forgotten():
    log = started()
    log.append(record(0, 1))
    assert log.drop(2, 9) is Ack.OK
    assert log.append(record(0, 10)) is Ack.OK
    for stage in (1, 2, 3):
        assert log.append(record(stage, 1)) is Ack.OK
        assert log.append(record(stage, 2)) is Ack.CONFLICT
        assert log.dropped == ((2, 9),)
        assert log.append(record(stage, 10)) is Ack.OK
    assert log.dropped == ()
    assert lasts(log) == [10] * 4


def test_drops_one_after_another_are_one_interval():
    log = started()
    assert [log.drop(1, 3), log.drop(4, 4), log.drop(5, 8)] == [Ack.OK] * 3
    assert log.dropped == ((1, 8),)
    assert log.append(record(0, 9)) is Ack.OK
    assert log.append(record(1, 9)) is Ack.OK


def test_a_drop_is_answered_as_a_record_is():
    log = FreeLog()
    assert log.drop(1, 2) is Ack.GAP
    log.append(plan(0))
    log.append(record(0, 1))
    assert log.drop(3, 4) is Ack.GAP
    assert log.drop(1, 4) is Ack.CONFLICT
    assert log.drop(2, 4) is Ack.OK
    assert log.drop(2, 4) is Ack.DUPLICATE
    assert log.drop(4, 5) is Ack.CONFLICT
    assert log.append(record(0, 4)) is Ack.DUPLICATE


def test_nothing_comes_before_plan_0():
    log = FreeLog()
    assert lasts(log) == [0, 0, 0, -1]
    assert {log.append(record(stage, 1)) for stage in range(4)} == {Ack.GAP}
    assert log.append(plan(0)) is Ack.OK
    assert log.append(plan(0)) is Ack.DUPLICATE
    assert lasts(log) == [0] * 4


@pytest.mark.parametrize(("stage", "number"), [(0, 0), (1, 0), (2, -1), (3, -1)])
def test_passes_of_a_free_running_loop_are_counted_from_1(stage, number):
    with pytest.raises(ValueError, match="counted from 1"):
        started().append(one_pass(1)[stage]._replace(pass_no=number))


@pytest.mark.parametrize(("first", "last"), [(0, 3), (-2, -1), (5, 4)])
def test_only_passes_can_be_dropped(first, last):
    with pytest.raises(ValueError, match=f"passes {first} to {last} cannot be dropped"):
        started().drop(first, last)


def test_a_record_of_another_loop_is_refused_by_a_free_running_one():
    with pytest.raises(ValueError, match="loop 0 was sent to the log of loop 2"):
        FreeLog(loop=2).append(plan(0))


def test_a_restored_log_goes_on_where_the_other_one_was():
    log = FreeLog.restore(0, (12, 6, 6, 4), [(7, 9), (2, 3), (10, 10)])
    assert log.dropped == ((7, 10),)
    assert [log.last(kind) for kind in (Observation, Symptom, ChangeRequest, ChangePlan)] == [12, 6, 6, 4]
    assert log.append(record(0, 13)) is Ack.OK
    assert log.append(record(1, 11)) is Ack.OK
    assert log.append(record(2, 12)) is Ack.GAP
    assert log.append(record(3, 5)) is Ack.OK


@pytest.mark.parametrize(
    ("last", "dropped"),
    [
        ((), ()),
        ((3, 2, 1), ()),
        ((3, 2, 1, 0, 0), ()),
        ((1, 2, 0, 0), ()),  # a Symptom of no Observation
        ((3, 0, 0, -1), ()),  # nothing comes before plan 0
        ((0, 0, 0, -2), ()),
        ((3, 2, 1, 0), [(2, 3)]),  # a Symptom of what was dropped
        ((3, 2, 1, 0), [(3, 4)]),  # dropped after the newest
        ((3, 2, 1, 0), [(0, 0)]),
        ((9, 2, 1, 0), [(5, 4)]),
    ],
)
def test_a_state_that_no_log_was_in_is_not_restored(last, dropped):
    with pytest.raises(ValueError, match="no free-running log ends with"):
        FreeLog.restore(0, last, dropped)
