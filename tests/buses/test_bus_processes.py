"""Real processes: how they end, what a dead one leaves behind, and one that was frozen."""

import signal
import socket
from contextlib import ExitStack

import pytest
from bus_peers import Site, ended, eventually, start, status
from bus_records import observation, plan

BEGIN = """
    from bus_peers import Site, received
    from bus_records import TOLD, new_ledger, observation, plan
    from adapters.buses import KnowledgeHub, Member, Wire

    wire = Wire(sys.argv[1], "example")
"""

ALONE = """
    hub = KnowledgeHub(new_ledger(), wire)
    hub.connect()
    execute, planner = Member(wire, "execute", layout=TOLD), Member(wire, "plan")
    execute.connect()
    planner.connect()
    execute.watch(0, 0)
    planner.send(plan(0))
    planner.settle(60)
    assert received(execute, 1) == [plan(0)]
"""


@pytest.mark.parametrize(
    ("how", "code"),
    [("raise RuntimeError('left in a hurry')", 1), ("raise SystemExit(3)", 3), ("pass", 0)],
)
def test_a_process_that_closes_nothing_still_ends(endpoint, how, code):
    got, _, err = ended(start(f"{BEGIN}{ALONE}\n    {how}", endpoint))
    assert got == code, err


def test_a_closed_knowledge_may_be_forgotten_while_zenoh_calls_python(endpoint):
    program = f"""{BEGIN}
    from queue import SimpleQueue
    from threading import Event
    import zenoh
    from adapters.buses.wire import hand_over

    called, never, answers = Event(), Event(), []

    def hear(answer):
        called.set()
        never.wait(0.3)  # without the GIL, which it then needs to return
        answers.append(answer.err.payload.to_string())

    first = wire.listen()
    first.close()
    with wire.listen() as second:
        second.declare_queryable("mape/question", hand_over(SimpleQueue(), "held, and not answered"))
        second.get("mape/question", zenoh.handlers.Callback(hear, indirect=False), timeout=0.05)
        assert called.wait(60)
        del first
    assert answers == ["Timeout"]
    """
    assert ended(start(program, endpoint), within=60) == (0, "", "")


def test_one_that_is_interrupted_while_it_waits_ends(endpoint, wire):
    program = f"""{BEGIN}
    with Member(wire, "plan", waiting=lambda sentence: print(sentence, flush=True)) as peer:
        pass
    """
    process = start(program, endpoint)
    assert process.stdout.readline() == f"waiting for Knowledge on {endpoint}\n"
    process.send_signal(signal.SIGINT)
    code, _, err = ended(process)
    assert (code, "KeyboardInterrupt" in err) == (-signal.SIGINT, True), err


def test_a_socket_left_behind_by_a_killed_knowledge_is_taken_over(endpoint, wire, tmp_path):
    program = f"""{BEGIN}
    from pathlib import Path
    site = Site(wire, Path(sys.argv[2]), begun=True)
    print("up", flush=True)
    sys.stdin.read()
    """
    with start(program, endpoint, str(tmp_path / "l")) as process:
        assert process.stdout.readline() == "up\n"
        process.kill()
    with Site(wire, tmp_path / "l") as site:  # nor is the log locked any more
        site.everybody()
        site.send(plan(0))


READER = f"""{BEGIN}
    from adapters.buses import inbox, member, questions
    for module in (inbox, questions):
        module.ANSWER_WITHIN = 0.5
    member.DEAF_AFTER = 0.5
    with Member(wire, "monitor") as reader:
        reader.watch(0, 1)
        print("up", flush=True)
        last = 0
        while last < int(sys.argv[2]):
            came = reader.receive(0.1)
            if came is not None:
                last += 1
                assert came == observation(last), came
                print(last, flush=True)
"""


def test_one_that_was_frozen_for_longer_than_the_lease_goes_on_where_it_was(endpoint, wire):
    with Site(wire, free=True) as site, ExitStack() as stack:
        raw = site.session()
        execute, planner = site.member("execute"), site.member("plan")
        process = stack.enter_context(start(READER, endpoint, "3000"))
        stack.callback(process.kill)
        assert process.stdout.readline() == "up\n"
        planner.send(plan(0))
        planner.settle(60)
        for number in range(1, 11):
            execute.send(observation(number))
        assert [process.stdout.readline() for _ in range(10)] == [f"{number}\n" for number in range(1, 11)]
        process.send_signal(signal.SIGSTOP)
        # Meanwhile the others go on, and Knowledge sees who is gone.
        for number in range(11, 2001):
            execute.send(observation(number))
        execute.settle(60)
        eventually(lambda: not status(raw, wire).roles["monitor"].alive)
        process.send_signal(signal.SIGCONT)
        for number in range(2001, 3001):
            execute.send(observation(number))
        execute.settle(60)
        code, out, err = ended(process)
        assert code == 0, err
        # A publication that was under way may come torn; it is ignored, and fetched.
        said = ("monitor hears nothing from Knowledge, and opens another session", "monitor ignores mape/example/0/")
        assert [line for line in err.splitlines() if not line.startswith(said)] == []
        assert out.splitlines() == [str(number) for number in range(11, 3001)]


WRITER = f"""{BEGIN}
    with Member(wire, "execute", layout=TOLD) as writer:
        first = writer.joined.last[0][0] + 1
        print(first, flush=True)
        for number in range(first, int(sys.argv[2]) + 1):
            writer.send(observation(number))
            writer.settle(60)
            print(number, flush=True)
"""


def test_what_was_acknowledged_to_a_role_that_is_killed_is_in_the_log(endpoint, wire):
    with Site(wire, free=True, begun=True) as site:
        site.member("plan").send(plan(0))
        site.members["plan"].settle(60)
        for kill in range(3):
            with start(WRITER, endpoint, "100000") as process:
                lines = [int(process.stdout.readline()) for _ in range(30 * (kill + 1))]
                process.kill()
                lines += [int(line) for line in process.stdout.read().splitlines(keepends=True) if line.endswith("\n")]
            last = site.ledger.last(0)[0]
            assert lines == [lines[0], *range(lines[0], lines[-1] + 1)]
            assert last >= lines[-1]
        assert site.ledger.epoch("execute") == 3


def test_a_role_does_not_join_a_socket_that_is_no_knowledge(endpoint, tmp_path):
    """Something else listens there."""
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(endpoint.removeprefix("unixsock-stream/"))
        other.listen()
        process = start(f'{BEGIN}\n    Member(wire, "plan", patience=0.5).connect()', endpoint)
        code, _, err = ended(process)
    assert code == 1
    assert "no Knowledge answers on unixsock-stream" in err


def test_it_can_be_started_before_its_process_knows_the_rest(endpoint, wire, tmp_path):
    """All five in processes of their own, the roles first."""
    program = f"""{BEGIN}
    from bus_peers import play_part
    with Member(wire, sys.argv[2], layout=TOLD if sys.argv[2] == "execute" else None) as peer:
        print(len(play_part(peer, 0, 50)))
    """
    processes = {role: start(program, endpoint, role) for role in ("plan", "analyze", "monitor", "execute")}
    try:
        with Site(wire, tmp_path / "l") as site:
            assert {role: ended(process)[1] for role, process in processes.items()} == {
                "plan": "50\n", "analyze": "50\n", "monitor": "50\n", "execute": "51\n",
            }  # fmt: skip
            assert site.ledger.last(0) == (50, 50, 50, 50)
    finally:
        for process in processes.values():
            process.kill()
            process.communicate()
