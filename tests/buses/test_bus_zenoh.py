"""What holds of the wire alone: who comes late, what is lost, who lies, and how it ends."""

import json
import socket
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import bus_small_loop
import pytest
import zenoh
from bus_records import new_log, observation, plan, run_of, symptom

from adapters.buses import KnowledgeHub, Wire, ZenohBus, wire, zenoh_bus, zenoh_hub
from knowledge import STAGES, ChangePlan, Log, Observation, RowLayout, to_json
from mape.errors import BusError, ConfigError

pytestmark = pytest.mark.timeout(30)


@pytest.fixture
def hub(wire):
    with KnowledgeHub(new_log(), wire) as hub:
        yield hub


@pytest.fixture
def bus(hub):
    with ZenohBus(hub.wire, "a", patience=5) as bus:
        yield bus


@pytest.fixture
def raw(hub):
    """Open a session that speaks to the hub without a bus."""
    session = hub.wire.join(5)
    yield session
    session.close()


def ask(session, selector, payload=None):
    """Return (reply, error reply) of the one answer that comes."""
    (answer,) = session.get(selector, payload=payload, timeout=5)
    return (answer.ok.payload.to_bytes(), None) if answer.ok else (None, answer.err.payload.to_string())


def eventually(condition, within=5.0):
    deadline = time.monotonic() + within
    tick = threading.Event()
    while not condition():
        assert time.monotonic() < deadline, "did not come true in time"
        tick.wait(0.01)


def start(program, *arguments):
    return subprocess.Popen(
        [sys.executable, "-W", "error", *program, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def ended(process, within=20):
    """Return (exit code, stdout, stderr) of a process that is expected to end by itself."""
    try:
        out, err = process.communicate(timeout=within)
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = process.communicate()
        pytest.fail(f"the process did not end within {within} s; it said {out!r} and {err!r}")
    return process.returncode, out, err


# Joining late, losing, coming back.


def test_who_joins_late_gets_all_from_plan_0_on(hub, bus):
    for record in run_of(3):
        bus.send(record)
    got = []
    with ZenohBus(hub.wire, "late") as late:
        for kind in STAGES:
            late.subscribe(kind, got.append)
        late.run()
    assert got == run_of(3)


def test_who_joins_late_may_begin_with_a_later_pass(hub, bus):
    for record in run_of(3):
        bus.send(record)
    got = []
    with ZenohBus(hub.wire, "late", first_pass=2) as late:
        for kind in STAGES:
            late.subscribe(kind, got.append)
        late.run()
    assert got == run_of(3)[5:]


def test_catching_up_may_take_several_answers(hub, bus, monkeypatch):
    for record in run_of(5):
        bus.send(record)
    for module in (zenoh_hub, zenoh_bus):
        monkeypatch.setattr(module, "SINCE_LIMIT", 4)
    got = []
    with ZenohBus(hub.wire, "late") as late:
        for kind in STAGES:
            late.subscribe(kind, got.append)
        assert late.run() == 21
    assert got == run_of(5)


def test_what_has_left_the_window_cannot_be_had_and_is_said_so(wire):
    with KnowledgeHub(new_log(window=2), wire), ZenohBus(wire, "a") as bus:
        for record in run_of(5):
            bus.send(record)
        late = ZenohBus(wire, "late", first_pass=1)
        late.subscribe(ChangePlan, print)
        with late, pytest.raises(BusError, match=r"late cannot catch up: pass 1 has left the window.*memory is 4"):
            late.run()


@pytest.mark.parametrize("lost", [{2}, {0, 1}, {4, 5, 6}, {8}, set(range(9))])
def test_a_record_that_is_lost_on_the_way_is_fetched(hub, lost):
    published = []

    class Forgetful:
        def __init__(self, publisher):
            self.publisher = publisher

        def put(self, payload):
            if len(published) not in lost:
                self.publisher.put(payload)
            published.append(payload)

    hub._publishers = {kind: Forgetful(publisher) for kind, publisher in hub._publishers.items()}
    got = []
    with ZenohBus(hub.wire, "reader") as reader, ZenohBus(hub.wire, "writer") as writer:
        for kind in (Observation, ChangePlan):
            reader.subscribe(kind, got.append)
        reader.run()
        for record in run_of(2):
            writer.send(record)
        reader.run_until(lambda: len(got) == 5, timeout=5)
    assert got == [record for record in run_of(2) if isinstance(record, (Observation, ChangePlan))]


def test_what_comes_twice_over_the_wire_is_delivered_once(hub, bus):
    got = []
    bus.subscribe(ChangePlan, got.append)
    bus.send(plan(0))
    hub._publishers[ChangePlan].put(to_json(plan(0)))
    for record in run_of(1):
        bus.send(record)
    bus.run_until(lambda: plan(1) in got)
    assert got == [plan(0), plan(1)]


STRAYS = {
    "nothing": b"",
    "junk": b"\xff\xfe\x00garbage",
    "another version": to_json(plan(1)).replace(b"Plan/1", b"Plan/2"),
    "far ahead": to_json(plan(900)),
    "one pass ahead": to_json(plan(2, epsilon=0.25)),
    "exactly next": to_json(plan(1, epsilon=0.25)),
    "of another kind": to_json(observation(900)),
    "of another loop": to_json(plan(1)._replace(loop=3)),
    "before the log": to_json(plan(-4)),
    "endlessly far": to_json(plan(10**30)),
}


@pytest.mark.parametrize("stray", STRAYS.values(), ids=STRAYS)
def test_what_a_stranger_publishes_is_not_delivered_and_stops_nobody(hub, bus, raw, stray):
    got = []
    bus.subscribe(ChangePlan, got.append)
    bus.send(plan(0))
    bus.run()
    fetched = bus._next
    raw.put(hub.wire.stream(ChangePlan), stray)
    eventually(lambda: not bus._arrived.empty())
    with pytest.raises(BusError, match="did not come within"):
        bus.run_until(lambda: False, timeout=0.05)
    assert bus._arrived.empty()
    assert (got, bus._next) == ([plan(0)], fetched)
    with ZenohBus(hub.wire, "b") as other:
        for record in run_of(3):
            other.send(record)
    bus.run_until(lambda: len(got) == 4, timeout=5)
    assert got == [plan(number) for number in range(4)]
    assert bus.run() == 0


def test_what_is_published_as_junk_is_delivered_as_the_log_holds_it(hub, bus):
    class Garbled:
        def __init__(self, publisher):
            self.publisher = publisher

        def put(self, payload):
            self.publisher.put(payload[1:])

    hub._publishers = {kind: Garbled(publisher) for kind, publisher in hub._publishers.items()}
    got = []
    for kind in STAGES:
        bus.subscribe(kind, got.append)
    for record in run_of(3):
        bus.send(record)
        bus.run_until(lambda record=record: record in got, timeout=5)
    assert got == run_of(3)


def test_publications_do_not_pile_up_in_a_bus_that_never_waits(hub, bus):
    bus.subscribe(ChangePlan, print)
    bus.send(plan(0))
    for _ in range(3):
        eventually(lambda: not bus._arrived.empty())
        bus.run()
        assert bus._arrived.empty()
        hub._publishers[ChangePlan].put(to_json(plan(0)))


def test_only_what_was_appended_is_published(hub, bus, raw):
    published = []
    listening = raw.declare_subscriber(
        f"{hub.wire.prefix}/*", zenoh.handlers.Callback(published.append, indirect=False)
    )
    assert ask(raw, f"{hub.wire.since}?pass=0;stage=0") == (b"", None)  # the hub has seen the subscription
    for record in run_of(1):
        bus.send(record)
        bus.send(record)
    for wrong in (plan(0, epsilon=0.1), observation(9)):
        with pytest.raises(BusError):
            bus.send(wrong)
    bus.send(observation(2))
    eventually(lambda: published and published[-1].payload.to_bytes() == to_json(observation(2)))
    listening.undeclare()
    assert [sample.payload.to_bytes() for sample in published] == [to_json(r) for r in [*run_of(1), observation(2)]]
    keys = [str(sample.key_expr).removeprefix(f"{hub.wire.prefix}/") for sample in published]
    assert keys == ["plan", "execute", "monitor", "analyze", "plan", "execute"]


def test_waiting_stops_at_the_record_that_was_waited_for(bus):
    got = []
    bus.subscribe(ChangePlan, got.append)
    for record in run_of(2):
        bus.send(record)
    assert bus.run_until(lambda: plan(1) in got) == 2
    assert got == [plan(0), plan(1)]
    assert bus.run() == 1


def test_waiting_in_vain_ends_with_what_was_seen(bus):
    bus.subscribe(ChangePlan, print)
    with pytest.raises(BusError, match=r"did not come within 0\.05 s; it has seen nothing of the log"):
        bus.run_until(lambda: False, timeout=0.05)
    bus.send(plan(0))
    with pytest.raises(BusError, match="it has seen the log up to ChangePlan 0"):
        bus.run_until(lambda: False, timeout=0.05)


def test_one_that_waits_gets_what_another_thread_sends(hub, bus):
    got = []
    bus.subscribe(Observation, got.append)

    def send():
        with ZenohBus(hub.wire, "b") as other:
            for record in run_of(20):
                other.send(record)

    sender = threading.Thread(target=send)
    sender.start()
    bus.run_until(lambda: len(got) == 20, timeout=10)
    sender.join(5)
    assert got == [observation(number) for number in range(1, 21)]


def test_a_bus_outlives_a_restart_of_knowledge(wire, monkeypatch):
    got = []
    first = KnowledgeHub(new_log(), wire)
    second = KnowledgeHub(first.log, wire)
    first.connect()
    pause = time.sleep

    def restart_then_pause(seconds):
        second.connect()
        pause(seconds)

    with ZenohBus(wire, "a") as bus:
        bus.subscribe(ChangePlan, got.append)
        bus.send(plan(0))
        first.close()
        # Knowledge comes back once the bus has asked in vain.
        monkeypatch.setattr(zenoh_bus.time, "sleep", restart_then_pause)
        for record in run_of(2):
            bus.send(record)
        bus.run()
    second.close()
    assert got == [plan(0), plan(1), plan(2)]


def test_a_log_that_went_back_is_noticed(wire):
    first = KnowledgeHub(new_log(), wire)
    first.connect()
    with ZenohBus(wire, "a") as bus:
        bus.subscribe(ChangePlan, print)
        bus.send(plan(0))
        first.close()
        with (
            KnowledgeHub(new_log(), wire),
            pytest.raises(BusError, match="acknowledged ChangePlan 0 to a, and no longer has it"),
        ):
            bus.run()


def test_an_acknowledgement_that_is_lost_is_asked_for_again(hub, bus, monkeypatch):
    monkeypatch.setattr(zenoh_bus, "ANSWER_WITHIN", 0.2)
    replies = []
    true_append = hub.log.append

    def slow_once(record):
        ack = true_append(record)
        if not replies:
            eventually(lambda: not hub._asked.empty())  # the sender has lost patience, and asked again
        replies.append(ack.value)
        return ack

    monkeypatch.setattr(hub.log, "append", slow_once)
    got = []
    bus.subscribe(ChangePlan, got.append)
    bus.send(plan(0))
    bus.run()
    assert replies[:2] == ["ok", "duplicate"]
    assert got == [plan(0)]


def test_without_knowledge_a_send_gives_up_after_its_patience(wire):
    hub = KnowledgeHub(new_log(), wire)
    hub.connect()
    with ZenohBus(wire, "a", patience=0.2) as bus:
        hub.close()
        with pytest.raises(BusError, match=r"did not answer within 0\.2 s \(no reply\). Is it running"):
            bus.send(plan(0))


def test_without_anybody_at_the_endpoint_a_bus_does_not_connect(wire):
    with pytest.raises(BusError, match="no Knowledge answers on unixsock-stream"):
        ZenohBus(wire, "a", patience=0.1).connect()


def test_a_bus_may_be_started_before_knowledge(wire, monkeypatch):
    joining = threading.Event()
    join = Wire.join

    def join_visibly(wire, patience):
        joining.set()
        return join(wire, patience)

    def send():
        with ZenohBus(wire, "a") as bus:
            bus.send(plan(0))

    monkeypatch.setattr(Wire, "join", join_visibly)
    sender = threading.Thread(target=send)
    sender.start()
    assert joining.wait(5)
    with KnowledgeHub(new_log(), wire) as hub:
        sender.join(10)
    assert list(hub.log.since(0)) == [plan(0)]


# What is refused.

GOOD = to_json(plan(0))


@pytest.mark.parametrize(
    ("payload", "sentence"),
    [
        (None, "carries nothing"),
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
        (GOOD.replace(b'"loop":0', b'"loop":3'), "a record of loop 3 was sent to the log of loop 0"),
        (GOOD.replace(b'"pass":0', b'"pass":-4'), "passes are counted from 1"),
        (GOOD.replace(b"[0.1]", b"[0.1,0.2]"), "ChangePlan 0 does not fit the run's layout"),
        (GOOD.replace(b'"add":[]', b'"add":[64]'), "action id 64 is outside 0 .. 63"),
        (GOOD.replace(b'"adopt":null', b'"adopt":"zz"'), "ChangePlan 0 does not fit"),
        (b" " * ((1 << 20) + 1), "1048577 bytes; a record has at most 1048576"),
    ],
)
def test_malformed_bytes_are_refused_with_a_sentence_and_change_nothing(hub, bus, raw, payload, sentence):
    reply, error = ask(raw, hub.wire.append, payload)
    assert reply is None
    assert sentence in error
    got = []
    bus.subscribe(ChangePlan, got.append)
    assert bus.run() == 0
    bus.send(plan(0))
    bus.run()
    assert got == [plan(0)]
    hub.close()
    assert list(hub.log.since(0)) == [plan(0)]


@pytest.mark.parametrize("size", [1, 7, 60])
def test_a_record_cut_or_flipped_anywhere_never_stops_knowledge(hub, raw, size):
    for at in range(0, len(GOOD), 9):
        for broken in (GOOD[:at], GOOD[:at] + b"\x00" * size + GOOD[at + size :], GOOD + GOOD[:at] + b"}"):
            reply, error = ask(raw, hub.wire.append, broken)
            assert reply is None
            assert error
    assert ask(raw, hub.wire.append, GOOD) == (b'{"ack": "ok", "passes": 0}', None)


@pytest.mark.parametrize(
    ("record", "sentence"),
    [
        (observation(1)._replace(signals={"reward": 1.0}), "has signals reward; the run's are, in this order, return"),
        (observation(1)._replace(signals={}), "has signals none"),
        (observation(1)._replace(available=(0, 99)), "action id 99"),
        (observation(1)._replace(steps=1 << 70), "Observation 1 does not fit"),
    ],
)
def test_a_record_that_does_not_fit_the_run_is_refused_when_it_comes_and_not_with_the_plan(bus, record, sentence):
    bus.send(plan(0))
    with pytest.raises(BusError, match=f"Observation 1 is refused by Knowledge: .*{sentence}"):
        bus.send(record)
    for right in run_of(2):
        bus.send(right)


def test_a_symptom_with_another_number_of_readings_is_refused_when_it_comes(wire):
    log = Log(RowLayout(("return",), detectors=2, rates=1))
    with KnowledgeHub(log, wire), ZenohBus(wire, "a") as bus:
        bus.send(plan(0))
        bus.send(observation(1))
        with pytest.raises(BusError, match="Symptom 1 does not fit the run's layout"):
            bus.send(symptom(1))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_number_that_is_not_finite_does_not_leave_the_process(bus, value):
    with pytest.raises(BusError, match=r"ChangePlan 0 cannot be written for the wire: .*not finite"):
        bus.send(plan(0, epsilon=value))


@pytest.mark.parametrize("question", ["", "?pass=1", "?pass=-1;stage=0", "?pass=x;stage=0", "?pass=1;stage=4"])
def test_a_question_that_makes_no_sense_is_answered_so(hub, raw, question):
    reply, error = ask(raw, f"{hub.wire.since}{question}")
    assert reply is None
    assert "stage" in error


def test_the_four_acknowledgements_are_words_on_the_wire(hub, raw):
    def acknowledged(record):
        return json.loads(ask(raw, hub.wire.append, to_json(record))[0])

    assert acknowledged(plan(0)) == {"ack": "ok", "passes": 0}
    assert acknowledged(plan(0)) == {"ack": "duplicate", "passes": 0}
    assert acknowledged(plan(0, epsilon=0.0)) == {"ack": "conflict", "passes": 0}
    assert acknowledged(observation(2)) == {"ack": "gap", "passes": 0}


def test_what_knowledge_fails_with_is_told_to_the_sender_and_it_goes_on(hub, bus, monkeypatch):
    def full_disk(record):
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(hub.log, "append", full_disk)
        with pytest.raises(BusError, match="Knowledge failed with OSError: no space left on device"):
            bus.send(plan(0))
    bus.send(plan(0))


@pytest.mark.parametrize("asked", ["_append", "_since"])
@pytest.mark.parametrize("payload", [GOOD, b"junk"])
def test_knowledge_outlives_one_that_asks_and_is_gone_before_the_reply(hub, bus, asked, payload):
    tried = []

    class Gone:
        def __init__(self):
            self.parameters = {"pass": "0", "stage": "0"}
            self.payload = zenoh.ZBytes(payload)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def reply(self, *_):
            tried.append("reply")
            raise zenoh.ZError("the session is closed")

        def reply_err(self, *_):
            tried.append("error")
            raise zenoh.ZError("the session is closed")

    hub._asked.put((getattr(hub, asked), Gone()))
    bus.send(plan(0))
    assert tried[-1] == "error"
    assert hub._worker.is_alive()


# Names.


@pytest.mark.parametrize("name", ["", "Grid", "a/b", "a*", "@adv", "a b", "ü", "a\n", "$*", "a#b", "a?b"])
def test_a_name_that_is_special_on_the_wire_is_refused(wire, name):
    with pytest.raises(ConfigError, match="only a-z, 0-9, _ and -"):
        Wire(wire.endpoint, name)
    with pytest.raises(ConfigError, match="only a-z, 0-9, _ and -"):
        ZenohBus(wire, name)


@pytest.mark.parametrize(
    "endpoint",
    [
        "",
        "tcp/0.0.0.0:7447",
        "tcp/[::]:7447",
        "tcp/127.0.0.1:0",
        "tcp/127.0.0.1:70000",
        "udp/127.0.0.1:1",
        "unixsock-stream/",
    ],
)
def test_an_endpoint_that_others_could_reach_or_nobody_is_refused(endpoint):
    with pytest.raises(ConfigError, match="endpoint"):
        Wire(endpoint, "example")


def test_a_socket_path_that_the_kernel_would_not_take_is_refused():
    with pytest.raises(ConfigError, match="has 108 bytes"):
        Wire("unixsock-stream/" + "x" * 108, "example")


def test_a_hub_of_another_loop_is_refused(endpoint):
    with pytest.raises(ConfigError, match="the log is that of loop 0, the wire that of loop 1"):
        KnowledgeHub(new_log(), Wire(endpoint, "example", 1))


def test_places_count_the_records_of_a_log():
    records = run_of(3)
    assert [wire.place(record) for record in records] == list(range(len(records)))
    assert [wire.at_place(wire.place(r)) for r in records] == [(r.pass_no, STAGES.index(type(r))) for r in records]


def test_a_second_knowledge_on_one_endpoint_is_refused(hub):
    with pytest.raises(BusError, match="is another Knowledge running there"):
        KnowledgeHub(new_log(), hub.wire).connect()


def test_it_runs_over_tcp_as_well():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    wire = Wire(f"tcp/127.0.0.1:{port}", "example")
    got = []
    with KnowledgeHub(new_log(), wire), ZenohBus(wire, "a") as bus:
        bus.subscribe(ChangePlan, got.append)
        bus.send(plan(0))
        bus.run()
    assert got == [plan(0)]


# Coming and going.


def test_who_is_there_is_seen_and_who_left_is_not(hub, raw):
    def present():
        tokens = raw.liveliness().get(f"{hub.wire.prefix}/alive/**", timeout=5)
        return sorted(str(reply.ok.key_expr).split("/")[-2] for reply in tokens)

    assert present() == ["knowledge"]
    with ZenohBus(hub.wire, "monitor"):
        eventually(lambda: present() == ["knowledge", "monitor"])
    eventually(lambda: present() == ["knowledge"])


def test_a_bus_that_is_not_connected_or_closed_says_so(wire):
    bus = ZenohBus(wire, "a")
    with pytest.raises(BusError, match=r"not connected; call connect\(\)"):
        bus.send(plan(0))
    bus.close()
    with pytest.raises(BusError, match="was closed before what it waits for had come"):
        bus.run_until(lambda: False)
    with pytest.raises(BusError, match="the bus of a is closed"):
        bus.send(plan(0))
    with pytest.raises(BusError, match="closed; make another"):
        bus.connect()


def test_a_hub_may_be_closed_twice_and_opened_again(wire):
    hub = KnowledgeHub(new_log(), wire)
    hub.close()
    for number in range(2):
        hub.connect()
        hub.connect()
        with ZenohBus(wire, "a") as bus:
            bus.send(plan(0))
            bus.send(observation(1)) if number else None
        hub.close()
        hub.close()
    assert list(hub.log.since(0)) == [plan(0), observation(1)]


@pytest.mark.parametrize("how", ["raise RuntimeError('left in a hurry')", "raise SystemExit(1)"])
def test_a_process_that_closes_nothing_still_ends(endpoint, how):
    program = f"""
        from adapters.buses import KnowledgeHub, Wire, ZenohBus
        from knowledge import ChangePlan, Log, RowLayout
        wire = Wire({endpoint!r}, "example")
        hub = KnowledgeHub(Log(RowLayout(("return",), detectors=0, rates=1)), wire)
        hub.connect()
        bus = ZenohBus(wire, "a")
        bus.subscribe(ChangePlan, print)
        bus.connect()
        bus.send(ChangePlan(0, 0, 1.0, (0.1,), (), (), (), False, None))
        assert bus.run() == 1
        {how}
    """
    code, _, err = ended(start(["-c", textwrap.dedent(program)]))
    assert code == 1, err


def test_a_socket_left_behind_by_a_killed_knowledge_is_taken_over(endpoint):
    program = f"""
        import sys
        from adapters.buses import KnowledgeHub, Wire
        from knowledge import Log, RowLayout
        hub = KnowledgeHub(Log(RowLayout(("return",), detectors=0, rates=1)), Wire({endpoint!r}, "example"))
        hub.connect()
        print("up", flush=True)
        sys.stdin.read()
    """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with process:
        assert process.stdout.readline() == "up\n"
        process.kill()
    wire = Wire(endpoint, "example")
    with KnowledgeHub(new_log(), wire), ZenohBus(wire, "a") as bus:
        bus.send(plan(0))


def test_two_processes_log_the_same_rows_as_one(endpoint):
    program = [str(Path(bus_small_loop.__file__))]
    managed = start(program, "managed", endpoint)  # first, so that it has to wait for Knowledge
    managing = start(program, "managing", endpoint)
    expected = bus_small_loop.in_process().sha256() + "\n"
    try:
        assert ended(managing) == (0, expected, "")
        assert ended(managed) == (0, expected, "")
    finally:
        for process in (managed, managing):
            process.kill()
