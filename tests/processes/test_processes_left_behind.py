"""What is killed leaves no temporary folder for long, and whoever it leaves behind is named."""

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from real_processes import EXAMPLES, ROLES, children_of, hashes, passes, started, until, write_config
from real_runs import run, wait_until_gone

from adapters.scratch import PREFIX, scratch
from mape import load

linux = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are named from /proc")


@pytest.fixture
def temporary(here, monkeypatch):
    """A temporary folder of the test's own, short enough for sockets."""
    with tempfile.TemporaryDirectory(prefix="t", dir="/tmp") as folder:
        monkeypatch.setenv("TMPDIR", folder)
        monkeypatch.setattr(tempfile, "tempdir", folder)
        yield Path(folder)


def ours(folder):
    return sorted(folder.glob(f"{PREFIX}*"))


def gridworld(here, episodes):
    overrides = [f"episodes={episodes}", "system.options.switch_at=[101]"]
    return write_config(here, json.loads(load(EXAMPLES / "gridworld_goals.toml", overrides=overrides).to_json()))


def is_stopped(pid):
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"


@linux
def test_up_that_is_killed_leaves_no_temporary_folder(here, temporary):
    with started("up", str(gridworld(here, 100_000)), "--out", "up", "-q", cwd=here) as up:
        until(lambda: up.ended or passes(here / "up" / "log.sqlite") > 20, "some passes")
        assert len(ours(temporary)) == 1
        children = set(children_of(up.pid).values())
        up.signalled(signal.SIGKILL)
        wait_until_gone(children)
    assert ours(temporary) == []


@pytest.mark.long
@linux
def test_processes_that_are_left_behind_stopped_are_named_and_end_when_continued(here, temporary):
    config = gridworld(here, 400)
    with started("up", str(config), "--out", "up", "--no-figures", "-q", cwd=here) as up:
        until(lambda: up.ended or passes(here / "up" / "log.sqlite") > 20, "some passes")
        children = children_of(up.pid)
        assert set(children) == set(ROLES)
        try:
            for pid in children.values():
                os.kill(pid, signal.SIGSTOP)
            until(lambda: all(map(is_stopped, children.values())), "all to be stopped")
            up.signalled(signal.SIGKILL)
            said = run("resume", "up", "-q", cwd=here, code=1).stderr
            for role, pid in children.items():
                assert f"{role} {pid}" in said
            continued = re.search(r"kill -CONT ([\d ]+)", said)
            assert {int(pid) for pid in continued[1].split()} == set(children.values())
        finally:
            for pid in children.values():
                os.kill(pid, signal.SIGCONT)
        wait_until_gone(set(children.values()))
    assert ours(temporary) == []
    run("resume", "up", "-q", cwd=here)
    run("run", str(config), "--out", "alone", "--no-figures", "-q", cwd=here)
    assert hashes(json.loads((here / "up" / "result.json").read_bytes())) == hashes(
        json.loads((here / "alone" / "result.json").read_bytes())
    )


HOLDS = """
from adapters.scratch import scratch

with scratch() as folder:
    print(folder, flush=True)
    input()
"""


def test_the_next_one_removes_what_the_killed_left_and_nothing_else(temporary):
    holders = [
        subprocess.Popen([sys.executable, "-c", HOLDS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    try:
        killed, living = (Path(holder.stdout.readline().strip()) for holder in holders)
        (killed / "tables").mkdir()
        (killed / "tables" / "kept.npz").write_bytes(b"much")
        others = [temporary / f"{PREFIX}somebody", temporary / "another"]
        for other in others:
            other.mkdir()
        (temporary / f"{PREFIX}link").symlink_to(others[1])
        holders[0].kill()
        holders[0].wait()
        assert killed.exists()
        with scratch() as own:
            assert {path.name for path in temporary.iterdir()} == {
                own.name, living.name, *(other.name for other in others), f"{PREFIX}link",
            }  # fmt: skip
        assert not own.exists()
        holders[1].communicate("\n", timeout=60)
        assert not living.exists()
    finally:
        for holder in holders:
            holder.kill()
            holder.communicate()
