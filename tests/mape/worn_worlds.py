"""Environments that carry something from one reset to the next, each in another place, and one that carries nothing."""

import itertools
from collections import deque
from types import SimpleNamespace

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete
from gymnasium.wrappers import NormalizeReward, RecordEpisodeStatistics

WEARS_AT = 30
"""Resets after which the rewards fall."""


class Fresh(gymnasium.Env):
    """Three steps of chance, and a reward that falls when it is worn."""

    observation_space, action_space = Discrete(3), Discrete(2)

    def __init__(self, render_mode=None):
        super().__init__()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count_it()
        self.worn = self.resets(options["episode"]) > WEARS_AT
        self.left = 3
        return int(self.np_random.integers(3)), {}

    def step(self, action):
        self.left -= 1
        reward = float(self.np_random.integers(4)) + action - 5.0 * self.worn
        return int(self.np_random.integers(3)), reward, self.left == 0, False, {}

    def count_it(self):
        pass

    def resets(self, episode):
        return episode


class Attribute(Fresh):
    total = 0

    def count_it(self):
        self.total += 1

    def resets(self, episode):
        return self.total


class Object(Fresh):
    def __init__(self, render_mode=None):
        super().__init__()
        self.motor = SimpleNamespace(parts=[{"turns": 0}])

    def count_it(self):
        self.motor.parts[0]["turns"] += 1

    def resets(self, episode):
        return self.motor.parts[0]["turns"]


class Queue(Fresh):
    def __init__(self, render_mode=None):
        super().__init__()
        self.history = deque()

    def count_it(self):
        self.history.append(None)

    def resets(self, episode):
        return len(self.history)


def counter():
    turns = 0

    def turn():
        nonlocal turns
        turns += 1
        return turns

    return turn


class Closure(Fresh):
    def __init__(self, render_mode=None):
        super().__init__()
        self.turn = counter()

    def resets(self, episode):
        return self.turn()


class Iterator(Fresh):
    def __init__(self, render_mode=None):
        super().__init__()
        self.numbers = itertools.count(1)

    def resets(self, episode):
        return next(self.numbers)


class Generator(Fresh):
    """Its luck is a generator of its own, which no reset seeds."""

    def __init__(self, render_mode=None):
        super().__init__()
        self.luck = np.random.default_rng(5)

    def resets(self, episode):
        return WEARS_AT * 2 * self.luck.random()


class Slots(Fresh):
    __slots__ = ("turns",)

    def __init__(self, render_mode=None):
        super().__init__()
        self.turns = 0

    def resets(self, episode):
        self.turns += 1
        return self.turns


class Class(Fresh):
    """Counts in its class: all that a process makes wear together."""

    turns = 0

    def resets(self, episode):
        Class.turns += 1
        return Class.turns


MODULE = {"turns": 0}


class Module(Fresh):
    def resets(self, episode):
        MODULE["turns"] += 1
        return MODULE["turns"]


class Said(Attribute):
    """Carries, and says so."""

    def get_state(self):
        return self.total

    def set_state(self, state):
        self.total = state


def normalised(render_mode=None):
    return NormalizeReward(Fresh())


def watched(render_mode=None):
    return RecordEpisodeStatistics(Fresh())


CARRIES = {
    "Attribute": "total",
    "Object": "motor",
    "Queue": "history",
    "Closure": "turn",
    "Iterator": "numbers",
    "Generator": "luck",
    "Slots": "turns",
    "Normalised": "NormalizeReward.return_rms",
}
"""What of each is carried, by the name that is told."""

_MADE = {one.__name__: one for one in (Fresh, Attribute, Object, Queue, Closure, Iterator, Generator, Slots, Said)}
for _name, _maker in {**_MADE, "Class": Class, "Module": Module, "Normalised": normalised, "Watched": watched}.items():
    if f"{_name}-v0" not in gymnasium.registry:
        gymnasium.register(f"{_name}-v0", _maker, max_episode_steps=3)
