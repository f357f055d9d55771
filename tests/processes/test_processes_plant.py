"""What a managed system notices of its process: each is closed once, and none is reset for an episode that is over."""

import os
import signal
from collections import UserList

import gymnasium
import pytest
from gymnasium import spaces
from real_processes import events, until, up, write_config
from roles_on_threads import Paced, Roles

from adapters.processes import execute_role
from adapters.processes.roles import make_role
from mape.config import from_table, merge
from mape.errors import BusError, ConfigError, ManagedSystemError


class Plant(gymnasium.Env):
    """Writes down what is done to it."""

    observation_space, action_space = spaces.Discrete(5), spaces.Discrete(2)
    redrivable = False
    done: UserList[str | int] = UserList()  # noqa: RUF012 - no data of the class, which would be looked at as carried
    open: UserList["Plant"] = UserList()  # noqa: RUF012
    fails_at = 0
    turned = 0

    def __init__(self, render_mode=None):
        self.open.append(self)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 3
        self.done.append(options["episode"])
        if options["episode"] == self.fails_at:
            raise OSError("the valve is stuck")
        return Plant.turned % 5, {}

    def step(self, action):
        Plant.turned += int(action) + 1
        self.left -= 1
        return Plant.turned % 5, float(Plant.turned % 7), self.left == 0, False, {}

    def close(self):
        self.open.remove(self)  # twice, and it raises
        self.done.append("closed")


class Redrivable(Plant):
    redrivable = True

    def step(self, action):
        self.left -= 1
        return self.left, 1.0, self.left == 0, False, {}


gymnasium.register("Pump-v0", Plant, max_episode_steps=3)
gymnasium.register("Redrivable-v0", Redrivable, max_episode_steps=3)


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    monkeypatch.setattr(Plant, "done", UserList())
    monkeypatch.setattr(Plant, "open", UserList())
    monkeypatch.setattr(Plant, "turned", 0)


def plant(episodes, name="Pump", **over):
    table = {
        "episodes": episodes,
        "system": {"id": f"{name}-v0"},
        "analyze": "roles_on_threads:Paced",
        "execute": {"engine": "python"},
    }
    return from_table(merge(table, over))


FREE = {"execute": {"mode": "free", "rate": 100.0}}


@pytest.mark.parametrize("over", [{}, FREE, {"loops": 3}], ids=["lockstep", "free", "loops"])
def test_every_system_is_closed_once_when_the_run_is_over(here, over):
    with Roles(plant(6, **over), here) as run:
        Paced.free.set()
        run.start_all()
        run.join()
        assert Plant.open == []
        assert Plant.done.count("closed") == over.get("loops", 1)
        assert Plant.done[-1] == "closed"


@pytest.mark.parametrize("over", [{}, FREE], ids=["lockstep", "free"])
def test_a_system_is_closed_when_its_process_is_ended_or_fails(here, over, monkeypatch):
    with Roles(plant(5000, **over), here) as run:
        run.start_all()
        run.wait_for_pass(3)
        run.end("execute")
        assert Plant.open == []
        monkeypatch.setattr(Plant, "fails_at", max(number for number in Plant.done if number != "closed") + 4)
        run.start("execute")
        run.threads[-1].join(60)
        (error,) = run.failed
        assert isinstance(error, ManagedSystemError)
        assert "the valve is stuck" in str(error)
        assert Plant.open == []


def test_a_system_is_closed_where_execute_cannot_be_made_of_it():
    def no_member(layout):
        raise BusError("there is no link")

    with pytest.raises(BusError, match="no link"):
        make_role("execute", plant(5), no_member)
    assert Plant.open == []
    watching = plant(5, monitor={"detectors": [{"name": "page_hinkley", "signal": "noise"}]})
    with pytest.raises(ConfigError, match="watches signal 'noise'"):
        make_role("execute", watching, no_member)
    assert (Plant.open, Plant.done) == ([], ["closed", "closed"])


@pytest.mark.parametrize("over", [{}, FREE], ids=["lockstep", "free"])
def test_a_plant_is_reset_for_no_episode_that_is_over_however_often_execute_starts_again(here, over, monkeypatch):
    monkeypatch.setattr(execute_role, "SETTLES_WITHIN", 60.0)
    with Roles(plant(40, **over), here) as run:
        run.start_all()
        for moment in (5, 11, 20):
            run.wait_for_pass(moment)
            run.again("execute")
        Paced.free.set()
        run.join()
    resets = [number for number in Plant.done if number != "closed"]
    assert resets == list(range(1, 41))
    assert events(run.path, "refused") == []


def test_a_system_that_can_be_driven_again_is_so_from_the_last_state_on_and_not_from_episode_1(here):
    with Roles(plant(40, "Redrivable"), here, snapshot_every=10) as run:
        run.start_all()
        run.wait_for_pass(25)
        before = len(Plant.done)
        run.again("execute")
        Paced.free.set()
        run.join()
    after = Plant.done[before:]
    again = [number for number in after[after.index("closed") + 1 :] if number != "closed"]
    # The first reset is that of the state's own episode: what it leaves is held against what the state tells.
    assert again == list(range(again[0], 41))
    assert again[0] % 10 == 0
    assert again[0] > 1


OWN = '''
import os

import gymnasium
from gymnasium import spaces


class Diary(gymnasium.Env):
    """A plant that keeps a diary, the last line of which it writes when it is closed."""

    observation_space, action_space = spaces.Discrete(5), spaces.Discrete(2)
    redrivable = False

    def __init__(self, render_mode=None):
        self.turned = 0

    def _write(self, line):
        with open("diary", "a") as diary:
            print(os.getpid(), line, file=diary)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 3
        self._write(options["episode"])
        return self.turned % 5, {}

    def step(self, action):
        self.turned += int(action) + 1
        self.left -= 1
        return self.turned % 5, float(self.turned % 7), self.left == 0, False, {}

    def close(self):
        self._write("closed")


gymnasium.register("Diary-v0", Diary, max_episode_steps=3)
'''


def test_a_killed_plant_goes_on_with_the_episode_in_hand_and_is_closed_at_the_end(here, walk):
    (here / "own_parts.py").write_text(OWN)
    system = {"id": "own_parts:Diary-v0", "retries": 2}
    table = {"name": "plant", "episodes": 200, "system": system, "analyze": walk.part}
    config = write_config(here, table)
    with up(config) as running:
        for moment in (8, 20):
            running.wait_for_pass(moment)
            os.kill(running.child("execute"), signal.SIGKILL)
            until(lambda m=moment: running.passes() > m + 3, "the next life of Execute")
        walk.over()
        running.result()
    lines = [line.split() for line in (here / "diary").read_text().splitlines()]
    *resets, last = [done for _, done in lines]
    assert last == "closed"
    numbers = [int(number) for number in resets]
    assert set(numbers) == set(range(1, 201))
    assert numbers == sorted(numbers)  # those that were broken off are there twice
    assert numbers.count(1) == 1
