"""The example that watches a log: before there is one, where there will be none, and until Ctrl-C."""

import json
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

from adapters.cli.main import main
from adapters.stores import Store

ROOT = Path(__file__).parents[2]
WATCH = ROOT / "examples" / "watch_the_log.py"
GOALS = ROOT / "examples" / "gridworld_goals.toml"


@contextmanager
def watching(folder):
    """Yield the process once it says that it waits."""
    command = [sys.executable, WATCH, folder]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr.readline() == f"waiting for the log of {folder}\n"
            yield process
        finally:
            process.kill()


def make_log(folder):
    """Begin a run's folder as Knowledge does, without a record in it."""
    folder.mkdir()
    with Store(folder / "log.sqlite") as store:
        store.set_facts(config={"trials": 1, "loops": 1, "episodes": 1})
        store.commit()


def test_it_may_be_started_before_the_run(tmp_path):
    with watching(tmp_path / "later") as process:
        make_log(tmp_path / "later")
        with Store(tmp_path / "later" / "log.sqlite") as store:
            signals = {"return": -3.0}
            drift = {"signal": "return", "direction": "down"}
            request = {"schema": "ChangeRequest/1", "loop": 0, "pass": 1, "drifts": [drift], "added": [], "removed": []}
            store.append(0, 1, 2, json.dumps({**request, "signals": signals}))
            plan = {"schema": "ChangePlan/1", "loop": 0, "pass": 1, "epsilon": 1.0, "learning_rate": [0.1], "add": []}
            plan |= {"drop": [], "enable": [], "reset_detector": False, "adopt": None}
            store.append(0, 1, 3, json.dumps(plan))
            store.commit()
        out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")
    assert out.splitlines()[:2] == ["loop 0, pass 1", "  Analyze   return drifted down."]
    assert "epsilon 1.000" in out


@pytest.mark.parametrize("begun", [False, True])
def test_ctrl_c_ends_it_without_a_word(tmp_path, begun):
    with watching(tmp_path / "later") as process:
        if begun:
            make_log(tmp_path / "later")
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=60) == ("", "")
    assert process.returncode == 130


def test_a_folder_of_tables_is_refused_with_what_writes_a_log(tmp_path):
    folder = tmp_path / "run"
    assert main(["run", str(GOALS), "--set", "episodes=2", "--no-figures", "-q", "--out", str(folder)]) == 0

    done = subprocess.run([sys.executable, WATCH, folder], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (1, "")
    assert "`mapek up` and `mapek serve` write one" in done.stderr
    assert "Traceback" not in done.stderr
