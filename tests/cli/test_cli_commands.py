"""Every command, as people use it."""

import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import EXAMPLES, Mapek

from adapters.systems import SYSTEMS
from mape.registry import PARTS

GOALS = EXAMPLES / "gridworld_goals.toml"
QUIETLY = ("--no-figures", "-q", "--workers", 1)
# Those that extend another one, for swaps, loops or processes, are run as they stand beside the README's own lines.
CONFIGS = sorted(path for path in EXAMPLES.glob("*.toml") if "extends" not in path.read_text())
COMMANDS = ("run", "compare", "reproduce", "step", "list", "check")
BESIDE_PYTHON = str(Path(sys.executable).with_name("mapek"))


def test_the_examples_that_the_readme_names_are_there() -> None:
    assert {path.stem for path in CONFIGS} >= {
        "cart_pole", "cliff_walking", "frozen_lake", "gridworld_goals", "jump", "taxi", "traffic",
    }  # fmt: skip


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_example_runs(mapek: Mapek, path: Path) -> None:
    outcome = mapek("run", path, "--set", "episodes=12", *QUIETLY, "--out", "out")

    assert outcome.code == 0, outcome.err
    assert "episodes: 12, trials: 1, seed: 0" in outcome.out
    assert "results:  out" in outcome.out
    assert Path("out/result.json").exists()


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_agent_of_every_example_runs(mapek: Mapek, path: Path) -> None:
    from mape.config import overlays_of

    for agent in overlays_of(path, "agent"):
        outcome = mapek("run", path, "--agent", agent, "--set", "episodes=3", *QUIETLY, "--out", agent)
        assert outcome.code == 0, outcome.err
        assert Path(agent, f"config-{agent}.json").exists()


def test_results_go_into_a_new_folder_each_time(mapek: Mapek) -> None:
    for _ in range(3):
        assert mapek("run", GOALS, "--set", "episodes=2", *QUIETLY).code == 0

    folders = list(Path("results").iterdir())
    assert len(folders) == 3
    assert all(folder.name.startswith("gridworld_goals-") for folder in folders)


def test_show_prints_four_sentences_per_pass_and_no_other_pass(mapek: Mapek) -> None:
    outcome = mapek("run", GOALS, "--set", "episodes=5", "--show", "2:3", *QUIETLY)

    lines = outcome.out.splitlines()
    assert [line.split()[0] for line in lines[:10]] == ["---", "Execute", "Monitor", "Analyze", "Plan"] * 2
    assert (lines[0], lines[5]) == ("--- pass 2", "--- pass 3")
    assert lines[1].startswith("Execute   drove episode 2 under plan 1 (epsilon 0.956): return ")
    assert lines[2].startswith("Monitor   return ")
    assert lines[3] == "Analyze   nothing changed."
    assert lines[4].startswith("Plan      plan 2: epsilon 0.914, learning rate (0.1, 0.99, 5).")
    assert not [line for line in lines[10:] if line.startswith(("---", "Execute", "Monitor", "Analyze", "Plan "))]


def test_the_steps_of_one_trial_are_counted_and_those_of_several_averaged(mapek: Mapek) -> None:
    one, two = (
        mapek("run", GOALS, "--set", "episodes=3", "--trials", trials, "--no-figures", "-q", "--json", "result.json")
        for trials in (1, 2)
    )
    totals = [trial["total_steps"] for trial in json.loads(Path("result.json").read_bytes())["trials"]]

    assert f"\nsteps:    {totals[0]} in total\n" in one.out
    assert re.search(rf"\nsteps:    {sum(totals) / 2:.2f} ± \S+ per trial\n", two.out)


def test_show_follows_an_alarm_from_the_test_to_the_plan(mapek: Mapek) -> None:
    alarms = mapek("run", GOALS, "--set", "episodes=320", *QUIETLY, "--json", "-").json["trials"][0]["alarms"]
    alarm = next(episode for episode in alarms if episode > 300)
    outcome = mapek("run", GOALS, "--set", "episodes=320", "--show", f"{alarm}", *QUIETLY)

    _, _, monitor, analyze, plan = outcome.out.splitlines()[:5]
    assert monitor.endswith(", ALARM.")
    assert analyze == "Analyze   return drifted down."
    assert plan.startswith(f"Plan      plan {alarm}: epsilon 1.000")


def test_show_goes_to_standard_error_where_standard_output_carries_json(mapek: Mapek) -> None:
    outcome = mapek("run", GOALS, "--set", "episodes=3", "--show", "1:1", *QUIETLY, "--json", "-")

    assert outcome.json["passes"] == 3
    assert "Plan      plan 1: " in outcome.err


def test_show_does_not_change_the_run(mapek: Mapek) -> None:
    plain, shown = (
        mapek("run", GOALS, "--set", "episodes=20", "--trials", 2, *QUIETLY, "--json", "-", *more).json
        for more in ((), ("--show", "1:20", "--trace", "3:9"))
    )

    assert shown == plain


def step_with(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(text))


def test_step_prints_a_record_on_each_enter_from_plan_0_on(mapek: Mapek, monkeypatch: pytest.MonkeyPatch) -> None:
    step_with(monkeypatch, "\n" * 6 + "q\n")
    outcome = mapek("step", GOALS)

    assert outcome.code == 0
    said = [line.split("] ")[-1] for line in outcome.out.splitlines()]
    assert [line.split()[0] for line in said[1:9]] == [
        "---", "Plan", "---", "Execute", "Monitor", "Analyze", "Plan", "---",
    ]  # fmt: skip
    assert said[1:4] == ["--- start", "Plan      plan 0: epsilon 1.000, learning rate (0.1, 0.99, 5).", "--- pass 1"]
    assert said[8] == "--- pass 2"


def test_step_runs_to_a_pass_and_on_to_the_end(mapek: Mapek, monkeypatch: pytest.MonkeyPatch) -> None:
    step_with(monkeypatch, "\n\n\n5\n" + "\n" * 8)
    outcome = mapek("step", GOALS, "--set", "episodes=6")
    whole = mapek("run", GOALS, "--set", "episodes=6", *QUIETLY, "--json", "-").json

    assert outcome.code == 0
    assert "[pass 5] --- pass 5" in outcome.out
    # Stopping on the way changes nothing.
    assert outcome.out.splitlines()[-1].endswith(f"log {whole['trials'][0]['log_sha256']}")


def test_step_shows_the_last_plan_too(mapek: Mapek, monkeypatch: pytest.MonkeyPatch) -> None:
    step_with(monkeypatch, "\n" * 20)
    outcome = mapek("step", GOALS, "--set", "episodes=2")

    assert [line.split("] ")[-1].split(",")[0] for line in outcome.out.splitlines()][-2:] == [
        "Plan      plan 2: epsilon 0.914",
        f"the run ends after 2 passes. log {outcome.out.split()[-1]}",
    ]


def test_step_can_begin_later(mapek: Mapek, monkeypatch: pytest.MonkeyPatch) -> None:
    step_with(monkeypatch, "\nq\n")
    outcome = mapek("step", GOALS, "--from", 4)

    assert "[pass 4] --- pass 4" in outcome.out
    assert "under plan 3" in outcome.out


@pytest.mark.parametrize("nonsense", ["xx", "0", "-1", "7", "2.5", "½"])
def test_step_says_what_it_takes_when_given_nonsense_and_goes_on(
    mapek: Mapek, monkeypatch: pytest.MonkeyPatch, nonsense: str
) -> None:
    step_with(monkeypatch, f"{nonsense}\n\nquit\n")
    outcome = mapek("step", GOALS, "--set", "episodes=6")

    assert outcome.code == 0
    assert (
        outcome.err
        == f"{nonsense!r} is no pass from 1 to 6. Enter: next record; a number: run to that pass; q: leave.\n"
    )
    assert "--- start" in outcome.out


def test_step_leaves_at_the_end_of_the_input(mapek: Mapek, monkeypatch: pytest.MonkeyPatch) -> None:
    step_with(monkeypatch, "\n")
    outcome = mapek("step", GOALS)

    assert outcome.code == 0
    assert outcome.out.count("[pass 1]") == 2
    assert outcome.err == ""


def test_step_from_beyond_the_run_is_refused(mapek: Mapek) -> None:
    outcome = mapek("step", GOALS, "--from", 1501)

    assert outcome.code == 2
    assert "--from 1501" in outcome.err
    assert "1500 episodes" in outcome.err


def test_list_names_every_part_and_system_in_one_line_each(mapek: Mapek) -> None:
    outcome = mapek("list")

    assert outcome.code == 0
    lines = [line.split(maxsplit=2) for line in outcome.out.splitlines()]
    wanted = [("system", name) for name in SYSTEMS]
    wanted += [(kind, name) for kind, parts in PARTS.items() for name in parts]
    assert [(kind, name) for kind, name, _ in lines] == wanted
    assert all(len(summary) > 10 for *_, summary in lines)
    assert ("detector", "adwin") in wanted


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(mapek: Mapek, command: str) -> None:
    outcome = mapek(command, "--help")

    assert outcome.code == 0
    assert outcome.out.startswith(f"usage: mapek {command}")
    assert outcome.err == ""


def test_help_names_every_command_and_the_exit_codes(mapek: Mapek) -> None:
    outcome = mapek("--help")

    assert outcome.code == 0
    assert [command for command in COMMANDS if f"\n    {command}" not in outcome.out] == []
    assert "0 done, 1 failure, 2 usage, 130 stopped by Ctrl-C" in outcome.out


def test_without_a_command_the_help_is_printed_and_the_code_is_that_of_usage(mapek: Mapek) -> None:
    outcome = mapek()

    assert outcome.code == 2
    assert outcome.out == mapek("--help").out


def test_version_names_what_the_bits_depend_on(mapek: Mapek) -> None:
    outcome = mapek("--version")

    assert outcome.code == 0
    assert outcome.out.startswith("mapek ")
    for name in ("python", "numpy", "numba", "llvmlite", "gymnasium", "libc", "architecture"):
        assert f", {name} " in outcome.out


@pytest.mark.parametrize("arguments", [("--help",), ("--version",), ("list",), ("run", "nowhere.toml")], ids=" ".join)
def test_python_m_mape_is_the_console_script_whatever_lies_where_one_stands(
    here: Path, arguments: tuple[str, ...]
) -> None:
    (here / "mapek").mkdir()
    (here / "random.py").write_text("raise OSError('not the random of Python')")
    script, module = (
        subprocess.run([*start, *arguments], capture_output=True, text=True, timeout=60, cwd=here, check=False)
        for start in ((BESIDE_PYTHON,), (sys.executable, "-m", "mape"))
    )

    assert (module.returncode, module.stdout, module.stderr) == (script.returncode, script.stdout, script.stderr)
    assert script.stdout or script.returncode == 2


def test_help_answers_without_the_heavy_imports() -> None:
    code = (
        "import sys; from mapek import main; main(['--help'])\n"
        "heavy = {'numpy', 'numba', 'gymnasium', 'pydantic', 'scipy', 'matplotlib'}\n"
        "sys.exit(', '.join(heavy & set(sys.modules)) or 0)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)

    assert (found.returncode, found.stderr) == (0, "")


def test_parts_and_systems_of_ones_own_are_found_in_the_current_folder_by_every_process(here: Path) -> None:
    (here / "mine.py").write_text(
        "import gymnasium\n"
        "from gymnasium.spaces import Discrete\n"
        "from mape.plan.q_learning import QLearningPlanner, QLearningPlannerConfig\n\n"
        "class Line(gymnasium.Env):\n"
        "    observation_space, action_space = Discrete(5), Discrete(2)\n"
        "    def reset(self, *, seed=None, options=None):\n"
        "        super().reset(seed=seed)\n"
        "        self.at = 0\n"
        "        return 0, {}\n"
        "    def step(self, action):\n"
        "        self.at = max(self.at + 2 * int(action) - 1, 0)\n"
        "        return self.at, -1.0, self.at == 4, False, {}\n\n"
        "class Slow(QLearningPlanner):\n"
        "    Config = None\n"
        "    def __init__(self, schedule):\n"
        "        super().__init__(QLearningPlannerConfig(alpha=0.01), schedule)\n\n"
        "gymnasium.register('Line-v0', Line, max_episode_steps=30)\n"
    )
    (here / "mine.toml").write_text(
        'episodes = 40\ntrials = 3\nsystem = { id = "mine:Line-v0" }\n'
        'plan = { name = "mine:Slow", schedule = "constant" }\n'
    )

    found = subprocess.run(
        [BESIDE_PYTHON, "run", "mine.toml", "--workers", "2", "-q", "--no-figures", "--json", "mine.json"],
        capture_output=True, text=True, timeout=120, cwd=here, check=False,
    )  # fmt: skip

    assert (found.returncode, found.stderr) == (0, "")
    assert "trials: 3" in found.stdout


def test_a_reader_that_leaves_early_causes_no_traceback(here: Path) -> None:
    with subprocess.Popen(
        [BESIDE_PYTHON, "list"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=here
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        said = process.stderr.read()
        assert process.wait(60) == 1

    assert said == ""


def test_figures_are_drawn_beside_the_tables_unless_refused(mapek: Mapek) -> None:
    outcome = mapek("run", GOALS, "--set", "episodes=20", "--trace", "1:20", "-q", "--out", "out")

    assert outcome.code == 0, outcome.err
    names = {path.name for path in Path("out/figures").iterdir()}
    assert {
        f"{name}.{kind}" for name in ("learning_curve", "internal_dynamics", "q_heatmap") for kind in ("png", "pdf")
    } <= names
    assert "figures:  out/figures" in outcome.out


def test_a_package_of_another_project_with_our_name_is_told_by_its_place(tmp_path):
    (tmp_path / "knowledge").mkdir()
    (tmp_path / "knowledge" / "__init__.py").write_text("")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", "import sys; from mapek import main; sys.exit(main(['list']))"],
        env=environment, cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert f"'knowledge' is found at {tmp_path / 'knowledge' / '__init__.py'}" in done.stderr
    assert "virtual environment" in done.stderr
