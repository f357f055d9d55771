"""What is too large for one message comes in pieces, each of them once, whatever happens to Knowledge in between."""

import threading

import numpy as np
import pytest
from bus_peers import eventually, received, serve_questions
from bus_records import observation, plan, run_of
from hypothesis import given
from hypothesis import strategies as st

from adapters.buses import pieces
from adapters.buses.messages import State, Table
from knowledge import MalformedRecord, QTable

LARGE = 40_000
"""States of a table of 640 kB: twenty pieces."""


def large(value=0.0):
    table = QTable((0, 3), LARGE)
    table.values[:] = value + np.arange(2 * LARGE).reshape(2, LARGE)
    return table


def state_of(number):
    return State(loop=0, pass_no=number, state={"n": number})


@pytest.fixture
def heard(site, monkeypatch):
    """What Knowledge is sent and asked under `knowledge`, by the word after it; `heard.stops_at` closes it there."""
    found, answers = [], site.hub.answers
    true_asked = type(answers).asked

    def asked(self, query):
        found.append((str(query.key_expr).split("/knowledge/")[1], len(query.payload) if query.payload else 0))
        return true_asked(self, query)

    monkeypatch.setattr(type(answers), "asked", asked)
    return found


def pieces_of(heard):
    return [size for what, size in heard if what.startswith("piece/")]


def test_a_large_state_is_kept_in_pieces_and_given_back_in_pieces(site, all_four, heard):
    site.send(*run_of(2))
    all_four["execute"].keep_surely(state_of(2), large())
    count = len(pieces_of(heard))
    assert count == -(-len(state_of(2).pack(large())) // pieces.PIECE)
    assert max(size for _, size in heard) < 2 * pieces.PIECE
    state, table = site.member("execute").snapshot(0)
    assert (state, table.sha256()) == (state_of(2), large().sha256())


def test_records_go_their_way_between_the_pieces_and_a_newer_state_takes_the_place_of_one_that_waits(
    site, all_four, heard
):
    execute, monitor = all_four["execute"], all_four["monitor"]
    monitor.watch(0, 1)
    site.send(plan(0))
    states = [State(loop=0, pass_no=1, state=number) for number in range(5)]
    for state in states:
        execute.keep(state, large(state.state))
    execute.send(observation(1))
    execute.settle(60)
    assert received(monitor, 1) == [observation(1)]

    def is_kept():
        execute.receive(0.0)
        found = site.ledger.store.snapshot(0, "execute")
        return found is not None and found.state == 4

    eventually(is_kept)
    # The first was under way, the last took the place of all in between.
    assert len(pieces_of(heard)) <= 2 * -(-len(states[0].pack(large())) // pieces.PIECE)


def test_a_state_whose_pieces_a_restart_lost_is_handed_over_again_and_its_record_is_taken_with_it(site, all_four):
    execute = all_four["execute"]
    site.send(plan(0))
    execute.send(observation(1), state_of(1), large(1))
    site.hub.answers._gathered["execute"].forget(pieces.sha256(state_of(1).pack(large(1))))
    execute.settle(60)
    state, table = execute.snapshot(0)
    assert (state, table.sha256()) == (state_of(1), large(1).sha256())
    assert site.ledger.last(0)[0] == 1


def test_a_table_of_an_episode_is_relayed_in_pieces_and_fetched_once(site, all_four, heard):
    execute, asked, stop, given_out = all_four["execute"], [], threading.Event(), pieces.Given()

    def hand_out(question):
        asked.append(question.control)
        control = question.control
        further = given_out.further(control.whole, control.at) if control.whole else None
        execute.answer(question, further or given_out.answer(Table(loop=0, pass_no=3).pack(large(7))))

    server = threading.Thread(target=serve_questions, args=(execute, hand_out, stop))
    server.start()
    try:
        table = all_four["plan"].table("loop=0;pass=3")
    finally:
        stop.set()
        server.join()
    assert table.sha256() == large(7).sha256()
    assert len(asked) == -(-len(Table(loop=0, pass_no=3).pack(large(7))) // pieces.PIECE)


def test_a_large_table_is_remembered_and_recalled(all_four):
    key = all_four["plan"].remember(large(2))
    assert all_four["execute"].table(f"sha256={key}").sha256() == key == large(2).sha256()


@given(size=st.integers(pieces.PIECE + 1, 5 * pieces.PIECE), lost=st.sets(st.integers(0, 12)), seed=st.integers(0, 9))
def test_a_whole_comes_whole_whatever_is_lost_or_comes_twice(size, lost, seed):
    data = np.random.default_rng(seed).bytes(size)
    whole, at, gathered = pieces.sha256(data), 0, pieces.Gathered(1 << 20)
    for attempt in range(40):
        came = gathered.take(pieces.cut(data, whole, at))
        if attempt not in lost:  # the acknowledgement
            at = came
        if at == size:
            break
    assert gathered.whole(whole) == data


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"{}",
        pieces.cut(b"x" * 10, "0" * 64, 0)[:-10],
        pieces.cut(b"x" * 10, "0" * 64, 0) + b"more",
        b'{"schema":"Piece/1","whole":"x","size":9,"at":0}\nx',
    ],
)
def test_what_is_no_piece_is_refused(payload):
    with pytest.raises(MalformedRecord):
        pieces.Gathered(1 << 20).take(payload)


def test_pieces_that_do_not_make_what_they_say_are_let_go():
    gathered = pieces.Gathered(1 << 20)
    with pytest.raises(MalformedRecord, match="do not make"):
        gathered.take(pieces.cut(b"x" * 10, "0" * 64, 0))
    assert gathered.whole("0" * 64) is None
    with pytest.raises(MalformedRecord, match="at most"):
        pieces.Gathered(5).take(pieces.cut(b"x" * 10, "0" * 64, 0))
