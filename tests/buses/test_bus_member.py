"""What a role may rely on: in order, each once, whatever is lost, late, repeated or forged on the way."""

import threading

import pytest
from bus_peers import Site, ask, eventually, lose, of, received, serve_questions, status
from bus_records import TOLD, new_ledger, observation, plan, run_of, symptom

from adapters.buses import Member, answers, hub, member
from adapters.buses.member import Asked
from adapters.buses.messages import Control, State, Swapped
from adapters.buses.questions import Refused
from adapters.buses.wire import ORDERED
from knowledge import Observation, to_json
from mape.errors import BusError, ConfigError

# In order, each once.


def test_each_role_gets_what_the_one_before_it_sent_in_order_and_each_once(site, all_four):
    for role, peer in all_four.items():
        peer.watch(0, 0 if role == "execute" else 1)
    site.send(*run_of(5))
    for role, peer in all_four.items():
        assert received(peer, len(of(role, run_of(5)))) == of(role, run_of(5))


def test_numbers_come_back_as_the_same_bits(site, all_four):
    values = [0.1 + 0.2, -0.0, 5e-324, 1.7976931348623157e308, -1 / 3]
    all_four["monitor"].watch(0, 1)
    site.send(plan(0))
    for number, value in enumerate(values, 1):
        site.send(observation(number, value))
        site.send(*[record._replace(signals={"return": value}) for record in run_of(number)[-3:-1]], plan(number))
    got = received(all_four["monitor"], len(values))
    assert [seen.signals["return"].hex() for seen in got] == [value.hex() for value in values]


def test_only_the_loops_that_are_watched_are_received(wire):
    with Site(wire, units=3) as site:
        all_four = site.everybody()
        reader = all_four["monitor"]
        reader.watch(2, 1)
        reader.watch(0, 2)
        for loop in range(3):
            site.send(*run_of(2, loop=loop))
        got = received(reader, 3)
        assert [r for r in got if r.loop == 0] == [observation(2)]
        assert [r for r in got if r.loop == 2] == [observation(1, loop=2), observation(2, loop=2)]
        reader.unwatch(2)
        site.send(observation(3, loop=2), observation(3))
        assert received(reader, 1) == [observation(3)]


def test_a_record_is_sent_on_without_waiting_for_the_one_before(site, all_four):
    execute = all_four["execute"]
    with pytest.MonkeyPatch.context() as patch:
        held = threading.Event()
        true_take = site.ledger.take
        patch.setattr(site.ledger, "take", lambda *given: (held.wait(60), true_take(*given))[1])
        for number in range(1, 4):
            execute.send(observation(number))
        assert execute.unacknowledged(0) == 3
        held.set()
    all_four["plan"].send(plan(0))
    all_four["plan"].settle(60)
    assert execute.unacknowledged(0) >= 2  # they came before their time, and are kept


# Late, lost, repeated.


@pytest.mark.parametrize("limit", [1, 2, 512])
def test_who_joins_late_gets_all_from_where_it_asks_for_it(site, monkeypatch, limit):
    monkeypatch.setattr(answers, "SINCE_LIMIT", limit)
    site.everybody()
    site.send(*run_of(5))
    late = site.member("plan")
    late.watch(0, 1)
    assert received(late, 5) == of("plan", run_of(5))
    later = site.member("monitor")
    later.watch(0, 4)
    assert received(later, 2) == of("monitor", run_of(5))[3:]
    site.send(observation(6))
    assert received(later, 1) == [observation(6)]


class Unreliable:
    """Knowledge's session, which loses, repeats or garbles some of what is published of a role."""

    def __init__(self, site, role, how):
        self.session, self.key = site.hub._session, site.wire.stream(role, 0)
        self.count, self.how = 0, how
        site.hub._session = self

    def put(self, key, payload, **options):
        changed = self.how(self.count, payload) if key == self.key else [payload]
        self.count += key == self.key
        for one in changed:
            self.session.put(key, one, **options)

    def close(self):
        self.session.close()


@pytest.mark.parametrize("lost", [{0}, {1}, {0, 1}, {3, 4, 5}, {9}, set(range(10))])
def test_a_publication_that_is_lost_is_fetched(site, all_four, lost):
    Unreliable(site, "execute", lambda count, payload: [] if count in lost else [payload])
    all_four["monitor"].watch(0, 1)
    site.send(*run_of(10))
    assert received(all_four["monitor"], 10) == of("monitor", run_of(10))


@pytest.mark.parametrize(
    "how",
    [
        lambda count, payload: [payload] * 3,
        lambda count, payload: [payload[1:]],
        lambda count, payload: [b"", payload.replace(b'"pass"', b'"past"'), payload],
        lambda count, payload: [payload + b" " * (1 << 20)],
    ],
    ids=["three times", "cut", "junk before it", "oversized"],
)
def test_what_is_published_more_than_once_or_garbled_is_delivered_once_as_the_log_has_it(site, all_four, how):
    Unreliable(site, "execute", how)
    reader, got = all_four["monitor"], []
    reader.watch(0, 1)
    for record in run_of(3):
        site.send(record)
        if isinstance(record, Observation):
            got += received(reader, 1)
    assert got == of("monitor", run_of(3))


def test_a_record_that_is_lost_on_its_way_to_knowledge_is_sent_again(site, all_four, impatient, monkeypatch):
    lost = lose(monkeypatch, site, lambda data: True)
    site.send(*run_of(4))
    assert lost == [to_json(record) for record in run_of(4)]
    assert site.ledger.last(0) == (4, 4, 4, 4)


def test_where_one_is_lost_those_behind_it_are_sent_again_too(wire, impatient, monkeypatch):
    with Site(wire, free=True) as site:
        site.everybody()
        lost = lose(monkeypatch, site, lambda data: b'"pass":2,' in data or b'"pass":30,' in data)
        site.send(plan(0))
        execute = site.members["execute"]
        for number in range(1, 101):
            execute.send(observation(number))
        execute.settle(60)
        assert lost == [to_json(observation(2)), to_json(observation(30))]
        assert site.ledger.last(0) == (100, 0, 0, 0)


def test_an_acknowledgement_that_is_late_brings_the_record_again_and_it_is_taken_once(
    site, all_four, impatient, monkeypatch
):
    answers, true_take = [], site.ledger.take

    def slow_once(*given):
        taken = true_take(*given)
        if not answers:
            eventually(lambda: not site.hub._asked.empty())  # the sender has lost patience, and sent it again
        answers.append(taken.ack.value)
        return taken

    monkeypatch.setattr(site.ledger, "take", slow_once)
    site.send(plan(0))
    site.send(observation(1))
    assert answers[:2] == ["ok", "duplicate"]
    assert site.ledger.last(0) == (1, 0, 0, 0)


# What strangers say.

STRAYS = {
    "nothing": b"",
    "junk": b"\xff\xfe\x00garbage",
    "another version": to_json(observation(1)).replace(b"Observation/1", b"Observation/2"),
    "far ahead": to_json(observation(900)),
    "exactly next": to_json(observation(1, 99.0)),
    "of another kind": to_json(symptom(1)),
    "of another loop": to_json(observation(1, loop=3)),
    "before the log": to_json(observation(-4)),
    "endlessly far": to_json(observation(10**30)),
    "oversized": b" " * ((1 << 20) + 1),
}


@pytest.mark.parametrize("seal", [None, b"guessed"])
@pytest.mark.parametrize("stray", STRAYS.values(), ids=STRAYS)
def test_what_a_stranger_publishes_is_counted_and_not_delivered(site, all_four, stray, seal):
    reader = all_four["monitor"]
    reader.watch(0, 1)
    site.send(plan(0))
    site.session().put(site.wire.stream("execute", 0), stray, attachment=seal, **ORDERED)

    def counted():
        assert reader.receive(0.01) is None
        return reader.refused == 1

    eventually(counted)
    site.send(*run_of(2)[1:])
    assert received(reader, 2) == of("monitor", run_of(2))


def test_what_a_member_refused_is_told_in_the_status(site, all_four):
    raw = site.session()
    raw.put(site.wire.stream("execute", 0), b"junk", **ORDERED)
    eventually(lambda: all_four["monitor"].receive(0.01) is not None or all_four["monitor"].refused == 1)
    all_four["monitor"].beat()
    eventually(lambda: status(raw, site.wire).roles["monitor"].refused == 1)


@pytest.mark.parametrize(
    "payload",
    [None, b"", b"junk", b"{}", b" " * ((1 << 20) + 1), rb'{"schema":"Control/1","q_table":{"\ud800":1}}' + b"\n",
     Control(what="swap").pack().replace(b"swap", b"spin"), State(loop=0, pass_no=0, state={}).pack()],
)  # fmt: skip
def test_a_malformed_question_to_a_role_is_refused_and_counted(site, all_four, payload):
    reader, stop = all_four["monitor"], threading.Event()
    asking = site.session()
    server = threading.Thread(target=serve_questions, args=(reader, pytest.fail, stop))
    server.start()
    try:
        reply, error = ask(asking, site.wire.control("monitor"), payload, site.hub._seal)
    finally:
        stop.set()
        server.join(60)
    assert reply is None
    assert error
    assert reader.refused == 1


@pytest.mark.parametrize("seal", [None, b"", b"another"])
def test_a_question_that_does_not_come_from_knowledge_is_refused(site, all_four, seal):
    reader, stop = all_four["plan"], threading.Event()
    server = threading.Thread(target=serve_questions, args=(reader, pytest.fail, stop))
    server.start()
    try:
        payload = Control(what="swap", part="plan", to={"name": "q_learning"}).pack()
        reply, error = ask(site.session(), site.wire.control("plan"), payload, seal)
    finally:
        stop.set()
        server.join(60)
    assert reply is None
    assert "asked by Knowledge alone" in error
    assert reader.refused == 1


def test_a_question_to_a_role_comes_between_its_records(site, all_four):
    asking = site.session()
    site.send(plan(0))
    payload = Control(what="q_table", loop=0, pass_no=0).pack()
    question = asking.get(site.wire.control("execute"), payload=payload, attachment=site.hub._seal)
    got = []
    eventually(lambda: got.append(all_four["execute"].receive(0.01)) or isinstance(got[-1], Asked))
    assert got[-1].control == Control(what="q_table", loop=0, pass_no=0)
    all_four["execute"].answer(got[-1], b"here")
    (answer,) = question
    assert (str(answer.ok.key_expr), answer.ok.payload.to_bytes()) == (site.wire.control("execute"), b"here")


# What Knowledge refuses.


def test_a_conflict_comes_out_of_settling(site, all_four):
    site.send(plan(0))
    all_four["plan"].send(plan(0, epsilon=0.25))
    with pytest.raises(
        Refused, match=r"plan is refused by Knowledge: ChangePlan 0 of loop 0 differs .*epsilon is 0\.5"
    ):
        all_four["plan"].settle(60)


def test_a_refusal_comes_out_of_receiving(site, all_four):
    all_four["plan"].send(plan(0)._replace(learning_rate=(0.1, 0.2)))
    with pytest.raises(Refused, match="does not fit the run's layout"):
        all_four["plan"].receive(10)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_number_that_is_not_finite_does_not_leave_the_process(site, all_four, value):
    with pytest.raises(BusError, match=r"ChangePlan 0 cannot be written for the wire: .*not finite"):
        all_four["plan"].send(plan(0, epsilon=value))
    assert all_four["plan"].unacknowledged(0) == 0


def test_one_that_was_superseded_is_told_so(site, all_four):
    old = all_four["plan"]
    new = site.member("plan")
    assert (old.joined.epoch, new.joined.epoch) == (1, 2)
    old.send(plan(0))
    with pytest.raises(Refused, match=r"another plan has joined since \(epoch 2; this one has 1\)"):
        old.settle(60)
    for forbidden in (
        lambda: old.keep_surely(State(loop=0, pass_no=0, state={})),
        lambda: old.swapped(Swapped(loop=0, pass_no=1, part="plan", to={})),
    ):
        with pytest.raises(Refused, match="another plan has joined since"):
            forbidden()
    new.send(plan(0))
    new.settle(60)


def test_who_has_another_config_does_not_join(wire):
    with (
        hub.KnowledgeHub(new_ledger(), wire, {"seed": 1}),
        pytest.raises(
            ConfigError, match="monitor has another config than Knowledge: seed is 2 in monitor, and 1 in Know"
        ),
    ):
        Member(wire, "monitor", config={"seed": 2}).connect()


# Waiting.


def test_one_that_finds_nobody_waits_and_says_for_whom(wire):
    said, joined = [], []

    def join():
        with Member(wire, "plan", waiting=said.append) as peer:
            joined.append(peer.joined.epoch)

    joining = threading.Thread(target=join)
    joining.start()
    eventually(lambda: said)
    assert said == [f"waiting for Knowledge on {wire.endpoint}"]
    with Site(wire, begun=True):
        joining.join(60)
        assert joined == [1]
    assert len(said) == 1


def test_one_that_has_no_layout_waits_for_execute_and_says_so(site):
    said, joined = [], []

    def join():
        with Member(site.wire, "monitor", waiting=said.append) as peer:
            joined.append(peer.joined.layout)

    joining = threading.Thread(target=join)
    joining.start()
    eventually(lambda: said)
    assert said == ["waiting for Execute, which has the managed system"]
    assert joined == []
    site.member("execute")
    joining.join(60)
    assert joined == [TOLD]


def test_while_one_waits_for_execute_nothing_piles_up(site):
    """It asks again and again, and has not joined as often."""
    with pytest.raises(BusError, match="monitor waited in vain for an Execute to tell"):
        Member(site.wire, "monitor", patience=0.6).connect()
    site.hub.close()
    assert len(site.ledger.store.events()) <= 2


@pytest.mark.parametrize("patience", [0.0, 0.1])
def test_without_anybody_there_a_patient_one_gives_up(wire, patience):
    with pytest.raises(BusError, match="no Knowledge answers on unixsock-stream"):
        Member(wire, "plan", patience=patience).connect()


def test_without_knowledge_settling_gives_up_after_its_patience(site, all_four):
    site.hub.close()
    all_four["plan"].send(plan(0))
    with pytest.raises(BusError, match="did not acknowledge what plan sent in time"):
        all_four["plan"].settle(0.2)


def test_one_that_is_not_connected_says_so(wire):
    peer = Member(wire, "plan")
    for do in (
        lambda: peer.send(plan(0)),
        lambda: peer.watch(0, 1),
        lambda: peer.ask("status"),
        lambda: peer.keep(State(loop=0, pass_no=0, state={})),
    ):
        with pytest.raises(BusError, match=r"plan is not connected; call connect\(\)"):
            do()
    peer.beat()
    peer.close()


def test_who_is_there_is_seen_and_who_left_is_not(site):
    raw = site.session()

    def present():
        return {role for role, known in status(raw, site.wire).roles.items() if known.alive}

    assert present() == set()
    with Member(site.wire, "execute", layout=TOLD), Member(site.wire, "plan"):
        eventually(lambda: present() == {"execute", "plan"})
    eventually(lambda: present() == set())


# A socket of the net.


def test_it_runs_over_tcp_as_well():
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with Site(member.Wire(f"tcp/127.0.0.1:{port}", "example")) as site:
        all_four = site.everybody()
        all_four["monitor"].watch(0, 1)
        site.send(*run_of(2))
        assert received(all_four["monitor"], 2) == of("monitor", run_of(2))
