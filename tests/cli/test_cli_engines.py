"""`--engine` and `-v`: what is compiled, who says so, and what is refused; the bits are the same."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import EXAMPLES, Mapek

GOALS = EXAMPLES / "gridworld_goals.toml"
QUIETLY = ("--no-figures", "-q", "--workers", 1)
STRETCHES = "whole stretches of passes are compiled"
NO_RULE = "detector monitor.0 Quiet declares no rule"
OWN = 'monitor.detectors=["bad_parts:Quiet"]'


def test_all_engines_come_to_the_same_result_and_say_what_they_compile(mapek: Mapek) -> None:
    said, results = {}, set()
    for engine in ("auto", "python", "compiled"):
        arguments = ("--engine", engine, "-v", "--set", "episodes=320", "--json", f"{engine}.json", *QUIETLY)
        said[engine] = mapek("run", GOALS, *arguments).err.splitlines()[-1]
        results.add(Path(f"{engine}.json").read_text())

    assert len(results) == 1
    assert said["auto"] == said["compiled"] == f"gridworld_goals: {STRETCHES}"
    assert said["python"] == "gridworld_goals: nothing is compiled, because the engine is python"


def test_without_v_nothing_is_said(mapek: Mapek) -> None:
    assert mapek("run", GOALS, "--engine", "python", "--set", "episodes=3", *QUIETLY).err == ""


def test_engine_is_laid_over_the_config_and_over_set(mapek: Mapek) -> None:
    arguments = ("--set", "execute.engine=compiled", "--set", "episodes=3", "--engine", "python", "--out", "out")
    assert mapek("run", GOALS, *arguments, *QUIETLY).code == 0
    assert '"engine": "python"' in Path("out", "config-gridworld_goals.json").read_text()


def test_v_names_the_part_that_keeps_passes_from_being_compiled(mapek: Mapek) -> None:
    outcome = mapek("run", GOALS, "-v", "--set", "episodes=3", "--set", OWN, *QUIETLY)

    assert outcome.err.splitlines()[-1] == f"gridworld_goals: only episodes are compiled, because {NO_RULE}"


def test_v_names_all_that_keeps_it_from_being_compiled(mapek: Mapek) -> None:
    outcome = mapek("run", EXAMPLES / "cart_pole.toml", "-v", "--set", "episodes=3", "--set", OWN, *QUIETLY)

    because = f"system CartPole-v1 offers no rules and {NO_RULE}"
    assert outcome.err == f"cart_pole: nothing is compiled, because {because}\n"


def test_v_says_from_which_swap_on_something_else_is_compiled(mapek: Mapek) -> None:
    swaps = [
        (3, "plan", "q_learning"),
        (5, "monitor", "bad_parts:Quiet"),
        (5, "plan", "morphin"),
        (7, "monitor", "oracle"),
    ]
    table = ", ".join(f'{{pass={number}, part="{part}", to="{to}"}}' for number, part, to in swaps)
    outcome = mapek("run", GOALS, "-v", "--set", "episodes=9", "--set", f"swap=[{table}]", *QUIETLY)

    assert outcome.code == 0
    assert outcome.err.splitlines()[-1] == (
        f"gridworld_goals: {STRETCHES}; from pass 5 on only episodes are compiled, because {NO_RULE}; "
        f"from pass 7 on {STRETCHES}"
    )


@pytest.mark.parametrize(
    ("looks", "says"),
    [
        (("--show", "2:3"), "the passes of trial 0 are made one by one, to be shown"),
        (("--trace", "2:3"), "passes 2 to 3 of trial 0 are made one by one, to be traced"),
    ],
)
def test_v_says_which_passes_are_made_one_by_one_to_be_looked_at(
    mapek: Mapek, looks: tuple[str, str], says: str
) -> None:
    outcome = mapek("run", GOALS, "-v", *looks, "--set", "episodes=5", *QUIETLY)

    assert outcome.err.splitlines()[-1] == f"gridworld_goals: {STRETCHES}; {says}"


def test_compare_says_it_once_of_each_agent(mapek: Mapek) -> None:
    outcome = mapek(
        "compare", GOALS, "--agents", "morphin,oracle_detector", "--trials", 2, "--engine", "python", "-v", "--set",
        "episodes=3", *QUIETLY,
    )  # fmt: skip

    said = "nothing is compiled, because the engine is python"
    assert outcome.err == f"morphin: {said}\noracle_detector: {said}\n"


def test_reproduce_takes_both(mapek: Mapek) -> None:
    arguments = ("--engine", "python", "-v", "--trials", 2, "--set", "episodes=3")
    outcome = mapek("reproduce", "table1", *arguments, *QUIETLY)

    said = "nothing is compiled, because the engine is python"
    assert (outcome.code, outcome.err) == (0, f"morphin: {said}\nq_learning: {said}\n")


@pytest.mark.parametrize(
    ("config", "override", "names"),
    [
        (GOALS, OWN, NO_RULE),
        (GOALS, 'swap=[{pass=3, part="monitor", to="bad_parts:Quiet"}]', NO_RULE),
        (GOALS, 'plan={name="morphin", schedule="bad_parts:TextSchedule"}', "schedule TextSchedule declares no rule"),
        (GOALS, "plan=bad_parts:Planned", "planner Planned declares no rule"),
        (EXAMPLES / "cart_pole.toml", "seed=0", "a system that offers its rules; CartPole-v1 does not"),
    ],
)
def test_what_cannot_be_compiled_is_refused_before_anything_runs(
    mapek: Mapek, here: Path, config: Path, override: str, names: str
) -> None:
    outcome = mapek("run", config, "--engine", "compiled", "--set", "episodes=5", "--set", override, *QUIETLY)

    assert (outcome.code, outcome.out) == (2, "")
    assert names in outcome.err
    assert "Choose 'auto'" in outcome.err
    assert list(here.iterdir()) == []


def test_an_engine_that_there_is_not_is_refused_with_those_that_there_are(mapek: Mapek) -> None:
    outcome = mapek("run", GOALS, "--engine", "fast")

    assert outcome.code == 2
    assert "'fast'" in outcome.err
    assert all(engine in outcome.err for engine in ("auto", "python", "compiled"))


def test_compiling_is_announced_once_and_workers_find_it_done(here: Path) -> None:
    environment = {**os.environ, "MAPEK_CACHE": str(here / "cache")}
    said = [
        subprocess.run(
            [
                sys.executable, "-m", "mape", "run", str(GOALS), "-v", "--set", "episodes=20", "--trials", "4",
                "--workers", "2", "--no-figures", "-q",
            ],
            capture_output=True, text=True, timeout=120, cwd=here, env=environment, check=True,
        ).stderr.splitlines()
        for _ in range(2)
    ]  # fmt: skip
    compiled = sorted((here / "cache").rglob("*.nbc"))

    assert said[0] == [
        "compiling the episode of this system and learner: some seconds, once",
        "compiling stretches of passes with these parts: some seconds, once",
        f"gridworld_goals: {STRETCHES}",
    ]
    assert said[1] == said[0][2:]
    assert len(compiled) == 2


def test_resume_goes_on_with_the_engine_of_the_run_even_where_its_config_is_gone(mapek: Mapek, here: Path) -> None:
    config = here / "mine.toml"
    config.write_text('episodes = 3\nsystem = { id = "mapek/TrafficJunction-v0" }\n')
    assert mapek("run", config, "--engine", "python", "-v", "--out", "out", *QUIETLY).code == 0
    config.unlink()
    Path("out", "result.json").unlink()
    outcome = mapek("resume", "out", "-q")

    assert outcome.code == 0
    assert outcome.err == "run: nothing is compiled, because the engine is python\n"
    assert Path("out", "result.json").exists()


def test_reproduce_without_statistics_runs_the_same_trials(mapek: Mapek) -> None:
    said = [
        mapek("reproduce", "jump", "--trials", 2, "--set", "episodes=30", *QUIETLY, "--json", "-", *more).json
        for more in ((), ("--no-statistics",))
    ]
    assert [one["log_sha256"] for one in said] == [said[0]["log_sha256"]] * 2
    whole, bare = (one["agents"]["morphin"] for one in said)
    assert "steps_before" in whole
    assert set(bare) == {"steps"}
