"""Nobody who has a role's secret slows the run by asking, or fills the memory of Knowledge by one message."""

import threading
from collections import deque
from queue import SimpleQueue
from types import SimpleNamespace

import pytest
from bus_peers import Site, eventually
from bus_records import run_of
from hypothesis import given
from hypothesis import strategies as st

from adapters.buses import Wire, pace
from adapters.buses.pace import FEW, ROOM, Counted, Pace, Room
from mape.errors import BusError


@pytest.fixture
def clock(monkeypatch):
    now = SimpleNamespace(at=1000.0)
    monkeypatch.setattr(pace.time, "monotonic", lambda: now.at)
    return now


def question(what, number=0):
    return SimpleNamespace(key_expr=f"mape/s/knowledge/{what}", number=number)


@given(st.integers(1, 200), st.integers(0, 3000))
def test_of_a_flood_only_so_many_are_let_through_and_the_rest_waits_or_is_left(most, asked):
    now = SimpleNamespace(at=1000.0)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(pace.time, "monotonic", lambda: now.at)
        taken, left = [], []
        gate = Pace(taken.append, left.append, most)
        for number in range(asked):
            gate.hear(question("status", number))
    assert len(taken) <= most + 1
    assert gate._late.qsize() <= pace.WAITS * most + 1
    assert len(taken) + gate._late.qsize() + len(left) == asked


def test_a_flood_of_one_kind_or_role_holds_up_no_other(clock):
    taken = []
    gate = Pace(taken.append, lambda query: None, 10)
    for _ in range(10_000):
        gate.hear(question("status"))
        gate.hear(question("join/plan"))
    before = len(taken)
    for what in ("join/monitor", "since", "snapshot/plan", "table", "swap"):
        gate.hear(question(what))
    assert len(taken) == before + 5


def test_what_was_too_much_is_answered_in_its_second_and_in_order():
    taken, enough = [], threading.Event()
    gate = Pace(lambda query: taken.append(query.number) or (len(taken) == 60 and enough.set()), lambda query: None, 50)
    gate.start()
    for number in range(60):
        gate.hear(question("status", number))
    assert enough.wait(60)
    gate.stop()
    assert taken == list(range(60))


def test_kinds_that_there_are_not_fill_no_memory(clock):
    gate = Pace(lambda query: None, lambda query: None, 10)
    for number in range(5000):
        gate.hear(question(f"made-up-{number}"))
    assert len(gate._turn) <= 257


@pytest.fixture
def small(tmp_path, tmp_path_factory):
    """A Knowledge that takes in no more than a megabyte at once."""
    wire = Wire(f"unixsock-stream/{tmp_path_factory.mktemp('z')}/k.sock", "s", largest=1 << 20)
    with Site(wire, tmp_path / "log.sqlite") as site:
        yield site


def test_a_message_that_is_too_large_is_thrown_away_and_the_run_goes_on(small):
    small.everybody()
    with small.wire.join("plan", 60) as evil:
        replies = evil.get("mape/s/0/append/plan", payload=b" " * (32 << 20), attachment=b"1", timeout=2)
        assert [reply.ok for reply in replies if reply.ok is not None] == []
    small.send(*run_of(3))
    assert small.ledger.last(0) == (3, 3, 3, 3)


def test_a_role_whose_message_is_too_large_says_what_to_give(small):
    plan = small.everybody()["plan"]
    with pytest.raises(BusError, match=r"at most 1,048,576 are taken: give --largest-message 4 to all"):
        plan.ask("status", b" " * (2 << 20))


def test_a_flood_of_status_is_answered_late_and_the_records_are_not(small):
    small.everybody()
    asked, stop = [], threading.Event()

    def flood():
        with small.wire.join("operator", 60) as operator:
            while not stop.is_set():
                asked.append(operator.get("mape/s/knowledge/status", timeout=60))

    flooding = threading.Thread(target=flood)
    flooding.start()
    try:
        eventually(lambda: len(asked) > 500)
        small.send(*run_of(3))
    finally:
        stop.set()
        flooding.join(60)
    assert small.ledger.last(0) == (3, 3, 3, 3)


@given(
    st.integers(1, 50),
    st.integers(0, 9),
    st.lists(st.sampled_from(["plan", "monitor", "made-up", "heard"]), max_size=300),
)
def test_of_each_role_so_much_waits_whatever_the_others_send(most, few, sent):
    queue, left = SimpleQueue(), []
    room = Room(queue, "append", left.append, most, few)
    waiting = deque()  # of each its role, and whether it was counted
    for what in sent:
        if what != "heard":
            message = SimpleNamespace(key_expr=f"mape/s/0/append/{what}")
            counted = len(waiting) >= few
            fits = not counted or waiting.count((what, True)) < most
            before = queue.qsize()
            room.hear(message)
            assert queue.qsize() - before == fits
            assert fits or left[-1] is message
            waiting += [(what, counted)] * fits
        elif waiting:
            kind, message = queue.get()
            assert kind == "append"
            assert isinstance(message, Counted) == waiting.popleft()[1]
            if isinstance(message, Counted):
                message.room.heard(message.what)


def test_a_flood_of_records_of_one_role_fills_no_memory_and_holds_up_no_other(small, monkeypatch):
    small.everybody()
    small.send(*run_of(3))
    append, busy, go_on, heard = small.hub.answers.append, threading.Event(), threading.Event(), []

    def slowly(query):
        if "append/plan" in str(query.key_expr):
            heard.append(query)
            busy.set()
            assert go_on.wait(60)
        return append(query)

    monkeypatch.setattr(small.hub.answers, "append", slowly)
    flood = 2 * ROOM
    with small.wire.join("plan", 60) as evil:
        for number in range(flood):
            replies = evil.get("mape/s/0/append/plan", payload=b"{}", attachment=b"1", timeout=60)
            assert number or busy.wait(60)
        assert list(replies) == []  # which ends at once, for it was left; as what is answered it would take a minute
        go_on.set()
        small.members["monitor"].ask("status")
    assert len(heard) <= ROOM + FEW + 1
