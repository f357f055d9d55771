"""The README's promises: its examples are the files, each is short and runs as it stands, and its commands exist."""

import contextlib
import json
import os
import re
import shlex
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from adapters.cli.options import parser
from adapters.results import read_episodes
from adapters.systems import make_system
from knowledge import from_json
from mape import load, run_trial
from mape.config_files import find_config

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
WATCH = ROOT / "examples" / "watch_the_log.py"  # needs a run to be watched
SCRIPTS = sorted({*(ROOT / "examples").glob("*.py")} - {WATCH})


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_every_example_script_runs_as_it_stands(script):
    done = subprocess.run([sys.executable, str(script)], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


def test_the_swapped_detector_alarms_soon_after_each_drift():
    done = subprocess.run(
        [sys.executable, "examples/swap_detector.py"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    alarms = [int(number) for number in re.findall(r"\d+", done.stdout)]
    for drift in (301, 601, 901, 1201):
        assert any(drift <= alarm < drift + 20 for alarm in alarms), (drift, alarms)


@pytest.mark.parametrize("name", ["swap_detector", "swap_planner", "swap_system"])
def test_the_readme_shows_the_file_itself_in_at_most_20_lines_of_code(name):
    text = (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8")
    assert f"```python\n{text}```" in README
    assert len([line for line in text.splitlines() if line.strip()]) <= 20


def test_a_rule_of_ones_own_is_compiled_with_the_rest_and_gives_the_hash_of_python(here):
    compiled, plain = (
        _typed(f"{line} -v -q --no-figures --out results/{name}", here)
        for line, name in zip(_lines("mapek run own_rule"), ("compiled", "plain"), strict=True)
    )
    assert "own_rule: whole stretches of passes are compiled" in compiled
    assert "own_rule: nothing is compiled, because the engine is python" in plain
    assert _hashes(here / "results" / "compiled") == _hashes(here / "results" / "plain")
    alarms = json.loads((here / "results" / "plain" / "result.json").read_bytes())["trials"][0]["alarms"]
    for drift, alarm in zip((301, 601, 901, 1201), alarms, strict=True):
        assert drift <= alarm < drift + 20


def test_the_readme_shows_a_part_of_the_rule_of_ones_own_and_how_it_is_checked(here):
    text = (ROOT / "examples" / "own_rule.py").read_text(encoding="utf-8")
    (shown,) = (code for code in re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL) if "QuietRule" in code)
    assert shown in text
    assert len([line for line in shown.splitlines() if line.strip()]) <= 24
    (line,) = re.findall(r"`(mapek check \S+:Ewma)`", README)
    said = _typed(line, here)
    assert "ok      has a rule that does what its methods do, in Python and compiled" in said
    (line,) = re.findall(r"`(mapek check \S+ --profile [^`]*)`", README)
    assert "ok      has rules that equal its steps, bit for bit" in _typed(line, here)


def test_a_subclass_whose_base_has_a_rule_is_made_in_python_as_the_readme_says(here):
    options = "-v -q --no-figures --set episodes=3 --set plan=swap_planner:Gentle --out results/gentle"
    said = _typed(f"mapek run traffic {options}", here)
    assert "traffic: only episodes are compiled, because planner Gentle declares no rule" in said


def test_a_pass_is_taught_in_about_20_lines_and_says_all_four_records():
    text = (ROOT / "examples" / "teach_a_pass.py").read_text(encoding="utf-8")
    assert len([line for line in text.splitlines() if line.strip()]) <= 21
    done = subprocess.run(
        [sys.executable, "examples/teach_a_pass.py"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert [line.split()[1] for line in done.stdout.splitlines()] == ["Plan", "Execute", "Monitor", "Analyze", "Plan"]


@pytest.mark.parametrize("name", ["frozen_lake", "cliff_walking", "taxi"])
def test_a_toy_text_is_itself_by_default_and_its_table_with_a_profile(name):
    path = ROOT / "examples" / f"{name}.toml"
    assert make_system(load(path).system).rules is None
    chosen = [
        load(path, profile="tabulated", overrides=["episodes=40", f"execute.engine={engine}"])
        for engine in ("python", "compiled")
    ]
    called, compiled = (run_trial(one, 0, make_system) for one in chosen)
    assert compiled.log_sha256 == called.log_sha256
    assert compiled.q_table_sha256 == called.q_table_sha256


@pytest.mark.parametrize("name", ["frozen_lake", "cliff_walking", "taxi"])
def test_a_toy_text_is_learned_with_the_seed_of_its_config(name, here):
    _typed(f"mapek run {name} --profile tabulated -q --no-figures --out results/{name}", here)
    returns = read_episodes(here / "results" / name / f"episodes-{name}.npz")["return"][0]
    assert returns[-100:].mean() > returns[:100].mean()


def test_the_readme_shows_the_config_of_the_machine_and_its_signal_mask_and_drift_are_seen(here):
    assert f"```toml\n{(ROOT / 'examples' / 'machine.toml').read_text(encoding='utf-8')}```" in README
    (line,) = re.findall(r"`(mapek run machine [^`]*)`", README)
    said = _typed(f"{line} -q --no-figures --out results/machine", here)
    assert re.findall(r"^--- pass (\d+)", said, flags=re.MULTILINE) == ["308", "309", "310"]
    assert len(re.findall(r"^Execute .*; vibration [3-4]\.\d+\.$", said, flags=re.MULTILINE)) == 3
    assert re.findall(r"^alarms: +(.*) \(episodes\)$", said, flags=re.MULTILINE) == ["309"]
    assert re.findall(r"^Analyze +(vibration drifted up)\.", said, flags=re.MULTILINE) == ["vibration drifted up"]
    assert "all kept" in _typed("mapek check machine", here)

    config = load("machine")
    assert config.learner == load("frozen_lake").learner
    assert make_system(config.system).drifts == (301,)
    masked, free = (
        run_trial(load("machine", overrides=[f"execute.mask_greedy={on}"]), 0, make_system) for on in ("true", "false")
    )
    assert masked.log_sha256 != free.log_sha256
    answering = load("machine", overrides=['plan.respond_to=["added"]'])
    assert run_trial(answering, 0, make_system).log_sha256 != masked.log_sha256


def _commands():
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", README, flags=re.MULTILINE | re.DOTALL)
    lines = [line for language, block in blocks if not language for line in block.splitlines()]
    return [line for line in lines if line.startswith("mapek ")]


@pytest.mark.parametrize("command", _commands())
def test_every_command_of_the_readme_is_understood(command):
    words = shlex.split(command)[1:]
    chosen = parser().parse_args(words)
    assert chosen.command == words[0]
    assert not hasattr(chosen, "config") or find_config(chosen.config) in set((ROOT / "examples").iterdir())


def test_a_detector_of_ones_own_is_found_from_the_command_line_in_its_folder(tmp_path):
    environment = {**os.environ, "PYTHONPATH": ""}
    done = subprocess.run(
        [sys.executable, "-m", "mape", "check", "swap_detector:Failures"],
        cwd=ROOT / "examples", capture_output=True, text=True, env=environment,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "all kept" in done.stdout


# Processes. One run of `mapek up` and one of five `mapek serve` are shared by the tests that look at them.

MAPEK = (sys.executable, "-m", "mape")


def _typed(command, cwd, code=0):
    """Type a line of the README in a folder that has the examples."""
    words = shlex.split(command)
    start = MAPEK if words[0] == "mapek" else (sys.executable,)
    done = subprocess.run([*start, *words[1:]], cwd=cwd, capture_output=True, text=True, timeout=120)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def _lines(start):
    found = [command for command in _commands() if command.startswith(start)]
    assert found, f"the README has no line {start}"
    return found


def _passes(said):
    return [int(number) for number in re.findall(r"pass (\d+)$", said, flags=re.MULTILINE)]


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    folder = tmp_path_factory.mktemp("readme")
    (folder / "examples").symlink_to(ROOT / "examples")
    return folder


@pytest.fixture(scope="module")
def alone():
    return run_trial(load(ROOT / "examples" / "gridworld_goals.toml"), 0, make_system)


@pytest.fixture(scope="module")
def goals(here):
    (command,) = _lines("mapek up gridworld_goals")
    _typed(f"{command} -q --no-figures", here)
    return here / "results" / "goals"


@pytest.fixture(scope="module")
def served(here):
    """The README's five lines, with Plan as the last; what `status` said before it, and what was seen of the log."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    lines = [line.replace("7447", port) for line in _lines("mapek serve") if "--tls" not in line]
    assert [shlex.split(line)[4] for line in lines] == ["knowledge", "monitor", "analyze", "plan", "execute"]
    lines.append(lines.pop(3))
    lines[0] += " -q"
    with contextlib.ExitStack() as opened:

        def start(arguments, name):
            said = opened.enter_context(open(here / name, "w"))
            process = subprocess.Popen([*arguments], cwd=here, stdout=said, stderr=subprocess.STDOUT)
            opened.callback(process.wait)
            opened.callback(process.kill)
            return process

        started = [start([*MAPEK, *shlex.split(line)[1:]], f"{n}.said") for n, line in enumerate(lines[:4])]
        (status,) = (line.replace("7447", port) for line in _lines("mapek status") if "--tls" not in line)
        deadline, pause, said = time.monotonic() + 60, threading.Event(), ""
        while said.count(" here ") < 4:  # all but Plan
            assert time.monotonic() < deadline, said
            asked = subprocess.run([*MAPEK, *shlex.split(status)[1:]], cwd=here, capture_output=True, text=True)
            said = asked.stdout
            pause.wait(0.05)
        folder = here / "results" / "served"
        started.append(start([sys.executable, WATCH, folder], "watch.said"))
        started.append(start([*MAPEK, *shlex.split(lines[4])[1:]], "4.said"))
        for process in started:
            assert process.wait(90) == 0, [path.read_text() for path in sorted(here.glob("*.said"))]
    return folder, said, (here / "watch.said").read_text()


def _hashes(folder):
    (one,) = json.loads((folder / "result.json").read_bytes())["trials"]
    return one["log_sha256"], one["q_table_sha256"]


def test_the_readmes_processes_do_and_say_what_it_says_of_them(goals, served, here, alone):
    """One test, as the five are started but once for it."""
    assert _hashes(goals) == _hashes(served[0]) == (alone.log_sha256, alone.q_table_sha256)

    states = dict(re.findall(r"^(\w+) +(here|away)", served[1], flags=re.MULTILINE))
    assert states == dict.fromkeys(("execute", "monitor", "analyze", "knowledge"), "here") | {"plan": "away"}

    # Knowledge speaks of the run alone, and not of what draws its figures, which has much to say.
    said = (here / "0.said").read_text()
    assert "Knowledge listens on" in said
    assert "INFO" in said
    assert "subset" not in said

    # Each drift and the plan that answered it are seen while the run goes on, and later.
    (line,) = re.findall(r"`(python examples/watch_the_log.py \S+)`", README)
    for said in (served[2], _typed(line, here)):
        assert _passes(said) == [*alone.alarms]
        assert said.count("Analyze   return drifted down.") == said.count("epsilon 1.000") == len(alone.alarms)
    ((file, query),) = re.findall(r'^sqlite3 (\S+) "(.*)"$', README, flags=re.MULTILINE)
    with contextlib.closing(sqlite3.connect(goals.parents[1] / file)) as log:
        assert [number for number, _ in log.execute(query)] == [*alone.alarms]

    def typed(start, code=0):
        return [_typed(line, here, code) for line in _lines(start)]

    (followed,) = typed("mapek log")
    assert _passes(followed) == [*range(1, 1501)]
    whole, up_to = typed("mapek replay")
    assert alone.log_sha256 in whole
    assert "no difference" in whole
    assert "--- after pass 303" in up_to
    (resumed,) = typed("mapek resume results", code=1)
    assert "nothing to continue" in resumed


def test_watching_without_a_folder_says_how_it_is_done(here):
    assert "watch_the_log.py DIR" in _typed("python examples/watch_the_log.py", here, code=1)


def test_the_readmes_keys_are_made(here):
    (line,) = _lines("mapek keys")
    assert "knowledge.lan" in _typed(line, here)
    names = {path.stem for path in (here / "keys").glob("*.key")}
    assert names == {"ca", "knowledge", "execute", "monitor", "analyze", "plan", "operator"}


def test_the_example_of_swaps_makes_three_and_the_readme_shows_its_first(here):
    text = (ROOT / "examples" / "swaps.toml").read_text(encoding="utf-8")
    (shown,) = (block for block in re.findall(r"```toml\n(.*?)```", README, flags=re.DOTALL) if "[[swap]]" in block)
    assert shown.splitlines()[1:] == text.split("[[swap]]")[1].strip().splitlines()[1:]

    said = _typed("mapek run swaps -q --no-figures --out results/swaps", here)
    assert re.findall(r"^pass (\d+): (\S+) is now (\S+)", said, flags=re.MULTILINE) == [
        ("450", "plan", "morphin"), ("700", "monitor", "two_window"), ("1000", "learner", "expected_sarsa"),
    ]  # fmt: skip
    alarms = json.loads((here / "results" / "swaps" / "result.json").read_bytes())["trials"][0]["alarms"]
    for drift in (301, 601, 901, 1201):
        assert any(drift <= alarm < drift + 20 for alarm in alarms), (drift, alarms)


def test_the_example_of_many_loops_has_four_that_differ(here):
    _typed("mapek run many_loops -q --no-figures --out results/loops", here)
    trials = json.loads((here / "results" / "loops" / "result.json").read_bytes())["trials"]
    assert len({one["log_sha256"] for one in trials}) == len(trials) == 4


def test_the_example_that_runs_freely_waits_for_no_plan_and_logs_how_old_each_was(here):
    (line,) = _lines("mapek up free_running")
    _typed(f"{line} --set episodes=400 -q --no-figures --out results/free", here)
    with contextlib.closing(sqlite3.connect(here / "results" / "free" / "log.sqlite")) as log:
        seen = [from_json(body) for (body,) in log.execute("SELECT body FROM records WHERE stage = 0 ORDER BY pass")]
    assert [one.pass_no for one in seen] == [*range(1, 401)]
    assert all(one.age >= 1 for one in seen)
    assert seen[-1].plan > 0  # plans come while it runs, and are taken
    assert "free-running needs processes" in _typed("mapek run free_running", here, code=2)
