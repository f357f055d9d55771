"""What a role may rely on: in order, each once, whatever is lost, late, repeated or forged on the way."""

import gc
import threading

import pytest
from bus_peers import Site, ask, eventually, play_part, received, serve_questions, status
from bus_records import TOLD, new_ledger, observation, plan, run_of, symptom

from adapters.buses import Member, answers, hub, inbox, member, outbox, questions
from adapters.buses.member import Asked
from adapters.buses.messages import Control, State, Swapped, Table
from adapters.buses.questions import Refused
from adapters.buses.wire import INPUT, ORDERED
from adapters.roles import ROLES
from knowledge import Observation, QTable, to_json
from mape.errors import BusError, ConfigError

pytestmark = pytest.mark.timeout(60)


@pytest.fixture
def site(wire, tmp_path):
    with Site(wire, tmp_path / "log.sqlite") as site:
        yield site


@pytest.fixture
def all_four(site):
    return site.everybody()


def of(role, records):
    """Pick what a role takes."""
    return [record for record in records if type(record) is INPUT[role]]


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
        patch.setattr(site.ledger, "take", lambda *given: (held.wait(10), true_take(*given))[1])
        for number in range(1, 4):
            execute.send(observation(number))
        assert execute.unacknowledged(0) == 3
        held.set()
    all_four["plan"].send(plan(0))
    all_four["plan"].settle(10)
    assert execute.unacknowledged(0) >= 2  # they came before their time, and are kept


# Late, lost, repeated.


@pytest.mark.parametrize("limit", [1, 2, 512])
def test_who_joins_late_gets_all_from_where_it_asks_for_it(site, monkeypatch, limit):
    for module in (answers, inbox):
        monkeypatch.setattr(module, "SINCE_LIMIT", limit)
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


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(outbox, "RESEND_AFTER", 0.02)
    monkeypatch.setattr(outbox, "REPEAT_AFTER", 0.01)
    monkeypatch.setattr(member, "KEEP_UP_EVERY", 0.01)


def lose(monkeypatch, site, wanted):
    """Let Knowledge not hear what `wanted` names, once each."""
    lost, true_append = [], site.hub.answers.append

    def append(query):
        data = query.payload.to_bytes()
        if data not in lost and wanted(data):
            lost.append(data)
            query.drop()
            return None
        return true_append(query)

    monkeypatch.setattr(site.hub.answers, "append", append)
    return lost


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
        execute.settle(10)
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
        reply, error = ask(asking, site.wire.control("monitor"), payload)
    finally:
        stop.set()
        server.join(10)
    assert reply is None
    assert error
    assert reader.refused == 1


def test_a_question_to_a_role_comes_between_its_records(site, all_four):
    asking = site.session()
    site.send(plan(0))
    question = asking.get(site.wire.control("execute"), payload=Control(what="q_table", loop=0, pass_no=0).pack())
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
        all_four["plan"].settle(10)


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
        old.settle(10)
    for forbidden in (
        lambda: old.keep_surely(State(loop=0, pass_no=0, state={})),
        lambda: old.swapped(Swapped(loop=0, pass_no=1, part="plan", to={})),
    ):
        with pytest.raises(Refused, match="another plan has joined since"):
            forbidden()
    new.send(plan(0))
    new.settle(10)


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
        joining.join(10)
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
    joining.join(10)
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


# States, tables, swaps.


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
    all_four["execute"].send(observation(1), state.pack(a_table()))
    all_four["execute"].settle(10)
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
        server.join(10)
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
        server.join(10)


def test_a_table_is_asked_for_again_while_execute_is_away(site):
    execute, planner = site.member("execute"), site.member("plan", patience=0.3)
    execute.close()
    with pytest.raises(
        BusError, match=r"did not answer plan \(later: Execute did not hand out its Q-table of pass 3\)"
    ):
        planner.table("loop=0;pass=3")


def test_a_swap_is_told_to_who_joins_next(site, all_four):
    swap = Swapped(loop=0, pass_no=4, part="plan", to={"name": "constant", "epsilon": 0.5}, handed_over=True)
    all_four["plan"].swapped(swap)
    all_four["plan"].swapped(swap.model_copy(update={"pass_no": 9, "planned": True}))
    # What the config has planned each role knows by itself.
    assert site.member("plan").joined.swaps == (swap.model_copy(update={"handed_over": False}),)
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


# Knowledge restarts.


def test_nothing_is_lost_and_nothing_comes_twice_over_restarts_of_knowledge(site, impatient):
    passes, got = 60, {}
    site.everybody()
    players = [
        threading.Thread(target=lambda peer=peer: got.update({peer.role: play_part(peer, 0, passes)}))
        for peer in site.members.values()
    ]
    for player in players:
        player.start()
    for reached in (10, 25, 40):
        eventually(lambda reached=reached: site.ledger.last(0)[3] >= reached, within=20)
        site.close()
        site.open()
        assert site.ledger.last(0)[3] >= reached
    for player in players:
        player.join(30)
    assert got == {role: of(role, run_of(passes)) for role in ROLES}
    site.close()
    log = new_ledger(site.path)
    assert [body.encode() for body in log.since(0, dict.fromkeys(range(4), 0), 9999)] == list(
        map(to_json, run_of(passes))
    )
    log.store.close()
    site.open()


def test_what_was_sent_while_knowledge_was_away_is_appended_when_it_is_back(wire, tmp_path):
    with Site(wire, tmp_path / "l", free=True) as site:
        site.everybody()
        site.send(plan(0))
        site.close()
        for number in range(1, 200):
            site.members["execute"].send(observation(number))
        site.open()
        site.members["execute"].settle(20)
        assert site.ledger.last(0) == (199, 0, 0, 0)


def test_one_that_sends_to_a_knowledge_that_lost_its_log_stops_with_a_sentence(site, all_four, tmp_path):
    site.send(*run_of(2))
    site.close()
    site.open(tmp_path / "another.sqlite")
    all_four["execute"].send(observation(3))
    with pytest.raises(Refused, match=r"no execute of epoch 1 has joined this Knowledge; was its log lost\?"):
        all_four["execute"].settle(20)


def test_one_that_only_waits_on_a_knowledge_that_lost_its_log_stops_too(site, all_four, tmp_path):
    all_four["monitor"].watch(0, 1)
    site.send(*run_of(2))
    assert len(received(all_four["monitor"], 2)) == 2
    site.close()
    site.open(tmp_path / "another.sqlite")
    with pytest.raises(Refused, match="the run has not begun"):
        received(all_four["monitor"], 1, within=20)


def test_one_whose_log_is_an_older_one_stops_with_a_sentence(site, all_four, tmp_path):
    old = tmp_path / "old.sqlite"
    site.send(*run_of(1))
    site.close()
    old.write_bytes(site.path.read_bytes())
    site.open()
    site.send(*run_of(3)[5:])
    site.close()
    site.open(old)
    all_four["execute"].send(observation(4))
    with pytest.raises(Refused, match="had Observation 3 of loop 0 from execute, and has them up to 1 only"):
        all_four["execute"].settle(20)


def test_a_record_that_is_lost_behind_dropped_episodes_is_sent_again(wire, impatient, monkeypatch):
    """A stage goes past what was dropped; the hole before its record is none that the record fills."""
    with Site(wire, free=True) as site:
        site.everybody()
        execute, monitor = site.members["execute"], site.members["monitor"]
        site.send(plan(0), observation(1), symptom(1))
        execute.drop(0, 2, 9)
        site.send(observation(10), observation(11))
        lost = lose(monkeypatch, site, lambda data: data == to_json(symptom(10)))
        monitor.send(symptom(10))
        monitor.send(symptom(11))
        monitor.settle(10)
        assert lost == [to_json(symptom(10))]
        assert site.ledger.last(0) == (11, 11, 0, 0)


def test_dropped_episodes_are_said_and_a_reader_goes_past_them(wire, impatient, monkeypatch):
    with Site(wire, free=True) as site:
        site.everybody()
        execute, monitor = site.members["execute"], site.members["monitor"]
        monitor.watch(0, 1)
        site.send(plan(0), observation(1))
        lost = lose(monkeypatch, site, lambda data: b"Dropped" in data)
        execute.drop(0, 2, 9)
        execute.send(observation(10))
        execute.send(observation(11))
        execute.settle(10)
        assert len(lost) == 1
        assert received(monitor, 3) == [observation(1), observation(10), observation(11)]
        assert status(site.session(), wire).dropped == 8


def test_one_whose_link_stands_and_is_dead_opens_another_session(site, all_four, monkeypatch):
    for module in (inbox, outbox):
        monkeypatch.setattr(module, "ANSWER_WITHIN", 0.1)
    monkeypatch.setattr(member, "DEAF_AFTER", 0.1)
    raw, planner, heard = site.session(), all_four["plan"], threading.Event()
    site.send(plan(0))
    planner.watch(0, 1)
    true_hear = site.hub._hear
    unheard = []  # kept, as one that is let go is answered by that
    monkeypatch.setattr(
        site.hub, "_hear", lambda *given: true_hear(*given) if heard.is_set() else unheard.append(given)
    )
    first = planner._session
    eventually(lambda: planner.receive(0.01) is not None or planner._session is not first, within=20)
    heard.set()
    site.send(*run_of(1)[1:])
    assert received(planner, 1) == of("plan", run_of(1))
    assert planner.joined.epoch == 1
    assert site.ledger.last(0) == (1, 1, 1, 1)
    eventually(lambda: status(raw, site.wire).roles["plan"].alive)
    planner.close()
    eventually(lambda: not status(raw, site.wire).roles["plan"].alive)


def test_one_that_waits_for_a_busy_knowledge_keeps_its_session(site, all_four, monkeypatch):
    for module in (inbox, outbox, questions):
        monkeypatch.setattr(module, "ANSWER_WITHIN", 0.1)
    held, true_take = threading.Event(), site.ledger.take
    monkeypatch.setattr(site.ledger, "take", lambda *given: (held.wait(10), true_take(*given))[1])
    planner, first, lost = all_four["plan"], all_four["plan"]._session, []
    true_lost = planner._lost
    monkeypatch.setattr(planner, "_lost", lambda: (lost.append(1), true_lost()))
    planner.send(plan(0))
    eventually(lambda: planner.receive(0.01) is not None or len(lost) >= 3)
    held.set()
    planner.settle(10)
    assert planner._session is first


def test_one_that_nobody_holds_any_more_leaves_at_once(wire):
    """Not at some later moment, on whatever thread then looks for garbage."""
    with Site(wire) as site:
        raw = site.session()
        held = [Member(wire, "execute", layout=TOLD, patience=10)]
        gc.disable()
        try:
            held[0].connect()
            held[0].send(observation(1))
            held[0].watch(0, 0)
            eventually(lambda: status(raw, wire).roles["execute"].alive)
            held.clear()
            eventually(lambda: not status(raw, wire).roles["execute"].alive)
        finally:
            gc.enable()


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
