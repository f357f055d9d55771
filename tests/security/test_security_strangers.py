"""Another user of the machine against every endpoint that a run opens: nothing is constructed, read or stopped."""

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path

import pytest
from real_processes import events, started, until, up, write_config

from adapters.buses import security, tokens

pytestmark = pytest.mark.skipif(os.getuid() != 0, reason="only root can act as another user")

NOBODY = 65534

# All that will be needed is imported before it becomes somebody else, to whom the interpreter may be hidden.
STRANGER = f"""
import json, os, sys, tempfile
import zenoh
from adapters.buses import messages, security, tokens, wire
from adapters.cli import common, main, serve, status, swap, trust
from adapters.experiments import runner, statistics
from adapters.results import RunFolder, files
from adapters.processes import roles, execute_role
from adapters.systems import make_system
from mape import load

endpoint, mark, config, home, parts = sys.argv[1:]
serve._keep_standard_output = lambda most: None  # it starts the interpreter once more
os.environ["XDG_RUNTIME_DIR"] = tempfile.mkdtemp()
tokens.make("tcp/127.0.0.1:9", security.CLIENTS)
main.main(["status", "--connect", "tcp/127.0.0.1:9"])
main.main(["serve", config, "--role", "knowledge", "--listen", "unixsock-stream//nowhere/at/all"])
os.setgroups([]); os.setgid({NOBODY}); os.setuid({NOBODY})
os.environ["XDG_RUNTIME_DIR"] = os.environ["HOME"] = tempfile.tempdir = home
os.chdir(home)
own = tokens.make(endpoint, security.CLIENTS)  # a token, and not the run's
evil = '{{name = "subprocess:Popen", args = ["touch", "' + mark + '"]}}'
at = ["--connect", endpoint]
codes = [main.main(["status", *at]), main.main(["status", *at, "--token", str(own)])]
for part in parts.split():
    codes.append(main.main(["swap", part, evil, *at]))
codes.append(main.main(["serve", config, "--role", "knowledge", "--listen", endpoint]))

quiet = {{"enabled": False}}
opened = 0
for auth in ({{}}, {{"user": "operator", "password": ""}}, {{"user": "plan", "password": "x" * 43}}):
    connect = {{"endpoints": [endpoint], "timeout_ms": 300, "exit_on_failure": True}}
    transport = {{"shared_memory": quiet, "auth": {{"usrpwd": auth}}}}
    whole = {{"mode": "client", "connect": connect, "transport": transport,
             "scouting": {{"multicast": quiet, "gossip": quiet}}}}
    try:
        zenoh.open(zenoh.Config.from_json5(json.dumps(whole)))
        opened += 1
    except zenoh.ZError:
        pass
print(json.dumps([codes, opened]))
"""


def act_as_a_stranger(endpoint, mark, config, home, parts):
    program = textwrap.dedent(STRANGER)
    arguments = [endpoint, str(mark), str(config), str(home), parts]
    done = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1]), done.stderr


@pytest.fixture
def outside():
    """A folder that everybody may use, as the machine's temporary one."""
    folder = Path(tempfile.mkdtemp(prefix="ms-"))
    folder.chmod(0o777)
    yield folder
    shutil.rmtree(folder)


@pytest.fixture
def config(here):
    return write_config(
        here, {"episodes": 100_000, "system": {"id": "mapek/Gridworld-v0"}, "monitor": {"detectors": ["page_hinkley"]}}
    )


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


LOOPBACK = "tcp/127.0.0.1:PORT"
OTHERS = ["tcp/0.0.0.0:PORT", "unixsock-stream/OUTSIDE/k.sock", "default"]


# Each part that is asked for is some seconds of waiting for an answer that does not come.
@pytest.mark.parametrize(
    ("at", "parts"),
    [
        (LOOPBACK, "monitor"),
        *(pytest.param(at, "monitor analyze plan learner", marks=pytest.mark.long) for at in (LOOPBACK, *OTHERS)),
    ],
)
def test_another_user_reads_constructs_and_stops_nothing(here, outside, config, at, parts):
    where = at.replace("PORT", str(free_port())).replace("OUTSIDE", str(outside))
    home = outside / "home"
    home.mkdir()
    os.chown(home, NOBODY, NOBODY)
    (outside / "config.json").write_bytes(config.read_bytes())
    more = ["--insecure"] if "0.0.0.0" in at else []
    listen = [] if at == "default" else ["--listen", where]
    with started("up", str(config), "--out", "out", "--no-figures", *listen, *more, cwd=here) as running:
        log = here / "out" / "log.sqlite"
        until(lambda: running.ended or (log.exists() and len(events(log, "joined")) == 4), "all roles")
        assert not running.ended, running.said
        words = until(lambda: [w for w in running.said.split() if w.startswith(("tcp/", "unixsock"))], "a place")
        met = words[0].rstrip(";")
        reached = met.replace("0.0.0.0", "127.0.0.1")
        (codes, opened), said = act_as_a_stranger(reached, outside / "mark", outside / "config.json", home, parts)
        assert opened == 0
        assert all(code in (1, 2) for code in codes), (codes, said)
        assert not (outside / "mark").exists()
        assert not running.ended
        assert [event.kind for event in events(log) if event.kind != "joined"] == []
    assert "passes" not in said


def test_a_token_is_in_no_argument_and_no_environment_that_others_could_see(here, config):
    with up(config, at=f"tcp/127.0.0.1:{free_port()}") as running:
        until(lambda: running.process.ended or len(running.children()) == 5, "five processes")
        token = until(lambda: [*tokens_of(running.endpoint)], "the token")[0]
        secrets = [tokens.secret(token, role).encode() for role in security.CLIENTS]
        for pid in (running.process.pid, *running.children().values()):
            for what in ("cmdline", "environ"):
                shown = Path(f"/proc/{pid}/{what}").read_bytes()
                assert not any(secret in shown for secret in secrets)


def tokens_of(endpoint):
    try:
        yield tokens.find(endpoint)
    except tokens.NoToken:
        return
