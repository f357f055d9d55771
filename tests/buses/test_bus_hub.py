"""What Knowledge answers to whoever asks it, well-behaved or not; each question by a session that is no member."""

import itertools
import json
import threading
from pathlib import Path

import pytest
import zenoh
from bus_peers import Site, ask, eventually, join_of, status
from bus_records import TOLD, new_ledger, observation, plan, run_of, symptom

from adapters.buses import KnowledgeHub, Wire, answers, hub
from adapters.buses.messages import Beat, Dropped, Happened, Joined, State, Swapped, Table
from adapters.buses.wire import ORDERED, WIRE_VERSION
from adapters.roles import STAGE_OF
from knowledge import QTable, to_json
from mape.errors import BusError

GOOD = to_json(plan(0))


@pytest.fixture
def site(wire, tmp_path):
    with Site(wire, tmp_path / "log.sqlite", begun=True) as site:
        yield site


@pytest.fixture
def joined(site, raw):
    """Let every role join once, so that each has the epoch 1."""
    for role in STAGE_OF:
        reply, error = ask(raw, site.wire.ask(f"join/{role}"), join_of(role))
        assert error is None, error
        assert Joined.unpack(reply)[0].epoch == 1


def append(raw, wire, role, payload, attachment=b"1", loop=0):
    reply, error = ask(raw, wire.append(role, loop), payload, attachment)
    return (None if reply is None else json.loads(reply)), error


# Records.


def test_the_acknowledgements_are_words_on_the_wire(site, raw, joined):
    def said(role, record):
        reply, _ = append(raw, site.wire, role, to_json(record))
        return reply["ack"], reply["last"]

    assert said("execute", observation(1)) == ("gap", 0)
    assert said("plan", plan(0)) == ("ok", 0)
    assert said("plan", plan(0)) == ("duplicate", 0)
    assert said("execute", observation(2)) == ("gap", 0)
    assert said("execute", observation(1)) == ("ok", 1)


def test_a_conflict_is_refused_and_names_what_differs(site, raw, joined):
    append(raw, site.wire, "plan", GOOD)
    _, error = append(raw, site.wire, "plan", to_json(plan(0, epsilon=0.25)))
    assert error == "ChangePlan 0 of loop 0 differs from the one in the log: epsilon is 0.5 there, and 0.25 here"
    assert status(raw, site.wire).roles["plan"].refused == 1


@pytest.mark.parametrize(
    ("payload", "sentence"),
    [
        (None, "the question carries nothing"),
        (b"", "not a JSON record"),
        (b"\xff\xfe\x00garbage", "not a JSON record"),
        (b"[]", "a record is a JSON object, not list"),
        (b"{}", "schema None is not one of"),
        (GOOD[:-1], "not a JSON record"),
        (GOOD.replace(b"0.5", b"NaN"), "NaN is not JSON"),
        (GOOD.replace(b"0.5", b"1e999"), "ChangePlan/1: epsilon"),
        (GOOD.replace(b"0.5", b'"0.5"'), "ChangePlan/1: epsilon"),
        (GOOD.replace(b'"pass":0', b'"pass":0.0'), "ChangePlan/1: pass_no"),
        (GOOD.replace(b"Plan/1", b"Plan/2"), "schema 'ChangePlan/2' is not one of"),
        (GOOD.replace(b'"add"', b'"plus"'), "ChangePlan/1"),
        (GOOD.replace(b'"loop":0', b'"loop":3'), "ChangePlan of loop 3 came under the key of loop 0"),
        (GOOD.replace(b'"pass":0', b'"pass":-4'), "passes are counted from 1"),
        (GOOD.replace(b"[0.1]", b"[0.1,0.2]"), "ChangePlan 0 does not fit the run's layout"),
        (to_json(symptom(1)), "a Symptom came where only a ChangePlan is taken"),
        (Dropped(loop=0, first=1, last=2).pack(), "only Execute says which episodes were dropped"),
        (Dropped(loop=0, first=1, last=2).pack()[:-4], "not a Dropped/1 message"),
        (b'{"schema":"Dropped/9"}', "not a message of schema Dropped/1"),
        (b" " * ((1 << 20) + 1), "a message of 1048577 bytes; at most 1048576 are taken here"),
    ],
)
def test_what_is_malformed_is_refused_with_a_sentence_counted_and_changes_nothing(site, raw, joined, payload, sentence):
    reply, error = append(raw, site.wire, "plan", payload)
    assert reply is None
    assert sentence in error
    now = status(raw, site.wire)
    assert (now.refused, now.roles["plan"].refused, now.last) == (1, 1, ("", "", "", ""))
    assert append(raw, site.wire, "plan", GOOD) == ({"schema": "Acknowledged/1", "ack": "ok", "last": 0}, None)
    site.hub.close()
    assert [event.kind for event in site.ledger.store.events()].count("refused") == 1


@pytest.mark.parametrize(
    ("key", "attachment", "sentence"),
    [
        ("mape/example/0/append/plan", None, "the epoch is ''; a whole number is taken"),
        ("mape/example/0/append/plan", b"0", "another plan has joined since (epoch 1; this one has 0)"),
        ("mape/example/0/append/plan", b"2", "no plan of epoch 2 has joined this Knowledge; was its log lost?"),
        ("mape/example/0/append/plan", b"-1", "the epoch is '-1'"),
        ("mape/example/0/append/plan", "²".encode(), "the epoch is "),
        ("mape/example/0/append/plan", b"9" * 5000, "the epoch is "),
        ("mape/example/1/append/plan", b"1", "ChangePlan of loop 0 came under the key of loop 1"),
        ("mape/example/x/append/plan", b"1", "the loop is 'x'; a whole number is taken"),
        ("mape/example/0/append/*", b"1", "role '*' sends no records; the roles are execute, monitor"),
        ("mape/example/0/append/operator", b"1", "role 'operator' sends no records"),
    ],
)
def test_a_record_out_of_place_is_refused(site, raw, joined, key, attachment, sentence):
    reply, error = ask(raw, key, GOOD, attachment)
    assert reply is None
    assert sentence in error
    assert status(raw, site.wire).last == ("", "", "", "")


def test_before_execute_has_told_the_layout_records_are_refused(wire):
    with Site(wire) as site:
        raw = site.session()
        reply, _ = ask(raw, wire.ask("join/plan"), join_of("plan"))
        assert (Joined.unpack(reply)[0].layout, Joined.unpack(reply)[0].epoch) == (None, 0)
        assert "no plan of epoch 0 has joined" in append(raw, wire, "plan", GOOD, b"0")[1]
        _, error = ask(raw, wire.ask("since") + "?loop=0;from=0:1")
        assert "the run has not begun: no Execute has told yet" in error


@pytest.mark.parametrize(
    "behind",
    [b"junk", b"", State(loop=0, pass_no=1, state={}).pack()[:-3], State(loop=0, pass_no=1, state={}).pack() + b"\n?"],
)
def test_a_record_whose_state_is_malformed_is_not_taken_either(site, raw, joined, behind):
    append(raw, site.wire, "plan", GOOD)
    before = site.ledger.last(0)
    reply, error = append(raw, site.wire, "execute", to_json(observation(1)), b"1\n" + behind)
    if behind:
        assert (reply, site.ledger.last(0)) == (None, before), error
        reply, error = append(raw, site.wire, "execute", to_json(observation(1)))
    assert (reply["ack"], error) == ("ok", None)


def test_a_state_that_comes_with_its_record_is_kept_with_it(site, raw, joined):
    append(raw, site.wire, "plan", GOOD)
    state = State(loop=0, pass_no=1, state={"rng": [1, 2]}).pack(QTable((0, 1), 2))
    append(raw, site.wire, "execute", to_json(observation(1)), b"1\n" + state)
    assert ask(raw, site.wire.ask("snapshot/execute") + "?loop=0") == (state, None)


# Who joins.


@pytest.mark.parametrize(
    ("role", "join", "sentence"),
    [
        ("plan", join_of("monitor"), "role 'monitor' joined as 'plan'"),
        ("operator", join_of("operator"), "role 'operator' joined as 'operator'; the roles are execute, monitor"),
        ("plan", b"{}", "not a message of schema Join/1"),
        ("plan", None, "the question carries nothing"),
        ("plan", b" " * ((1 << 20) + 1), "a message of 1048577 bytes"),
        ("plan", join_of("plan", versions={"wire": "0"}), f"plan is of wire 0, Knowledge of wire {WIRE_VERSION}"),
        ("plan", join_of("plan"), f"plan is of wire None, Knowledge of wire {WIRE_VERSION}"),
        (
            "plan",
            join_of("plan", versions={"wire": str(WIRE_VERSION)}, config={"seed": 1, "plan": {"alpha": 0.2}}),
            "plan has another config than Knowledge: plan.alpha is 0.2 in plan, and 0.1 in Knowledge",
        ),
        (
            "plan",
            join_of("plan", versions={"wire": str(WIRE_VERSION)}, config={"seed": 1}),
            "plan is nothing in plan, and {'alpha': 0.1} in Knowledge",
        ),
    ],
)
def test_who_differs_is_refused_with_what_differs(wire, role, join, sentence):
    config = {"seed": 1, "plan": {"alpha": 0.1}}
    with KnowledgeHub(new_ledger(), wire, config, {"wire": str(WIRE_VERSION)}), wire.join("operator", 5) as raw:
        reply, error = ask(raw, wire.ask(f"join/{role}"), join)
        assert reply is None
        assert sentence in error
        assert {known.epoch for known in status(raw, wire).roles.values()} == {0}


def test_other_versions_of_what_is_no_part_of_the_wire_are_noted_and_taken(wire):
    ledger = new_ledger()
    with KnowledgeHub(ledger, wire, None, {"numpy": "2.0"}) as knowledge, wire.join("operator", 5) as raw:
        reply, error = ask(raw, wire.ask("join/plan"), join_of("plan", versions={"numpy": "1.0"}))
        assert error is None
        assert Joined.unpack(reply)[0].layout == TOLD
        knowledge.close()
    assert "numpy 1.0 there, 2.0 here" in next(e.text for e in ledger.store.events() if e.kind == "versions")


def test_an_execute_with_another_layout_is_refused(site, raw):
    other = TOLD.model_copy(update={"signals": ("reward",)})
    _, error = ask(raw, site.wire.ask("join/execute"), join_of("execute", layout=other))
    assert "its managed system is another one" in error
    assert status(raw, site.wire).roles["execute"].epoch == 0


@pytest.mark.parametrize("field", ["detectors", "rates", "max_actions"])
@pytest.mark.parametrize("size", [2**62, 10**9, 4097, -1])
def test_a_layout_that_no_row_could_have_is_refused_and_a_right_one_is_taken_then(wire, field, size):
    with Site(wire) as site:
        raw = site.session()
        fields = json.loads(join_of("execute"))
        fields["layout"][field] = size
        _, error = ask(raw, wire.ask("join/execute"), json.dumps(fields).encode())
        assert f"Join/1: layout.{field}" in error
        _, error = ask(raw, wire.ask("join/execute"), join_of("execute"))
        assert error is None


# What is asked.


@pytest.mark.parametrize(
    ("question", "sentence"),
    [
        ("since", "loop is None; a whole number is taken"),
        ("since?loop=0", "a pass of `from` is ''"),
        ("since?loop=x;from=0:1", "loop is 'x'"),
        ("since?loop=7;from=0:1", "loop 7; this run has loops 0 to 0"),
        ("since?loop=0;from=4:1", "stage is 4; the stages of a pass are numbered from 0 to 3"),
        ("since?loop=0;from=0:-1", "a pass of `from` is '-1'"),
        ("since?loop=0;from=0:99999999999999999999", "a pass of `from` is '9999"),
        ("since?loop=²;from=0:1", "loop is '²'"),
        ("table", "loop is None"),
        ("table?sha256=abc", "no Q-table abc... is remembered"),
        ("table?loop=0", "pass is None"),
        ("table?loop=7;pass=1", "loop 7; this run has loops 0 to 0"),
        ("table?loop=0;pass=x", "pass is 'x'"),
        ("snapshot/plan", "loop is None"),
        ("snapshot/operator?loop=0", "role 'operator' has no state"),
        ("snapshot?loop=0", "role '' has no state"),
        ("remember/plan", "the question carries nothing"),
        ("remember/execute", "nothing is asked under mape/example/knowledge/remember/execute"),
        ("swapped/plan", "the question carries nothing"),
        ("event/plan", "the question carries nothing"),
        ("event/operator", "nothing is asked under"),
        ("anything", "nothing is asked under mape/example/knowledge/anything"),
        ("*", "nothing is asked under mape/example/knowledge/*"),
    ],
)
def test_a_question_that_makes_no_sense_is_answered_so(site, raw, joined, question, sentence):
    reply, error = ask(raw, site.wire.ask(question))
    assert reply is None
    assert sentence in error
    assert status(raw, site.wire).refused == 1


@pytest.mark.parametrize("key", ["mape/**", "mape/example/**", "mape/example/*/append/plan", "mape/*/*/*/*"])
def test_a_key_that_means_everything_is_refused_by_all_that_hear_it(site, raw, joined, key):
    answers = list(raw.get(key, payload=GOOD, attachment=b"1", timeout=60, consolidation=zenoh.ConsolidationMode.NONE))
    said = [answer.err.payload.to_string() for answer in answers]
    assert len(said) == status(raw, site.wire).refused == 2
    for sentence in said:
        assert sentence.startswith(("no records are taken under", "nothing is asked under", "the loop is '*'"))


@pytest.mark.parametrize(
    ("question", "payload", "attachment", "sentence"),
    [
        ("remember/plan", Table(loop=None, pass_no=None).pack(), None, "a Q-table to remember stands behind its mess"),
        ("remember/plan", b"{}", None, "not a message of schema Table/1"),
        ("snapshot/plan", State(loop=0, pass_no=0, state={}).pack(), b"7", "no plan of epoch 7 has joined"),
        ("snapshot/plan", State(loop=5, pass_no=0, state={}).pack(), b"1", "loop 5; this run has loops 0 to 0"),
        ("snapshot/plan", b"{}", b"1", "not a message of schema State/1"),
        ("swapped/plan", Swapped(loop=0, pass_no=1, part="p", to={}).pack(), b"", "the epoch is ''"),
        ("swapped/plan", Swapped(loop=5, pass_no=1, part="p", to={}).pack(), b"1", "loop 5; this run has loops 0 to 0"),
        ("event/execute", Happened(kind="begun", text="", loop=0).pack(), b"1", "names its loop and episode"),
        ("event/execute", Happened(kind="begun", text="", pass_no=1).pack(), b"1", "names its loop and episode"),
        (
            "event/execute",
            Happened(kind="begun", text="", loop=5, pass_no=1).pack(),
            b"1",
            "loop 5; this run has loops",
        ),
        ("event/plan", Happened(kind="begun", text="", loop=0, pass_no=1).pack(), b"1", "only Execute begins episodes"),
        (
            "event/plan",
            Happened(kind="aborted", text="", loop=0, pass_no=1).pack(),
            b"1",
            "only Execute begins episodes",
        ),
    ],
)
def test_what_is_brought_out_of_place_is_refused_and_changes_nothing(
    site, raw, joined, question, payload, attachment, sentence
):
    facts = site.ledger.store.facts()
    reply, error = ask(raw, site.wire.ask(question), payload, attachment)
    assert reply is None
    assert sentence in error
    site.hub.close()
    store = site.ledger.store
    assert (store.facts(), store.swaps(), store.snapshot(0, "plan")) == (facts, [], None)


def test_the_last_episode_that_was_begun_is_told_to_who_joins(site, raw, joined):
    for number in (1, 2):
        said = Happened(kind="begun", text="", loop=0, pass_no=number).pack()
        assert ask(raw, site.wire.ask("event/execute"), said, b"1") == (b"ok", None)
    reply, _ = ask(raw, site.wire.ask("join/execute"), join_of("execute"))
    assert Joined.unpack(reply)[0].begun == (2,)


def test_the_records_since_a_pass_come_up_to_a_limit(site, raw, joined, monkeypatch):
    monkeypatch.setattr(answers, "SINCE_LIMIT", 3)
    for record in run_of(2):
        role = ("execute", "monitor", "analyze", "plan")[[type(r) for r in run_of(1)[1:]].index(type(record))]
        append(raw, site.wire, role, to_json(record))
    reply, _ = ask(raw, site.wire.ask("since") + "?loop=0;from=0:1,3:0")
    assert reply.splitlines() == [b"0 1", to_json(plan(0)), to_json(observation(1)), to_json(plan(1))]
    reply, _ = ask(raw, site.wire.ask("since") + "?loop=0;from=2:3")
    assert reply == b"0 0"


def test_whatever_system_is_there_answers_an_operator_under_its_own_name(site):
    operator = Wire(site.wire.endpoint, "*")
    with operator.join("operator", 5) as session:
        (answer,) = session.get(operator.ask("status"), timeout=60)
        assert str(answer.ok.key_expr) == "mape/example/knowledge/status"
        assert status(session, operator).system == "example"


def test_only_what_was_appended_is_published_and_it_bears_the_seal(site, raw, joined):
    published = []
    listening = raw.declare_subscriber("mape/example/*/*", zenoh.handlers.Callback(published.append, indirect=False))
    status(raw, site.wire)  # the hub has seen the subscription
    roles = ["plan", "execute", "monitor", "analyze", "plan"]
    for role, record in zip(roles, run_of(1), strict=True):
        append(raw, site.wire, role, to_json(record))
        append(raw, site.wire, role, to_json(record))
    append(raw, site.wire, "plan", to_json(plan(0, epsilon=0.1)))
    append(raw, site.wire, "execute", to_json(observation(9)))
    append(raw, site.wire, "execute", to_json(observation(2)))
    eventually(lambda: published and published[-1].payload.to_bytes() == to_json(observation(2)))
    listening.undeclare()
    expected = [*zip(roles, run_of(1), strict=True), ("execute", observation(2))]
    assert [(str(s.key_expr), s.payload.to_bytes()) for s in published] == [
        (f"mape/example/0/{role}", to_json(record)) for role, record in expected
    ]
    reply, _ = ask(raw, site.wire.ask("join/plan"), join_of("plan"))
    assert {s.attachment.to_string() for s in published} == {Joined.unpack(reply)[0].seal}


# Who is there.


def beat(**other):
    return Beat(**{"epoch": 1, "pid": 77, "passes": 5, "refused": 2, "waiting": False, **other})


def test_a_heartbeat_is_told_in_the_status(site, raw, joined):
    raw.put(site.wire.beat("plan"), beat().pack(), **ORDERED)
    eventually(lambda: status(raw, site.wire).roles["plan"].pid == 77)
    assert status(raw, site.wire).roles["plan"].refused == 2


def test_a_heartbeat_of_another_epoch_is_not_heeded(site, raw, joined):
    raw.put(site.wire.beat("plan"), beat(epoch=9).pack(), **ORDERED)
    raw.put(site.wire.beat("monitor"), beat().pack(), **ORDERED)
    eventually(lambda: status(raw, site.wire).roles["monitor"].pid == 77)
    assert status(raw, site.wire).roles["plan"].pid == 1


def test_the_status_can_be_told_whatever_a_heartbeat_says(site, raw, joined):
    append(raw, site.wire, "plan", b"junk")
    raw.put(site.wire.beat("plan"), beat(refused=2**63 - 1).pack(), **ORDERED)
    eventually(lambda: status(raw, site.wire).roles["plan"].refused > 2**62)


JUNK = {
    "nothing": b"",
    "junk": b"\xff\xfe",
    "oversized": b" " * ((1 << 20) + 1),
    "another message": Dropped(loop=0, first=1, last=2).pack(),
    "no unicode": rb'{"schema":"Beat/1","q_table":{"\ud800":1}}' + b"\n",
    "deep": b'{"schema":"Beat/1","epoch":' + b"[" * 5000,
}


@pytest.mark.parametrize("payload", JUNK.values(), ids=JUNK)
def test_a_malformed_heartbeat_is_counted_and_knowledge_goes_on(site, raw, joined, payload):
    raw.put(site.wire.beat("plan"), payload, **ORDERED)
    eventually(lambda: status(raw, site.wire).roles["plan"].refused == 1)
    raw.put(site.wire.beat("nobody"), payload, **ORDERED)
    eventually(lambda: status(raw, site.wire).refused == 2)
    assert append(raw, site.wire, "plan", GOOD)[1] is None


@pytest.mark.parametrize("epoch", ["²", "x", "-1", "9" * 5000, "٣"])
def test_a_strange_liveliness_token_does_not_stop_knowledge(site, raw, joined, epoch):
    with raw.liveliness().declare_token(site.wire.alive("plan", epoch)):
        assert append(raw, site.wire, "plan", GOOD)[1] is None
        assert not status(raw, site.wire).roles["plan"].alive


@pytest.mark.parametrize(
    ("question", "name"),
    [
        *itertools.product(["join/plan", "swapped/plan", "event/plan"], JUNK),
        # These may bring a large Q-table.
        *itertools.product(["remember/plan", "snapshot/plan"], [name for name in JUNK if name != "oversized"]),
    ],
)
def test_a_malformed_message_is_refused_in_words_that_can_be_told(site, raw, joined, question, name):
    reply, error = ask(raw, site.wire.ask(question), JUNK[name], b"1")
    assert reply is None
    assert error
    assert status(raw, site.wire).refused == 1


def test_knowledge_outlives_one_that_asks_and_is_gone_before_the_reply(site, raw, joined, monkeypatch):
    """The question waits until who asked has left."""
    held, go = threading.Event(), threading.Event()
    true_status = site.hub.presence.status

    def slow_status():
        held.set()
        assert go.wait(60)
        return true_status()

    monkeypatch.setattr(site.hub.presence, "status", slow_status)
    with site.wire.join("operator", 5) as gone:
        gone.get(site.wire.ask("status"), lambda reply: None)
        assert held.wait(60)
    go.set()
    assert append(raw, site.wire, "plan", GOOD)[1] is None


def test_what_knowledge_fails_with_is_told_to_who_asked_and_it_goes_on(site, raw, joined, monkeypatch):
    def broken(*_):
        raise RuntimeError("out of order")

    with monkeypatch.context() as patch:
        patch.setattr(site.ledger, "take", broken)
        assert append(raw, site.wire, "plan", GOOD)[1] == "Knowledge failed with RuntimeError: out of order"
    assert append(raw, site.wire, "plan", GOOD)[1] is None


def test_what_gathers_while_knowledge_is_at_work_is_answered_with_one_commit(site, raw, joined, monkeypatch):
    commits, held, go = [], threading.Event(), threading.Event()
    true_commit, true_take = site.ledger.commit, site.ledger.take

    def slow_take(*given):
        held.set()
        assert go.wait(60)
        return true_take(*given)

    monkeypatch.setattr(site.ledger, "take", slow_take)
    monkeypatch.setattr(site.ledger, "commit", lambda: (commits.append(1), true_commit()))
    answers = [raw.get(site.wire.append("plan", 0), payload=to_json(plan(n)), attachment=b"1") for n in range(20)]
    assert held.wait(60)
    eventually(lambda: site.hub._asked.qsize() == 19)
    commits.clear()
    go.set()
    assert [len(list(answer)) for answer in answers] == [1] * 20
    assert len(commits) == 1


def test_nothing_is_said_that_is_not_on_disk(site, raw, joined, monkeypatch):
    def full():
        raise hub.ResultsError("log.sqlite cannot be written: database or disk is full")

    published = []
    with raw.declare_subscriber("mape/example/*/*", zenoh.handlers.Callback(published.append, indirect=False)):
        status(raw, site.wire)
        monkeypatch.setattr(site.ledger, "commit", full)
        asked = raw.get(site.wire.append("plan", 0), payload=GOOD, attachment=b"1", timeout=60, **ORDERED)
        assert list(asked) == []  # as of one that was killed: its asker waits for the next Knowledge
        assert site.hub.ended.wait(60)
        assert "disk is full" in str(site.hub.failure)
    assert published == []
    site.hub.close()


# Coming and going.


def test_a_second_knowledge_on_one_endpoint_is_refused(site):
    with pytest.raises(BusError, match="is another Knowledge running there"):
        KnowledgeHub(new_ledger(), site.wire).connect()


def test_a_folder_that_is_not_there_is_said_so(tmp_path):
    wire = Wire(f"unixsock-stream/{tmp_path}/nowhere/k.sock", "example")
    with pytest.raises(BusError, match=r"cannot listen on unixsock-stream"):
        KnowledgeHub(new_ledger(), wire).connect()


def test_a_hub_may_be_closed_twice_and_opened_again(wire):
    knowledge = KnowledgeHub(new_ledger(free=True), wire)
    knowledge.close()
    got = []
    for number in range(3):
        knowledge.connect()
        knowledge.connect()
        with wire.join("operator", 5) as raw:
            attachments = {}
            for role in ("plan", "execute"):
                reply, _ = ask(raw, wire.ask(f"join/{role}"), join_of(role))
                attachments[role] = str(Joined.unpack(reply)[0].epoch).encode()
            append(raw, wire, "plan", GOOD, attachments["plan"])
            hear = zenoh.handlers.Callback(lambda sample: got.append(sample.payload.to_bytes()), indirect=False)
            with raw.declare_subscriber(wire.stream("execute", 0), hear):
                status(raw, wire)
                record = to_json(observation(number + 1))
                assert append(raw, wire, "execute", record, attachments["execute"])[0]["ack"] == "ok"
                eventually(lambda record=record: got[-1:] == [record])
        knowledge.close()
        knowledge.close()
    assert knowledge.ledger.last(0) == (3, 0, 0, 0)


def test_the_seal_outlives_a_restart_and_is_another_one_for_another_run(wire, tmp_path):
    def seal(path):
        with Site(wire, path, begun=True) as site:
            reply, _ = ask(site.session(), wire.ask("join/plan"), join_of("plan"))
            return Joined.unpack(reply)[0].seal

    assert seal(tmp_path / "a") == seal(tmp_path / "a") != seal(tmp_path / "b")


def test_the_socket_is_gone_when_knowledge_is(site, endpoint):
    path = Path(endpoint.removeprefix("unixsock-stream/"))
    assert path.exists()
    site.hub.close()
    with KnowledgeHub(new_ledger(), site.wire):
        assert path.exists()
