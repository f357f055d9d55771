"""A step that never returns ends its episode, not one that is long; and who waits for it is told for what."""

import json
import os
import signal

import pytest
from diaries import EPISODES, diary, plant, resets
from real_processes import end_all, endpoint, events, five, started, until, up, write_config
from real_runs import run

from adapters.processes import pulse
from adapters.processes.supervise import HUNG, SYSTEM_FAILED
from mape.execute.attempts import Attempts

pytestmark = pytest.mark.timeout(120)

SHORT = ("--no-figures", "-q")
AT = 7


def hangs(times, retries, name="Pump"):
    return plant(name=name, system={"options": {"faults": [["hang", AT, 2, times]]}, "retries": retries})


@pytest.mark.parametrize("name", ["Pump", pytest.param("Tank", marks=pytest.mark.long)])
def test_an_episode_whose_step_hangs_is_begun_again_as_often_as_the_config_says(here, name):
    config = write_config(here, hangs(1, 1, name))
    with up(config, "--hang-after", "2") as running:
        result = running.result()
    (event,) = events(running.log, "aborted")
    assert (event.pass_no, "step 2 of episode 7" in event.text) == (AT, True)
    assert resets(here).count(AT) == 2
    assert [number for number in resets(here) if number > AT] == [*range(AT + 1, EPISODES + 1)]
    assert [one["episode"] for one in result["trials"][0]["aborted"]] == [AT]


@pytest.mark.parametrize("name", ["Pump", pytest.param("Tank", marks=pytest.mark.long)])
def test_a_run_ends_where_a_step_hangs_once_too_often_and_resume_goes_on(here, name):
    config = write_config(here, hangs(1, 0, name))
    said = run("up", str(config), "--out", "out", "--hang-after", "1", *SHORT, cwd=here, code=1).stderr
    assert "step 2 of episode 7" in said
    assert "system.retries = 0" in said
    assert resets(here) == [*range(1, AT + 1)]
    run("resume", "out", cwd=here)
    assert resets(here).count(AT) == 2
    assert resets(here)[-1] == EPISODES


@pytest.mark.long
def test_an_execute_that_is_served_by_hand_ends_itself_where_its_step_hangs(here):
    config = write_config(here, hangs(1, 1))
    where = endpoint(here)
    with five(config, where) as served:
        until(lambda: f"hang {AT}" in diary(here), "the step that hangs")
        served["execute"].send(signal.SIGKILL)
        arguments = ("serve", str(config), "--role", "execute", "--connect", where, "--hang-after", "1")
        with started(*arguments, cwd=here, name="again") as again:
            again.end()
        end_all({role: process for role, process in served.items() if role != "execute"})
    assert resets(here) == [*range(1, AT + 1), *range(AT, EPISODES + 1)]


LONG = """
import os
import time

import gymnasium
import pump


class Long(pump.Tank):
    \"\"\"Each of its steps takes a while, and its episodes are longer than anybody waits for a step.\"\"\"

    def step(self, action):
        time.sleep(0.1)
        self.steps += 1
        return self.steps % 5, 1.0, self.steps == 30, False, {}


gymnasium.register("Long-v0", Long, max_episode_steps=30)
"""


@pytest.mark.long
def test_an_execute_whose_episode_is_longer_than_hang_after_is_left_alone(here):
    (here / "long.py").write_text(LONG)
    config = write_config(here, plant(episodes=2, system={"id": "long:Long-v0"}))
    with up(config, "--hang-after", "2.5") as running:
        running.result()
    assert resets(here) == [1, 2]
    assert "restarts" not in running.process.said


class Driven:
    """An Execute as the pulse sees it."""

    def __init__(self, retries):
        self.attempts = Attempts(None, retries)
        self.driving, self.steps = 0, -1


class Link:
    def __init__(self):
        self.beats, self.notes = 0, []

    def beat(self):
        self.beats += 1

    def note(self, *note):
        self.notes.append(note)

    def settle(self):
        self.notes.append("settled")


@pytest.fixture
def watched():
    """A loop, the link of its process, the exit codes with which that would have ended, and the pulse over them."""

    def make(retries=0, hang_after=3.0):
        one, link, codes = Driven(retries), Link(), []
        return one, link, codes, pulse.Pulse(lambda: link, lambda: {0: one}, hang_after, codes.append)

    return make


def test_a_step_is_a_sign_of_life_however_many_an_episode_has(watched):
    one, link, codes, beat = watched()
    one.driving = 4
    for one.steps in range(1000):
        for _ in range(3):
            beat.look(1.0)
    assert (link.beats, codes) == (3000, [])


def test_no_step_for_long_gives_the_episode_up_and_names_it(watched, capsys):
    one, link, codes, beat = watched(retries=1)
    one.driving, one.steps = 4, 17
    for _ in range(4):
        beat.look(1.0)
    assert (link.beats, codes) == (3, [HUNG])
    assert link.notes == [("aborted", "step 18 of episode 4 did not return within 3 s", 0, 4), "settled"]
    one.attempts.failures = 1
    beat.look(1.0)
    assert codes == [HUNG, SYSTEM_FAILED]
    assert "(system.retries = 1)" in capsys.readouterr().err


@pytest.mark.parametrize(("driving", "hang_after"), [(0, 3.0), (4, None)], ids=["waiting", "unasked"])
def test_who_does_not_drive_or_is_not_to_be_ended_is_left_alone(watched, driving, hang_after):
    one, link, codes, beat = watched(hang_after=hang_after)
    one.driving = driving
    for _ in range(100):
        beat.look(1.0)
    assert (link.beats, codes) == (100 if driving else 0, [])


@pytest.mark.parametrize("command", [("run", "--out", "out", *SHORT), ("step", "--from", str(EPISODES))])
def test_a_first_ctrl_c_in_a_step_that_hangs_says_for_what_it_waits_and_a_second_ends_it(here, command):
    config = write_config(here, hangs(1, 0))
    with started(command[0], str(config), *command[1:], cwd=here) as process:
        until(lambda: f"hang {AT}" in diary(here), "the step that hangs")
        process.send(signal.SIGINT)
        until(lambda: "waiting for" in process.said, "what it waits for")
        assert "waiting for pump:PlantPump-v0, in step 2 of episode 7; Ctrl-C again" in process.said
        process.send(signal.SIGINT)
        process.end(130)
    if command[0] == "run":
        run("resume", "out", cwd=here)
        assert resets(here) == [*range(1, AT + 1), *range(AT, EPISODES + 1)]


def test_a_first_ctrl_c_where_a_worker_hangs_says_for_what_it_waits(here):
    config = write_config(here, hangs(2, 0, "Tank"))
    options = ("--trials", "200", "--workers", "2", "--out", "out", *SHORT)
    with started("run", str(config), *options, cwd=here) as process:
        until(lambda: diary(here).count(f"hang {AT}") == 2, "both steps that hang")
        os.killpg(process.pid, signal.SIGINT)
        until(lambda: "in step 2 of episode 7" in process.said, "what this process waits for")
        os.killpg(process.pid, signal.SIGINT)
        until(lambda: "worker process" in process.said, "what the others are at")
        os.killpg(process.pid, signal.SIGINT)
        process.end(130)


@pytest.mark.long
@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.long), signal.SIGTERM])
def test_up_ends_at_once_while_a_step_hangs(here, number):
    config = write_config(here, hangs(1, 0))
    with up(config) as running:
        until(lambda: f"hang {AT}" in diary(here), "the step that hangs")
        running.process.send(number)
        running.process.end(128 + number)
    run("resume", "up", cwd=here)
    assert resets(here) == [*range(1, AT + 1), *range(AT, EPISODES + 1)]
    assert json.loads((here / "up" / "result.json").read_bytes())["trials"][0]["aborted"]
