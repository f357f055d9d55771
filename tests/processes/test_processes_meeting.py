"""Where processes meet: nobody joins a stranger's run, and who leaves before the run is over is started again."""

import json
import os
import re
import signal
import socket
import sys

import pytest
from bus_peers import Site
from real_processes import (
    EXAMPLES,
    ROLES,
    alone,
    endpoint,
    events,
    hashes,
    run_here,
    serve,
    started,
    until,
    up,
    write_config,
)
from real_runs import little_room, run

from adapters.buses import Wire
from adapters.processes import supervise
from adapters.processes.supervise import Failed, Supervisor
from mape import load

WORLD = """
import os
from pathlib import Path

import gymnasium
from gymnasium.spaces import Discrete


class Leaves(gymnasium.Env):
    observation_space, action_space = Discrete(3), Discrete(2)

    def __init__(self, again=False):
        self.again = again

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.leaves = options["episode"] == 40 and (self.again or not Path("left").exists())
        return 0, {}

    def step(self, action):
        if self.leaves and os.environ.get("MAY_LEAVE"):
            Path("left").touch()
            os._exit(0)
        self.steps += 1
        return int(self.np_random.integers(3)), float(action), False, self.steps == 4, {}


gymnasium.register("Leaves-v0", Leaves)
"""


def gridworld(here, episodes, name="config.json"):
    config = load(
        EXAMPLES / "gridworld_goals.toml", overrides=[f"episodes={episodes}", "system.options.switch_at=[31]"]
    )
    return write_config(here, json.loads(config.to_json()), name)


def leaving(here, monkeypatch, *, again):
    (here / "own_world.py").write_text(WORLD)
    monkeypatch.setenv("MAY_LEAVE", "1")
    system = {"id": "own_world:Leaves-v0", "options": {"again": again}, "max_steps": 10}
    return write_config(here, {"name": "leaves", "episodes": 80, "system": system})


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.mark.parametrize("over", ["tcp", pytest.param("unix", marks=pytest.mark.long)])
def test_a_second_run_at_the_same_place_is_refused_at_once_and_the_first_is_unharmed(here, over):
    config = gridworld(here, 600)
    at = free_port() if over == "tcp" else endpoint(here)
    with up(config, at=at) as running:
        running.wait_for_pass(20)
        before = running.children()
        os.kill(before["execute"], signal.SIGSTOP)  # so that it is not over before the second has begun
        with up(config, out="second", at=at) as second:
            said = second.process.end(1)
        os.kill(before["execute"], signal.SIGCONT)
        assert f"cannot listen on {at}; is another Knowledge running there?" in said
        assert not second.out.exists()
        assert running.children() == before
        result = running.result()
    assert hashes(result) == alone(config)
    assert len(events(running.log, "joined")) == 4


def test_no_role_is_let_into_a_run_whose_knowledge_was_not_started_here(here):
    """Between a look at the endpoint and the start of Knowledge another one may have taken it."""
    joins = "import sys; sys.stdin.readline(); open(sys.argv[1], 'w').close()"
    commands = {role: [sys.executable, "-S", "-c", joins, str(here / f"{role}-joins")] for role in ROLES[1:]}
    commands["knowledge"] = [sys.executable, "-S", "-c", "import time; time.sleep(100)"]
    wire = Wire(endpoint(here), "example")
    looks = []

    class Enough(Exception):
        pass

    def look(supervisor):
        looks.append(supervisor.status)
        if len(looks) == 10:
            raise Enough

    with Site(wire), Supervisor(wire, commands, here) as supervisor, pytest.raises(Enough):
        supervisor.watch(look)
    assert set(looks) == {None}
    assert list(here.glob("*-joins")) == []
    assert supervisor.why_waiting() == f"another Knowledge answers on {wire.endpoint}"


def test_a_knowledge_that_cannot_be_reached_is_told_and_ends_the_run(here, monkeypatch):
    for name, value in (("TOLD_AFTER", 0.1), ("STARTS_WITHIN", 0.6), ("LOOK_EVERY", 0.01)):
        monkeypatch.setattr(supervise, name, value)
    commands = {role: [sys.executable, "-S", "-c", "import time; time.sleep(100)"] for role in ROLES}
    told, waits = [], set()
    wire = Wire(endpoint(here), "example")
    why = f"no Knowledge answers on {wire.endpoint}; start it, or look at the address"
    with (
        Supervisor(wire, commands, here, hang_after=0.6, tell=told.append) as supervisor,
        pytest.raises(Failed, match=f"^knowledge runs, and cannot be reached: {re.escape(why)}"),
    ):
        supervisor.watch(lambda supervisor: waits.add(supervisor.why_waiting()))
    assert {sentence.startswith(why) for sentence in waits if sentence} == {True}
    assert "" in waits  # at first it is only starting
    assert len([sentence for sentence in told if why in sentence]) == 1
    assert {role: child.restarts for role, child in supervisor.children.items() if child.restarts} == {"knowledge": 1}


@pytest.mark.parametrize(("where", "code"), [("__init__", 2), ("close", 1)])
def test_a_role_whose_system_exits_by_itself_fails_with_a_sentence(here, where, code):
    (here / "own_world.py").write_text(f"{WORLD}\n\nimport sys\nLeaves.{where} = lambda self: sys.exit(0)\n")
    system = {"id": "own_world:Leaves-v0", "max_steps": 10}
    config = str(write_config(here, {"name": "leaves", "episodes": 80, "system": system}))
    nowhere = ("--connect", "tcp/[::1]:7447", "--tls", "keys")
    with started("serve", config, "--role", "execute", *nowhere, cwd=here) as execute:
        said = execute.end(code, 60.0)
    assert "SystemExit" in said or "sys.exit(0)" in said
    assert "Traceback" not in said


@pytest.mark.long
def test_who_leaves_before_the_run_is_over_is_started_again(here, monkeypatch):
    config = leaving(here, monkeypatch, again=False)
    with up(config) as running:
        result = running.result()
    assert (here / "left").exists()
    assert len([event for event in events(running.log, "joined") if event.role == "execute"]) == 2
    monkeypatch.delenv("MAY_LEAVE")
    assert hashes(result) == hashes(run_here(config))


@pytest.mark.long
def test_who_leaves_again_and_again_ends_the_run_with_a_sentence_that_names_the_way_on(here, monkeypatch):
    config = leaving(here, monkeypatch, again=True)
    with up(config) as running:
        said = running.process.end(1, 60.0)
    assert "execute failed twice at the same place: it ended as if all were done" in said
    assert said.count("kept") == 1
    assert "`mapek resume up` continues." in said


def test_a_full_disk_names_the_folder_with_which_to_go_on_once(here):
    config = gridworld(here, 2000)
    with up(config, start=little_room(200_000)) as running:
        said = running.process.end(1, 60.0)
    assert re.search("knowledge failed twice (at the same place|within [0-9]+ s): up/log.sqlite cannot be", said), said
    # A role is none the worse for it: to start all of them again, each at its next question, took half a minute.
    assert [event.role for event in events(running.log, "joined")].count("execute") == 1
    assert len(events(running.log, "joined")) == len(ROLES) - 1
    assert (said.count("mapek resume"), said.count("kept")) == (1, 1), said
    assert "`mapek resume up`" in said


def test_a_role_of_another_system_is_refused_with_the_difference(here):
    config = gridworld(here, 100_000)
    with up(config) as running:
        running.wait_for_pass(5)
        traffic = str(EXAMPLES / "traffic.toml")
        with started("serve", traffic, "--role", "plan", "--connect", running.endpoint, cwd=here) as stranger:
            said = stranger.end(2, 60.0)
    assert "system.id is 'mapek/TrafficJunction-v0' in plan, and 'mapek/Gridworld-v0' in Knowledge" in said


def test_the_first_difference_told_is_none_that_is_only_for_people(here):
    ours = load(EXAMPLES / "gridworld_goals.toml", overrides=["episodes=100000"])
    config = write_config(here, json.loads(ours.to_json()))
    theirs = {**json.loads(ours.to_json()), "name": "other", "description": "of something else"}
    with serve(config, "knowledge", endpoint(here)) as knowledge:
        until(lambda: "Knowledge listens" in knowledge.said, "Knowledge to listen")
        for change, difference in (({"loops": 3}, "loops is 3 in plan, and 1"), ({}, "name is 'other' in plan")):
            other = write_config(here, theirs | change, "other.json")
            with started("serve", str(other), "--role", "plan", "--connect", endpoint(here), cwd=here) as stranger:
                assert difference in stranger.end(2, 60.0)


@pytest.mark.long
def test_a_knowledge_that_cannot_listen_leaves_no_folder(here):
    config = str(gridworld(here, 100))
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        for at, why in (
            (taken, "is another Knowledge running there?"),
            ("tcp/192.0.2.1:7447", "Cannot assign requested address"),
            (f"unixsock-stream/{here}/none/k.sock", "there is no folder"),
        ):
            more = ("--insecure", "--out", str(here / "out"))
            # In a process of its own, whose standard output it leads elsewhere.
            done = run("serve", config, "--role", "knowledge", "--listen", at, *more, cwd=here, code=1)
            said = done.stdout + done.stderr
            assert said.count("\n") == 1, said
            assert why in said
            assert not (here / "out").exists()
