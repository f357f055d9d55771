"""Ctrl-C, SIGTERM and kill -9: who is to end ends at once, nobody stays behind, and the run can be gone on with."""

import json
import signal
import sys
from contextlib import ExitStack

import pytest
from real_processes import EXAMPLES, ROLES, alone, endpoint, five, hashes, passes, until, up, write_config
from real_runs import run, wait_until_gone

from mape import load

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}
SIGNALS = pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.long), signal.SIGTERM])


def gridworld(here, episodes, *overrides):
    config = load(
        EXAMPLES / "gridworld_goals.toml",
        overrides=[f"episodes={episodes}", "system.options.switch_at=[101]", *overrides],
    )
    return write_config(here, json.loads(config.to_json()))


@SIGNALS
def test_up_ends_at_once_with_all_its_children_and_is_gone_on_with(here, number, walk):
    config = gridworld(here, 400, f"analyze={walk.part}")
    with up(config) as running:
        running.wait_for_pass(50)
        children = running.children()
        assert set(children) == set(ROLES)
        code, took = running.process.signalled(number)
        wait_until_gone(set(children.values()))
        assert code == CODES[number], running.process.said
        print(f"ended after {took:.2f} s")
        assert "mapek resume up" in running.process.said.replace(f"{here}/", "")
        assert 50 <= running.passes() < 400
    walk.over()
    if number == signal.SIGINT:
        with up(config) as again:
            again.result()
    else:
        run("resume", "up", "-q", cwd=here)
    assert hashes(json.loads((here / "up" / "result.json").read_bytes())) == alone(config)


def test_children_end_by_themselves_when_up_is_killed(here):
    config = gridworld(here, 100_000)
    with up(config) as running:
        running.wait_for_pass(50)
        children = set(running.children().values())
        running.process.signalled(signal.SIGKILL)
        wait_until_gone(children)
        assert running.passes() < 100_000
    assert "Traceback" not in "".join(running.said_by(role) for role in ROLES)


KEEPS_ON = """
from mape.analyze.changes import Changes


class KeepsOn(Changes):
    def analyze(self, symptom):
        while symptom.pass_no == 20:
            try:
                open("keeps-on", "w").close()
            except BaseException:
                pass
        return super().analyze(symptom)
"""


@pytest.mark.long
def test_a_part_that_lets_nothing_end_it_ends_all_the_same_when_up_is_killed(here, monkeypatch):
    monkeypatch.syspath_prepend(here)
    (here / "own_keeps_on.py").write_text(KEEPS_ON)
    with up(gridworld(here, 100, "analyze=own_keeps_on:KeepsOn")) as running:
        until((here / "keeps-on").exists, "a part that keeps on")
        children = set(running.children().values())
        running.process.signalled(signal.SIGKILL)
        wait_until_gone(children)


@pytest.mark.long
def test_a_signal_while_the_figures_are_drawn_is_heard_too(here):
    config = gridworld(here, 60)
    with up(config, short=("-q",)) as running:
        until(lambda: (running.out / "episodes-gridworld_goals.npz").exists(), "the tables", every=0.001)
        code, _ = running.process.signalled(signal.SIGTERM)
    assert code == 143, running.process.said
    assert "Traceback" not in running.process.said
    assert "mapek resume" in running.process.said


@pytest.mark.long
def test_every_served_role_ends_at_once(here):
    config = gridworld(here, 100_000)
    ended = {}
    with ExitStack() as opened:
        sets = {
            number: opened.enter_context(five(config, endpoint(here, number.name), out=number.name)) for number in CODES
        }
        for number, served in sets.items():
            until(lambda name=number.name: passes(here / name / "log.sqlite") > 20, "a run that is on its way")
            # Knowledge last: the others then leave a run that goes on, or at least waits.
            for role in (*ROLES[1:], "knowledge"):
                ended[number.name, role] = served[role].signalled(number)
                assert "Traceback" not in served[role].said
    assert {key: code for key, (code, _) in ended.items()} == {
        (number.name, role): code for number, code in CODES.items() for role in ROLES
    }
    print({key: round(took, 2) for key, (_, took) in ended.items()})
    assert all(passes(here / number.name / "log.sqlite") < 100_000 for number in CODES)


def test_a_role_that_waits_for_knowledge_ends_at_once(here):
    config = gridworld(here, 100)
    with five(config, endpoint(here), order=ROLES[1:]) as served:
        for role, process in served.items():
            until(lambda p=process: "waiting for Knowledge" in p.said, f"{role} to say for whom it waits")
            code, _ = process.signalled(signal.SIGTERM)
            assert code == 143, f"{role}: {process.said}"


LOST = """
import os, signal, sys, threading
import zenoh
from adapters.buses import Wire
from adapters.processes.serve import Terminated, terminated_by_signal


class Finalised:
    def __del__(self):
        os.kill(os.getpid(), number)


def in_a_finaliser():
    Finalised()


def in_a_callback():
    def hear(sample):
        os.kill(os.getpid(), number)
        threading.Event().wait(0.0)

    # What a session says to itself is heard by the thread that says it.
    with Wire(f"unixsock-stream/{os.getcwd()}/k.sock", "example").listen() as session:
        session.declare_subscriber("mape/example/said", zenoh.handlers.Callback(hear, indirect=False))
        session.put("mape/example/said", b"")
        threading.Event().wait(60.0)


def heard():
    try:
        with terminated_by_signal():
            globals()[sys.argv[1]]()
            threading.Event().wait(60.0)
    except (Terminated, KeyboardInterrupt) as stop:
        return type(stop).__name__


for number in (signal.SIGTERM, signal.SIGINT):
    print(heard())
"""


@pytest.mark.parametrize("where", ["in_a_finaliser", "in_a_callback"])
def test_a_signal_that_comes_where_nothing_can_be_raised_is_not_lost(here, where):
    """Figures or tables leave many finalisers behind; and what a callback of Zenoh's raises is only logged."""
    ended = run("-c", LOST, where, cwd=here, start=(sys.executable,))
    assert (ended.stdout.split(), ended.stderr) == (["Terminated", "KeyboardInterrupt"], "")
