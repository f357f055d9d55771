"""A plant that keeps a diary of all that is done to it, by whatever process, in the file `diary`."""

import fcntl
import os
import time

import gymnasium
from gymnasium import spaces


def write(line):
    with open("diary", "a") as diary:
        fcntl.flock(diary, fcntl.LOCK_EX)
        print(os.getpid(), line, file=diary, flush=True)


def once_more(name, most):
    """Whether this has happened fewer than `most` times, in any process; it then has happened once more."""
    with open(f"{name}.times", "a+") as times:
        fcntl.flock(times, fcntl.LOCK_EX)
        times.seek(0)
        if len(times.read()) >= most:
            return False
        times.write("x")
        return True


class Pump(gymnasium.Env):
    """Turns a wheel that nobody can turn back; `faults` are (what, episode, step, how often)."""

    observation_space, action_space = spaces.Discrete(5), spaces.Discrete(2)
    redrivable = False

    def __init__(self, faults=(), state=True, render_mode=None):
        self.faults, self.turned, self.episode, self.connected = faults, 0, 0, False
        if not state:
            self.get_state = self.set_state = None
        write("made")

    def connect(self):
        write("connect")
        self.connected = True

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        assert self.connected or self.redrivable
        self.episode, self.steps = (options or {}).get("episode", 0), 0
        write(f"reset {self.episode}")
        self._fail()
        return self.turned % 5, {}

    def step(self, action):
        self.steps += 1
        self._fail()
        self.turned += int(action) + 1
        return self.turned % 5, float(self.turned % 7), self.steps == 3, False, {}

    def _fail(self):
        for what, episode, step, most in self.faults:
            if (episode, step) == (self.episode, self.steps) and once_more(f"{what}-{episode}-{step}", most):
                write(f"{what} {episode}")
                if what == "raise":
                    raise OSError("the valve is stuck")
                if what == "die":
                    os._exit(9)
                while what == "hang":
                    time.sleep(0.05)

    def get_state(self):
        assert self.connected or self.redrivable
        return {"turned": self.turned}

    def set_state(self, state):
        assert self.connected or self.redrivable
        self.turned = state["turned"]

    def close(self):
        write("closed")


class Tank(Pump):
    """The same, and its episodes can be driven again."""

    redrivable = True

    def reset(self, *, seed=None, options=None):
        self.turned = 0
        return super().reset(seed=seed, options=options)


gymnasium.register("PlantPump-v0", Pump, max_episode_steps=3)
gymnasium.register("PlantTank-v0", Tank, max_episode_steps=3)
