"""What Knowledge takes from a role is that role's own affair, at its own time; whoever else says it is refused."""

import pytest
from bus_peers import Site, ask, join_of
from bus_records import TOLD, run_of

from adapters.buses.messages import Happened, Joined, Layout, State, Swapped
from adapters.roles import ROLES
from knowledge import QTable
from mape.parts import owner

EPISODES = 3
PARTS = ("monitor", "monitor.0", "analyze", "plan", "plan.schedule", "learner")
OTHER = Layout(signals=("evil",), detectors=0, rates=1, max_actions=1)


@pytest.fixture
def site(wire, tmp_path):
    """A Knowledge that every role has joined, each twice: the first one of each has been superseded."""
    with Site(wire, tmp_path / "log.sqlite", episodes=EPISODES) as site:
        for _ in range(2):
            site.everybody()
        yield site


def swapped(part, number, **other):
    return Swapped(loop=0, pass_no=number, part=part, to={"name": "own:Anything"}, **other).pack()


def happened(kind, **other):
    return Happened(kind=kind, text="said", **other).pack()


def kept(site):
    """What the store holds beside the records, once all that was asked is done."""
    site.hub.close()
    store = site.ledger.store
    told = [event for event in store.events() if event.kind not in ("joined", "refused")]
    return store.swaps(), told, [store.snapshot(0, role) for role in ROLES]


NOTHING = ([], [], [None] * 4)


# Parts.


@pytest.mark.parametrize("part", PARTS)
def test_a_swap_is_told_by_the_role_whose_part_it_is_and_by_no_other(site, raw, part):
    for role in ROLES:
        reply, error = ask(raw, site.wire.ask(f"swapped/{role}"), swapped(part, 1), b"2")
        if role == owner(part):
            assert reply == b"ok"
        else:
            assert error == f"{part} is a part of {owner(part)}, not of {role}"
    for role in ROLES:
        reply, _ = ask(raw, site.wire.ask(f"join/{role}"), join_of(role))
        assert [one.part for one in Joined.unpack(reply)[0].swaps] == [part]
    assert [swap.part for swap in kept(site)[0]] == [part]


@pytest.mark.parametrize("part", PARTS)
def test_a_swap_of_a_pass_that_is_in_the_log_is_refused_unless_the_config_planned_it(site, raw, part):
    site.send(*run_of(2))
    question = site.wire.ask(f"swapped/{owner(part)}")
    for number in (0, 1, 2):
        _, error = ask(raw, question, swapped(part, number), b"2")
        assert error == f"pass {number} has been made with the part before; {part} is replaced after it"
    # Who restarts tells of what was planned as it comes past it again.
    assert ask(raw, question, swapped(part, 1, planned=True), b"2") == (b"ok", None)
    assert ask(raw, question, swapped(part, 3), b"2") == (b"ok", None)
    assert [(swap.pass_no, swap.planned) for swap in kept(site)[0]] == [(1, True), (3, False)]


def test_a_part_that_is_none_is_refused(site, raw):
    for role in ROLES:
        _, error = ask(raw, site.wire.ask(f"swapped/{role}"), swapped("nonsense", 1), b"2")
        assert "nonsense" in error
    assert kept(site) == NOTHING


# The layout.


@pytest.mark.parametrize("role", ROLES[1:])
def test_a_layout_that_another_role_than_execute_tells_is_not_heeded(wire, role):
    with Site(wire) as site:
        raw = site.session()
        reply, _ = ask(raw, wire.ask(f"join/{role}"), join_of(role, layout=OTHER))
        assert reply is None or Joined.unpack(reply)[0].layout is None
        reply, error = ask(raw, wire.ask("join/execute"), join_of("execute"))
        assert error is None
        assert Joined.unpack(reply)[0].layout == TOLD


# The end.


@pytest.mark.parametrize("number", range(EPISODES))
def test_a_final_state_before_the_last_pass_does_not_complete_a_run(site, raw, number):
    site.send(*run_of(number))
    final = State(loop=0, pass_no=number, state={}, final=True).pack(QTable((0, 1), 2))
    _, error = ask(raw, site.wire.ask("snapshot/execute"), final, b"2")
    assert error == f"a state of pass {number} is not the last one of {EPISODES} passes"
    assert not site.hub.ended.is_set()
    assert kept(site) == NOTHING


@pytest.mark.parametrize("role", ROLES[1:])
def test_a_final_state_of_another_role_than_execute_does_not_complete_a_run(site, raw, role):
    site.send(*run_of(EPISODES))
    ask(raw, site.wire.ask(f"snapshot/{role}"), State(loop=0, pass_no=EPISODES, state={}, final=True).pack(), b"2")
    ask(raw, site.wire.ask("status"))
    assert not site.hub.ended.is_set()


def test_the_final_state_of_execute_at_the_last_pass_completes_a_run(site, raw):
    site.send(*run_of(EPISODES))
    final = State(loop=0, pass_no=EPISODES, state={}, final=True).pack(QTable((0, 1), 2))
    assert ask(raw, site.wire.ask("snapshot/execute"), final, b"2")[1] is None
    assert site.hub.ended.wait(60)


# Events.


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("kind", ["aborted", "swap refused"])
def test_an_event_is_told_by_the_newest_of_its_role_only(site, raw, role, kind):
    question = site.wire.ask(f"event/{role}")
    for epoch, sentence in (
        (b"1", f"another {role} has joined since (epoch 2; this one has 1)"),
        (b"3", f"no {role} of epoch 3 has joined this Knowledge; was its log lost?"),
        (None, "the epoch is ''; a whole number is taken"),
    ):
        reply, error = ask(raw, question, happened(kind), epoch)
        assert (reply, error) == (None, sentence)
    assert ask(raw, question, happened(kind), b"2") == (b"ok", None)
    assert [(event.role, event.kind) for event in kept(site)[1]] == [(role, kind)]


@pytest.mark.parametrize("kind", ["swapped", "joined", "refused", "dropped", "versions", "anything"])
def test_what_is_knowledges_own_word_is_told_by_no_role(site, raw, kind):
    for role in ROLES:
        _, error = ask(raw, site.wire.ask(f"event/{role}"), happened(kind), b"2")
        assert error == f"a role tells of begun, aborted, swap refused; not of {kind!r}"
    swaps, told, states = kept(site)
    assert (swaps, told, states) == NOTHING
    refused = [event for event in site.ledger.store.events() if event.kind == "refused"]
    assert len(refused) == len(ROLES)
