"""What a role may have kept by Knowledge, and ask back: states, Q-tables, swaps, the past."""

import threading

import pytest
from bus_peers import eventually, serve_questions, want
from bus_records import observation, plan, run_of

from adapters.buses.messages import Control, State, Swapped, Table
from adapters.buses.questions import Refused
from knowledge import QTable
from mape.errors import BusError


def a_table(value=1.0):
    table = QTable((0, 3), 2)
    table.values[:] = [[value, -0.0], [5e-324, 1 / 3]]
    return table


def test_a_state_is_given_back_to_the_next_of_its_role(site, all_four):
    assert all_four["execute"].snapshot(0) is None
    site.send(*run_of(2))
    for number in (1, 2):
        all_four["execute"].keep_surely(State(loop=0, pass_no=number, state={"n": [number]}), a_table(number))
    state, table = site.member("execute").snapshot(0)
    assert state == State(loop=0, pass_no=2, state={"n": [2]})
    assert (table.actions, table.values.tobytes()) == ((0, 3), a_table(2).values.tobytes())
    assert all_four["plan"].snapshot(0) is None


def test_a_state_that_goes_ahead_of_the_log_is_not_kept(site, all_four):
    site.send(plan(0))
    all_four["monitor"].keep_surely(State(loop=0, pass_no=7, state={}))
    assert all_four["monitor"].snapshot(0) is None


def test_a_state_that_is_not_waited_for_is_kept_too(site, all_four):
    site.send(*run_of(1))
    all_four["monitor"].keep(State(loop=0, pass_no=1, state="soon"))
    eventually(lambda: all_four["monitor"].snapshot(0) is not None)


def test_a_state_travels_with_its_record(site, all_four):
    site.send(plan(0))
    state = State(loop=0, pass_no=1, state={"rng": 5})
    all_four["execute"].send(observation(1), state, a_table())
    all_four["execute"].settle(60)
    again, table = all_four["execute"].snapshot(0)
    assert (again, table.sha256()) == (state, a_table().sha256())


def test_a_remembered_table_can_be_had_by_its_hash_even_after_a_restart(site, all_four):
    key = all_four["plan"].remember(a_table())
    assert key == a_table().sha256()
    site.close()
    site.open()
    assert all_four["plan"].table(f"sha256={key}").sha256() == key
    with pytest.raises(Refused, match=r"no Q-table 000000000000\.\.\. is remembered"):
        all_four["plan"].table(f"sha256={'0' * 64}")


def test_a_table_of_an_episode_is_asked_of_execute_once(site, all_four):
    execute, asked, stop = all_four["execute"], [], threading.Event()

    def hand_out(question):
        asked.append(question.control)
        execute.answer(question, Table(loop=0, pass_no=question.control.pass_no).pack(a_table(7)))

    server = threading.Thread(target=serve_questions, args=(execute, hand_out, stop))
    server.start()
    try:
        first = all_four["plan"].table("loop=0;pass=3")
    finally:
        stop.set()
        server.join(60)
    again = all_four["plan"].table("loop=0;pass=3")
    assert first.sha256() == again.sha256() == a_table(7).sha256()
    assert asked == [Control(what="q_table", loop=0, pass_no=3)]


@pytest.mark.parametrize(
    "reply", [b"junk", Table(loop=0, pass_no=3).pack(), rb'{"schema":"Table/1","q_table":{"\ud800":1}}' + b"\n"]
)
def test_what_is_no_table_is_not_handed_on(site, all_four, reply):
    execute, stop = all_four["execute"], threading.Event()
    server = threading.Thread(
        target=serve_questions, args=(execute, lambda question: execute.answer(question, reply), stop)
    )
    server.start()
    try:
        with pytest.raises(BusError, match=r"did not answer plan \(later: "):
            all_four["plan"].ask("table?loop=0;pass=3", deadline=0.0)
    finally:
        stop.set()
        server.join(60)


def test_a_table_is_asked_for_again_while_execute_is_away(site):
    execute, planner = site.member("execute"), site.member("plan", patience=0.3)
    execute.close()
    with pytest.raises(
        BusError, match=r"did not answer plan \(later: Execute did not hand out its Q-table of pass 3\)"
    ):
        planner.table("loop=0;pass=3")


def test_a_swap_is_told_to_who_joins_next(site, all_four):
    to = {"name": "constant", "epsilon": 0.5}
    want(site.session(), site.wire, "plan", to, "q")
    swap = Swapped(loop=0, pass_no=4, part="plan", to=to, handed_over=True, question="q")
    all_four["plan"].swapped(swap)
    all_four["plan"].swapped(swap.model_copy(update={"pass_no": 9, "planned": True}))
    # What the config has planned each role knows by itself.
    told = swap.model_copy(update={"handed_over": False, "question": None})
    assert site.member("plan").joined.swaps == (told,)
    site.hub.close()
    assert [(s.pass_no, s.planned, s.handed_over) for s in site.ledger.store.swaps()] == [
        (4, False, True),
        (9, True, True),
    ]


def test_the_past_can_be_read(site, all_four):
    site.send(*run_of(3))
    assert all_four["plan"].history(0, {0: 2, 3: 3}) == [observation(2), observation(3), plan(3)]


def test_what_happened_is_noted(site, all_four):
    all_four["plan"].note("swap refused", "it would not", 0, 3)
    site.hub.close()
    event = site.ledger.store.events()[-1]
    assert (event.role, event.kind, event.text, event.loop, event.pass_no) == (
        "plan", "swap refused", "it would not", 0, 3,
    )  # fmt: skip
