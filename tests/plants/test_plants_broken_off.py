"""An episode that a plant breaks off is begun again as often as the config says, under every command, and is told."""

import json
import os
import signal

import pytest
from diaries import EPISODES, LONG, diary, lives, one_by_one, plant, resets
from real_processes import events, last, rows, until, up, write_config
from real_runs import run

pytestmark = pytest.mark.timeout(120)

SHORT = ("--no-figures", "-q")
AT = 7
"""The episode that is broken off."""


def broken(what, step, times, retries, **over):
    return plant(system={"options": {"faults": [[what, AT, step, times]]}, "retries": retries}, **over)


def log_of(folder):
    found = rows(folder / "log.sqlite", "SELECT pass, stage, body FROM records WHERE pass > 0 ORDER BY pass, stage")
    return [(number, stage, json.loads(body)) for number, stage, body in found]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The records of a run over a plant that breaks nothing off."""
    import shutil
    from pathlib import Path

    folder = tmp_path_factory.mktemp("undisturbed")
    shutil.copy(Path(__file__).parent / "pump.py", folder)
    run("run", str(write_config(folder, plant())), "--out", "out", *SHORT, cwd=folder)
    return log_of(folder / "out")


@pytest.mark.parametrize(
    ("command", "step", "times"),
    [("run", 2, 1), ("run", 0, 1), ("run", 3, 2), LONG("up", 2, 1), LONG("up", 0, 1), ("up", 3, 2)],
)
def test_an_episode_that_raises_is_begun_again_by_another_object_and_each_attempt_is_an_event(
    here, undisturbed, command, step, times
):
    config = write_config(here, broken("raise", step, times, times))
    said = run(command, str(config), "--out", "out", *SHORT, cwd=here).stdout
    again = ["closed", "made", "connect", f"reset {AT}"]
    assert [line for line in diary(here) if not line.startswith("raise")] == [
        *one_by_one(1, AT)[:-1], *again * times, *one_by_one(AT + 1, EPISODES)[2:],
    ]  # fmt: skip
    assert [(e.pass_no, "the valve is stuck" in e.text) for e in events(here / "out" / "log.sqlite", "aborted")] == [
        (AT, True)
    ] * times
    result = json.loads((here / "out" / "result.json").read_bytes())
    assert [one["episode"] for one in result["trials"][0]["aborted"]] == [AT] * times
    assert f"episode {AT}" in said
    assert log_of(here / "out") == undisturbed


@pytest.mark.parametrize(("command", "retries"), [("run", 0), LONG("run", 1), LONG("up", 0), ("up", 1)])
def test_a_run_ends_where_no_retry_is_left_and_resume_goes_on_with_that_episode(here, undisturbed, command, retries):
    config = write_config(here, broken("raise", 2, retries + 1, retries))
    said = run(command, str(config), "--out", "out", *SHORT, cwd=here, code=1).stderr
    assert "the valve is stuck" in said
    assert f"system.retries = {retries}" in said
    assert "mapek resume" in said
    assert resets(here) == [*range(1, AT), *[AT] * (retries + 1)]
    log = here / "out" / "log.sqlite"
    assert [event.pass_no for event in events(log, "aborted")] == [AT] * (retries + 1)
    run("resume", "out", cwd=here)
    assert resets(here) == [*range(1, AT), *[AT] * (retries + 2), *range(AT + 1, EPISODES + 1)]
    assert [event.pass_no for event in events(log, "aborted")] == [AT] * (retries + 1)
    assert log_of(here / "out") == undisturbed
    run("replay", "out", "-q", cwd=here)


def test_a_run_that_dies_in_an_episode_goes_on_with_it(here, undisturbed):
    config = write_config(here, broken("die", 2, 1, 0))
    run("run", str(config), "--out", "out", *SHORT, cwd=here, code=9)
    run("resume", "out", cwd=here)
    first, second = lives(here)
    assert first == [*one_by_one(1, AT)[:-1], f"die {AT}"]
    assert second == one_by_one(AT, EPISODES)
    assert [event.pass_no for event in events(here / "out" / "log.sqlite", "aborted")] == [AT]
    assert log_of(here / "out") == undisturbed


@pytest.mark.parametrize("retries", [LONG(1), 2])
def test_an_execute_that_dies_in_an_episode_is_begun_again_as_often_as_the_config_says(here, undisturbed, retries):
    config = write_config(here, broken("die", 2, retries, retries))
    run("up", str(config), "--out", "out", *SHORT, cwd=here)
    assert resets(here) == [*range(1, AT), *[AT] * (retries + 1), *range(AT + 1, EPISODES + 1)]
    assert [event.pass_no for event in events(here / "out" / "log.sqlite", "aborted")] == [AT] * retries
    assert log_of(here / "out") == undisturbed


def test_up_ends_where_execute_dies_once_too_often_in_an_episode_and_resume_goes_on(here, undisturbed):
    config = write_config(here, broken("die", 2, 2, 1))
    said = run("up", str(config), "--out", "out", *SHORT, cwd=here, code=1).stderr
    assert f"episode {AT}" in said
    assert "system.retries = 1" in said
    assert resets(here) == [*range(1, AT), AT, AT]
    run("resume", "out", cwd=here)
    assert resets(here) == [*range(1, AT), *[AT] * 3, *range(AT + 1, EPISODES + 1)]
    assert log_of(here / "out") == undisturbed


WAITS = """
import os
import time

from mape.analyze.changes import Changes


class Waits(Changes):
    def analyze(self, symptom):
        while symptom.pass_no == 8 and not os.path.exists("over"):
            time.sleep(0.01)
        return super().analyze(symptom)
"""


def test_an_execute_that_is_killed_between_two_episodes_has_broken_none_off(here):
    (here / "waits.py").write_text(WAITS)
    config = write_config(here, plant(analyze="waits:Waits"))
    with up(config) as running:
        until(lambda: 8 in resets(here) and last(running.log)[0] == 8, "episode 8, on disk")
        os.kill(running.child("execute"), signal.SIGKILL)
        until(lambda: diary(here).count("made") == 2, "the next life of Execute")
        (here / "over").touch()
        running.result()
    assert events(running.log, "aborted") == []
    assert resets(here) == [*range(1, EPISODES + 1)]


@pytest.mark.parametrize("options", [(), LONG(("--set", "loops=2")), ("--trials", "2")], ids=["one", "loops", "trials"])
def test_a_stopped_run_over_plants_goes_on_with_its_next_episode(here, options):
    config = write_config(here, broken("raise", 1, 1, 0))
    run("run", str(config), "--out", "out", *SHORT, *options, cwd=here, code=1)
    run("resume", "out", cwd=here)
    units = 2 if options else 1
    assert resets(here) == [*range(1, AT), AT, *range(AT, EPISODES + 1)] + [*range(1, EPISODES + 1)] * (units - 1)


def test_compare_over_plants_goes_on_too_and_has_a_log_for_each_agent(here):
    table = broken("raise", 1, 1, 0)
    config = write_config(here, {**table, "agents": {"one": {}, "other": {"plan": {"name": "q_learning"}}}})
    run("compare", str(config), "--out", "out", "--trials", "1", *SHORT, cwd=here, code=1)
    run("resume", "out", cwd=here)
    assert resets(here) == [*range(1, AT), AT, *range(AT, EPISODES + 1), *range(1, EPISODES + 1)]
    assert "log-one.sqlite" in run("replay", "out", cwd=here, code=2).stderr
    run("replay", "out/log-other.sqlite", "-q", cwd=here)
    assert len(resets(here)) == 2 * EPISODES + 1


@pytest.mark.parametrize("command", ["run", LONG("up")])
def test_a_system_that_can_be_driven_again_has_the_same_rule(here, command):
    config = write_config(here, broken("raise", 2, 1, 0, name="Tank"))
    said = run(command, str(config), "--out", "out", *SHORT, cwd=here, code=1).stderr
    assert "system.retries = 0" in said
    assert resets(here) == [*range(1, AT + 1)]
    (here / "raise-7-2.times").unlink()
    (here / "diary").unlink()
    config = write_config(here, broken("raise", 2, 1, 1, name="Tank"))
    said = run(command, str(config), "--out", "again", *SHORT, cwd=here).stdout
    assert resets(here) == [*range(1, AT + 1), *range(AT, EPISODES + 1)]
    assert f"episode {AT}: pump:PlantTank-v0 raised OSError: the valve is stuck" in said
    result = json.loads((here / "again" / "result.json").read_bytes())
    assert [one["episode"] for one in result["trials"][0]["aborted"]] == [AT]


@pytest.mark.long
def test_a_planner_that_reads_the_table_reads_it_as_it_was_when_the_run_goes_on(here):
    (here / "reading.py").write_text(
        "from mape.plan.morphin import Morphin\n\n\n"
        "class Reading(Morphin):\n"
        "    def plan(self, request, knowledge):\n"
        "        worth = float(knowledge.q_table().values.max()) if request.pass_no % 3 == 0 else 0.0\n"
        "        return super().plan(request, knowledge)._replace(epsilon=1.0 / (2.0 + abs(worth)))\n"
    )
    shas = []
    for name, times in (("whole", 0), ("broken", 1)):
        config = write_config(here, broken("raise", 2, times, 0, plan="reading:Reading"))
        run("run", str(config), "--out", name, *SHORT, cwd=here, code=times)
        if times:
            run("resume", name, cwd=here)
        shas.append(json.loads((here / name / "result.json").read_bytes())["log_sha256"])
    assert shas[0] == shas[1]


def test_a_traced_run_over_a_plant_keeps_the_steps_of_both_lives(here):
    config = write_config(here, broken("raise", 2, 1, 0))
    run("run", str(config), "--out", "out", "--trace", "4:9", *SHORT, cwd=here, code=1)
    run("resume", "out", cwd=here)
    import numpy as np

    trace = np.load(here / "out" / "trace-plant.npy")
    assert np.unique(trace["episode"]).tolist() == [4, 5, 6, 7, 8, 9]
    assert len(trace) == 18
