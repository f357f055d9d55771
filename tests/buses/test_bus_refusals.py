"""What Knowledge takes from a role is that role's own affair, at its own time; whoever else says it is refused."""

import threading

import pytest
from bus_peers import Site, ask, join_of, serve_questions, want
from bus_records import TOLD, run_of

from adapters.buses.answers import TOLD_BY_ROLES
from adapters.buses.messages import Control, Happened, Joined, Layout, State, Swapped
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


ANYTHING = {"name": "own:Anything"}
QUESTION = "q"


def swapped(part, number, **other):
    told = {"loop": 0, "pass_no": number, "part": part, "to": ANYTHING, "question": QUESTION, **other}
    return Swapped(**told).pack()


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
    want(raw, site.wire, part, ANYTHING, QUESTION)
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
    want(raw, site.wire, part, ANYTHING, QUESTION)
    question = site.wire.ask(f"swapped/{owner(part)}")
    for number in (0, 1, 2):
        _, error = ask(raw, question, swapped(part, number), b"2")
        assert error == f"pass {number} has been made with the part before; {part} is replaced after it"
    # Who restarts tells of what was planned as it comes past it again.
    assert ask(raw, question, swapped(part, 1, planned=True), b"2") == (b"ok", None)
    assert ask(raw, question, swapped(part, 3), b"2") == (b"ok", None)
    assert [(swap.pass_no, swap.planned) for swap in kept(site)[0]] == [(1, True), (3, False)]


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("evil", [{"name": "subprocess:Popen", "args": ["id"]}, {**ANYTHING, "more": 1}, {"name": "x"}])
def test_a_role_puts_nothing_into_the_log_that_no_operator_asked_for(site, raw, part, evil):
    key = site.wire.ask(f"swapped/{owner(part)}")
    for question in (None, QUESTION, "another"):
        _, error = ask(raw, key, swapped(part, 1, to=evil, question=question), b"2")
        assert error.startswith("nobody asked Knowledge for")
    want(raw, site.wire, part, ANYTHING, QUESTION)
    for question in (None, QUESTION, "another"):
        _, error = ask(raw, key, swapped(part, 1, to=evil, question=question), b"2")
        assert error.startswith("nobody asked Knowledge for")
    assert kept(site) == NOTHING


def test_what_was_asked_for_is_answered_once_in_each_loop(wire, tmp_path):
    with Site(wire, tmp_path / "log.sqlite", units=2) as site:
        raw = site.session()
        site.everybody()
        want(raw, wire, "plan", ANYTHING, QUESTION)
        key = wire.ask("swapped/plan")
        for loop, number in ((0, 3), (1, 5), (1, 5)):  # the last of them, as who has not heard the answer says it again
            assert ask(raw, key, swapped("plan", number, loop=loop), b"1") == (b"ok", None)
        for loop, number in ((0, 4), (1, 6)):
            _, error = ask(raw, key, swapped("plan", number, loop=loop), b"1")
            assert f"loop {loop} has it from pass" in error
        assert [(swap.loop, swap.pass_no) for swap in kept(site)[0]] == [(0, 3), (1, 5)]


def test_a_question_asks_for_one_thing_however_often_it_is_asked(site, raw):
    want(raw, site.wire, "plan", ANYTHING, QUESTION)
    control = Control(what="swap", part="plan", to={"name": "q_learning"}, question=QUESTION).pack()
    reply, error = ask(raw, site.wire.ask("swap"), control)
    assert reply is None
    assert "own:Anything" in error


@pytest.mark.parametrize("lack", ["part", "to", "question"])
def test_a_swap_that_says_too_little_is_refused(site, raw, lack):
    told = {"what": "swap", "part": "plan", "to": ANYTHING, "question": QUESTION, lack: None}
    reply, error = ask(raw, site.wire.ask("swap"), Control(**told).pack())
    assert reply is None
    assert "names the part" in error


def test_what_a_role_refused_it_cannot_bring_in_later(site, raw):
    plan, stop = site.members["plan"], threading.Event()
    server = threading.Thread(target=serve_questions, args=(plan, lambda one: plan.refuse(one.query, "no"), stop))
    server.start()
    try:
        control = Control(what="swap", part="plan", to=ANYTHING, question=QUESTION).pack()
        assert ask(raw, site.wire.ask("swap"), control) == (None, "no")
    finally:
        stop.set()
        server.join(60)
    _, error = ask(raw, site.wire.ask("swapped/plan"), swapped("plan", 1), b"2")
    assert "it was refused" in error
    assert kept(site) == NOTHING


PLANNED = {"pass": 2, "part": "plan", "to": ANYTHING}


@pytest.fixture
def planning(wire, tmp_path):
    """A Knowledge whose config plans a swap."""
    with Site(wire, tmp_path / "log.sqlite", episodes=EPISODES) as site:
        site.hub.answers._config = {"swap": [PLANNED]}
        for role in ROLES:
            config = {"config": {"swap": [PLANNED]}}
            ask(site.session(), wire.ask(f"join/{role}"), join_of(role, **config))
        yield site


def test_what_the_config_has_planned_is_told_as_it_plans_it(planning):
    raw, key = planning.session(), planning.wire.ask("swapped/plan")
    others = [
        {"pass_no": 1}, {"pass_no": 3}, {"part": "plan.schedule"}, {"to": {"name": "subprocess:Popen"}},
        {"to": {**ANYTHING, "args": 1}},
    ]  # fmt: skip
    for other in others:
        number = other.pop("pass_no", 2)
        told = {"loop": 0, "pass_no": number, "part": "plan", "to": ANYTHING, "planned": True, **other}
        reply, error = ask(raw, key, Swapped(**told).pack(), b"1")
        assert reply is None
        assert error.startswith("the config plans no swap of")
    assert ask(raw, key, swapped("plan", 2, planned=True), b"1") == (b"ok", None)


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


@pytest.mark.parametrize(
    ("role", "kind"), [*((role, "swap refused") for role in ROLES), ("execute", "aborted"), ("execute", "carried")]
)
def test_an_event_is_told_by_the_newest_of_its_role_only(site, raw, role, kind):
    question = site.wire.ask(f"event/{role}")
    for epoch, sentence in (
        (b"1", f"another {role} has joined since (epoch 2; this one has 1)"),
        (b"3", f"no {role} of epoch 3 has joined this Knowledge; was its log lost?"),
        (None, "the epoch is ''; a whole number is taken"),
    ):
        reply, error = ask(raw, question, happened(kind, loop=0, pass_no=1), epoch)
        assert (reply, error) == (None, sentence)
    assert ask(raw, question, happened(kind, loop=0, pass_no=1), b"2") == (b"ok", None)
    assert [(event.role, event.kind) for event in kept(site)[1]] == [(role, kind)]


@pytest.mark.parametrize("kind", ["swapped", "joined", "refused", "dropped", "versions", "anything"])
def test_what_is_knowledges_own_word_is_told_by_no_role(site, raw, kind):
    for role in ROLES:
        _, error = ask(raw, site.wire.ask(f"event/{role}"), happened(kind), b"2")
        assert error == f"a role tells of {', '.join(TOLD_BY_ROLES)}; not of {kind!r}"
    swaps, told, states = kept(site)
    assert (swaps, told, states) == NOTHING
    refused = [event for event in site.ledger.store.events() if event.kind == "refused"]
    assert len(refused) == len(ROLES)
