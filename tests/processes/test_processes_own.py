"""Parts and systems of the user's own in processes that are killed, hang, or cannot be driven again."""

import json
import os
import re
import signal

import pytest
from real_processes import (
    EXAMPLES,
    end_all,
    endpoint,
    events,
    five,
    hashes,
    last,
    passes,
    records,
    run_here,
    serve,
    store,
    until,
    up,
    write_config,
)
from real_runs import run

from knowledge import Observation, from_json

OWN = '''
import os
import time
from pathlib import Path

import gymnasium
from gymnasium import spaces

from mape.plan.morphin import Morphin


class Counter(gymnasium.Env):
    """A plant: a counter that goes on from episode to episode, and that no reset brings back."""

    observation_space = spaces.Discrete(7)
    action_space = spaces.Discrete(3)
    redrivable = False

    def __init__(self, render_mode=None):
        self.turned = int.from_bytes(os.urandom(2), "little")

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 5
        return self.turned % 7, {}

    def step(self, action):
        self.turned += int(action) + 1
        self.left -= 1
        return self.turned % 7, (self.turned % 9973) / 1000.0, self.left == 0, False, {}


class Claims(Counter):
    redrivable = True


class Held(Counter):
    """Stands still in the middle of each episode but the first of its life, for as long as there is a file."""

    episode = 0

    def reset(self, **options):
        self.episode += 1
        return super().reset(**options)

    def step(self, action):
        while self.left == 3 and self.episode > 1 and Path("hold").exists():
            time.sleep(0.005)
        return super().step(action)


class Tells(Counter):
    """Says, to who looks at a file, which episode of its life has begun."""

    episode = 0

    def reset(self, **options):
        self.episode += 1
        Path("told").write_text(str(self.episode))
        Path("told").replace("driven")
        return super().reset(**options)


for name in ("Counter", "Claims", "Held", "Tells"):
    gymnasium.register(f"{name}-v0", entry_point=f"own_parts:{name}", max_episode_steps=5)


class Hangs(Morphin):
    """Its first life ends in a pass that never does."""

    def plan(self, request, knowledge):
        if request.pass_no == 70 and os.environ.get("MAY_HANG"):
            try:
                Path("hung").touch(exist_ok=False)
                while True:
                    pass
            except FileExistsError:
                pass
        return super().plan(request, knowledge)


class Reads(Morphin):
    """Plans by what Knowledge holds: Q, returns, finished passes, actions; adopts later what it remembered."""

    remembered = None

    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        number = request.pass_no
        if number % 3 == 0:
            best = float(knowledge.q_table().values.max())
            late = knowledge.history("return")[-10:]
            known = len(knowledge.actions)
            window = list(knowledge.log.window)
            seen = sum(past.plan.epsilon for past in window[-5:]) + len(window)
            plan = plan._replace(epsilon=abs(best + sum(late) + known + seen) % 1.0)
        if number == 40:
            self.remembered = knowledge.remember(knowledge.q_table())
        if number == 150:
            plan = plan._replace(adopt=self.remembered)
        return plan

    def state(self):
        return [super().state(), self.remembered]

    def restore(self, state):
        super().restore(state[0])
        self.remembered = state[1]
'''


@pytest.fixture
def own(here):
    (here / "own_parts.py").write_text(OWN)
    return here


def plant(folder, name, episodes):
    return write_config(
        folder, {"name": "plant", "episodes": episodes, "system": {"id": f"own_parts:{name}-v0", "retries": 1}}
    )


def gridworld(folder, episodes):
    table = {"name": "grid", "episodes": episodes, "extends": str(EXAMPLES / "gridworld_goals.toml")}
    return write_config(folder, table | {"system": {"options": {"switch_at": [101]}}})


def body(log, number, stage):
    with store(log) as opened:
        return opened.body(0, number, stage)


def in_the_middle_of(log):
    """The episode that was begun and is not reported yet, if there is one."""
    if passes(log) < 0:
        return 0
    with store(log) as opened:
        begun = opened.facts().get("begun", {}).get("0", 0)
        return begun if begun == opened.last(0)[0] + 1 else 0


def q_table(log, number):
    """Q at the end of an episode, if Knowledge has just that."""
    with store(log) as opened:
        found = opened.snapshot(0, "execute")
        return found.table if found is not None and found.pass_no == number else None


def test_what_cannot_be_driven_again_goes_on_with_the_q_table_of_the_last_observation(own):
    config = plant(own, "Held", 30)
    hold = own / "hold"
    hold.touch()
    with up(config) as running:
        aborted, changes = [], {}
        for number in (2, 3, 4):
            until(lambda n=number: in_the_middle_of(running.log) == n, "an episode")
            before = until(lambda n=number: q_table(running.log, n - 1), "the state before")
            os.kill(running.child("execute"), signal.SIGKILL)
            after = until(lambda n=number: q_table(running.log, n), "the episode's end")
            aborted.append(number)
            changes[number] = abs(after.values - before.values).max()
        hold.unlink()
        running.result()
    assert [event.pass_no for event in events(running.log, "aborted")] == aborted
    assert {n: from_json(body(running.log, n, 0)).signals["q_change"] for n in aborted} == changes
    assert records(running.log) == {0: 4 * 30 + 1}
    assert events(running.log, "refused") == []
    said = run("log", "up", "--events", cwd=own).stdout
    assert said.count("broken off") == len(aborted)
    # Monitor, Analyze and Plan of the same observations say the same again.
    assert "no difference" in run("replay", "up", "-q", cwd=own).stdout


def test_a_system_that_wrongly_says_it_can_be_driven_again_is_found_out(own):
    config = plant(own, "Claims", 3000)
    with up(config, "--snapshot-every", "1000") as running:  # all before is driven again
        running.wait_for_pass(60)
        before = body(running.log, 60, 0)
        os.kill(running.child("execute"), signal.SIGKILL)
        said = running.process.end(1)
        after = body(running.log, 60, 0)
    assert before == after
    assert isinstance(from_json(before), Observation)
    assert "differs from the one in the log" in said
    assert "redrivable" in said
    conflicts = events(running.log, "refused")
    assert conflicts
    assert all("Observation" in event.text for event in conflicts)


@pytest.mark.long
def test_a_handler_that_hangs_is_killed_and_done_again(own, monkeypatch):
    config = gridworld(own, 150)
    options = ("--set", "plan.name=own_parts:Hangs")
    monkeypatch.setenv("MAY_HANG", "yes")
    with up(config, *options, "--hang-after", "3") as running:
        result = running.result()
        said = running.process.said
    assert (own / "hung").exists()
    # On a machine that stood still for a moment, others may have been taken for hung beside it.
    assert re.search(r"^plan \(process \d+\) was silent for", said.replace("mapek: ", ""), re.MULTILINE)
    assert re.search(r"^restarts: .*\bplan [1-9]", said, re.MULTILINE)
    monkeypatch.delenv("MAY_HANG")
    assert hashes(result) == hashes(run_here(config, *options))


@pytest.mark.long
def test_a_planner_that_reads_knowledge_sees_the_same_in_five_processes(own, walk):
    config = gridworld(own, 200)
    options = ("--set", "plan.name=own_parts:Reads", "--set", f"analyze.name={walk.part}")
    with up(config, *options, "--snapshot-every", "30") as running:
        for role, moment in (("plan", 35), ("execute", 65), ("plan", 100), ("execute", 155)):
            running.wait_for_pass(moment)
            os.kill(running.child(role), signal.SIGKILL)
        walk.over()
        result = running.result()
    assert hashes(result) == hashes(run_here(config, *options))
    assert records(running.log) == {0: 4 * 200 + 1}
    assert events(running.log, "refused") == []
    replayed = run("replay", "up", "-q", cwd=own)
    assert "no difference" in replayed.stdout


@pytest.mark.long
def test_a_plant_that_runs_freely_does_not_wait_for_knowledge(own):
    """What it began is noted as it goes; nothing of that is waited for."""
    table = json.loads(plant(own, "Tells", 700).read_text())
    config = write_config(own, table | {"execute": {"mode": "free", "rate": 100.0, "backlog": 2000}})
    where, log = endpoint(own), own / "served" / "log.sqlite"
    with five(config, where) as served:
        until(lambda: passes(log) > 50, "a run that is on its way")
        served["knowledge"].signalled(signal.SIGKILL)
        reached = last(log)[0]
        until(lambda: int((own / "driven").read_text()) > reached + 100, "a plant that goes on")
        with serve(config, "knowledge", where) as again:
            end_all(served | {"knowledge": again})
    assert last(log)[0] == 700
    with store(log) as opened:
        assert opened.dropped(0) == []
