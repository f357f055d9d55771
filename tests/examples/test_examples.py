"""The README's promises: its examples are the files, each is short and runs as it stands, and its commands exist."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from adapters.cli.main import parser

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SCRIPTS = sorted((ROOT / "examples").glob("*.py"))


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


def test_a_pass_is_taught_in_about_20_lines_and_says_all_four_records():
    text = (ROOT / "examples" / "teach_a_pass.py").read_text(encoding="utf-8")
    assert len([line for line in text.splitlines() if line.strip()]) <= 21
    done = subprocess.run(
        [sys.executable, "examples/teach_a_pass.py"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert [line.split()[1] for line in done.stdout.splitlines()] == ["Plan", "Execute", "Monitor", "Analyze", "Plan"]


def _commands():
    blocks = re.findall(r"```\n(.*?)```", README, flags=re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line.startswith("mapek ")]


@pytest.mark.parametrize("command", _commands())
def test_every_command_of_the_readme_is_understood(command):
    words = shlex.split(command)[1:]
    chosen = parser().parse_args(words)
    assert chosen.command == words[0]
    assert not hasattr(chosen, "config") or (ROOT / chosen.config).exists()


def test_a_detector_of_ones_own_is_found_from_the_command_line_in_its_folder(tmp_path):
    environment = {**os.environ, "PYTHONPATH": ""}
    done = subprocess.run(
        [sys.executable, "-m", "mape", "check", "swap_detector:Failures"],
        cwd=ROOT / "examples", capture_output=True, text=True, env=environment,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "all kept" in done.stdout
