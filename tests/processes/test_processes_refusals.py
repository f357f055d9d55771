"""Who does not belong to a run, or cannot do its part, is told so in one sentence; nobody else notices."""

import json
import sqlite3
import sys
from contextlib import closing

import pytest
from bus_small_loop import Distributed, small_config
from real_processes import EXAMPLES, MAPEK, ROLES, Started, endpoint, last, say, started, until, up, write_config

from adapters.buses import Wire
from adapters.processes.serve import open_ledger
from adapters.roles import ROLES as SENDERS
from mape import load
from mape.errors import ResultsError

OLD_VERSION = (
    sys.executable,
    "-c",
    "import sys\n"
    "from adapters.processes import serve\n"
    "own = serve.versions\n"
    "serve.versions = lambda: own() | {'mapek': '0.0.9'}\n"
    "from adapters.cli.main import main\n"
    "sys.exit(main())",
)

OWN = """
from mape.plan.morphin import Morphin


class Stumbles(Morphin):
    def plan(self, request, knowledge):
        if request.pass_no == 50:
            raise ZeroDivisionError("no budget left")
        return super().plan(request, knowledge)
"""


def gridworld(here, *overrides):
    (here / "own_parts.py").write_text(OWN)
    config = load(EXAMPLES / "gridworld_goals.toml", overrides=["system.options.switch_at=[101]", *overrides])
    return write_config(here, json.loads(config.to_json()))


def sentence(process: Started, code: int) -> str:
    """The one thing that was said for people, beside lines of the log."""
    said = [line for line in process.end(code, 60.0).splitlines() if line.startswith("mapek: ")]
    assert len(said) == 1, process.said
    assert "Traceback" not in process.said
    return said[0]


@pytest.mark.long
def test_who_does_not_belong_to_a_run_is_told_and_nobody_is_disturbed(here):
    config = gridworld(here, "episodes=100000")
    with up(config) as running:
        running.wait_for_pass(20)
        until(lambda: set(running.children()) == set(ROLES), "all five")
        before = running.children()
        at, log = running.endpoint, str(running.log)
        knowledge = ("serve", str(config), "--role", "knowledge", "--listen")
        plan = ("serve", str(config), "--role", "plan", "--connect")
        asked = {
            (2, "plan.alpha is 0.2 in plan, and 0.1 in Knowledge"): (*plan, at, "--set", "plan.alpha=0.2"),
            (1, "plan is of mapek 0.0.9, Knowledge of mapek"): (*plan, at),
            (1, "another Knowledge writes"): (*knowledge, endpoint(here, "other"), "--log", log),
            (1, "is another Knowledge running there?"): (*knowledge, at, "--out", "second"),
        }  # fmt: skip
        for (code, said), arguments in asked.items():
            start = OLD_VERSION if "0.0.9" in said else MAPEK
            with started(*arguments, cwd=here, start=start, name="stranger") as stranger:
                assert said in sentence(stranger, code)
        reached = running.passes()
        until(lambda: running.passes() > reached + 50, "the run to go on")
        assert running.children() == before


def test_a_part_that_raises_ends_the_run_with_its_sentence_and_the_log_has_all_before(here):
    config = gridworld(here, "episodes=200")
    with up(config, "--set", "plan.name=own_parts:Stumbles") as running:
        said = sentence(running.process, 1)
        assert "plan failed twice at the same place" in said
        assert "planner Stumbles raised ZeroDivisionError: no budget left, at pass 50" in said
        assert last(running.log) == (50, 50, 50, 49)
        assert running.children() == {}


def test_what_is_no_place_to_meet_is_said_at_once(here):
    config = str(gridworld(here, "episodes=200"))
    asked = {
        ("knowledge", "--listen", "tcp/0.0.0.0:7447"): "can be reached from other machines",
        ("plan", "--connect", "tcp/192.0.2.1:7447"): "can be reached from other machines",
        ("plan", "--connect", "127.0.0.1:7447"): "neither unixsock-stream/PATH nor tcp/HOST:PORT",
        ("plan", "--listen", "tcp/127.0.0.1:7447"): "role plan connects",
        ("knowledge", "--connect", "tcp/127.0.0.1:7447"): "role knowledge listens",
    }
    for arguments, sentence in asked.items():
        code, said = say("serve", config, "--role", *arguments)
        assert (code, said.count("\n"), sentence in said) == (2, 1, True), said


def test_what_the_config_has_wrong_is_said_before_anything_is_begun(here):
    config = gridworld(here, "episodes=200")
    for override, said in (("plan.name=own_parts:Nobody", "Nobody"), ("plan.alpha=-1.0", "plan.alpha")):
        with up(config, "--set", override) as running:
            assert said in sentence(running.process, 2)
            assert not running.out.exists()


def test_a_log_that_is_not_whole_is_refused_with_the_same_sentence_each_time(here):
    """Who was refused holds nothing of the file: after the damage is mended it can be opened in the same process."""
    config, path = small_config(8), here / "log.sqlite"
    run = Distributed(config, Wire(f"unixsock-stream/{here}/k.sock", "example"), path)
    run.open()
    try:
        for role in SENDERS:
            run.start(role)
        run.join()
    finally:
        run.close()
    whole = path.read_bytes()
    with closing(sqlite3.connect(path)) as damaged:
        damaged.execute("DELETE FROM records WHERE pass = 4 AND stage = 1")
        damaged.commit()
    for _ in range(2):
        with pytest.raises(
            ResultsError,
            match="Symptom 5 of loop 0 is not the one that was written there, or the one before it is missing",
        ):
            open_ledger(config, path, "normal")
    path.write_bytes(whole)
    with open_ledger(config, path, "normal").store as store:
        assert store.last(0) == (8, 8, 8, 8)
