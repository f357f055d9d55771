"""Configs, small managed systems and runs that the tests of this folder share."""

from adapters.systems import make_system
from mape.config import from_table
from mape.loop import Loop
from mape.tables import merge

GRID = {
    "name": "grid",
    "episodes": 10,
    "system": {
        "id": "mapek/Gridworld-v0",
        "options": {"size": [4, 5], "start": [2, 2], "goals": [[0, 0], [3, 4]], "switch_at": [5, 9], "max_steps": 15},
    },
    "monitor": {"detectors": [{"name": "page_hinkley", "threshold": 40.0}]},
}
TRAFFIC = {
    "name": "traffic",
    "episodes": 10,
    "system": {
        "id": "mapek/TrafficJunction-v0",
        "options": {"rates": [[4.0, 2.0], [5.0, 7.0]], "switch_at": [5], "max_steps": 12},
    },
    "monitor": {"detectors": [{"name": "page_hinkley", "threshold": 100.0}]},
    "plan": {"name": "morphin", "enable_on_drift": [3, 4]},
}


def config(base=GRID, **over):
    return from_table(merge(base, over))


def loop_of(chosen, **arguments):
    return Loop(chosen, make_system(chosen.system), **arguments)


def hashes(loop):
    return loop.log.sha256(), loop.execute.q_table.sha256()


class Corridor:
    """Five cells in a row, start in the middle; action 0 goes left, every other one right; the right end is the goal.

    `offers` gives the actions of an episode; `spoil(episode, step)` may raise or return a reward, a state or a signal
    that takes the place of the true one.
    """

    name = "corridor"
    n_states = 5
    max_steps = 12
    drifts = ()
    draws = (0, 0)
    redrivable = True
    rules = None

    def __init__(self, offers=lambda episode: (0, 1), spoil=lambda episode, step: {}, signal_names=()):
        self.signal_names = signal_names
        self._offers = offers
        self._spoil = spoil
        self.begun = []
        self.enabled = ()

    def available(self, episode):
        return None

    def begin(self, episode):
        self.begun.append(episode)
        self._number, self._step, self._cell = episode.number, 0, 2
        offered = self._offers(episode.number)
        return 2, offered + tuple(a for a in self.enabled if a not in offered)

    def step(self, action, context):
        self._step += 1
        self._cell = max(self._cell - 1, 0) if action == 0 else self._cell + 1
        ended = self._cell == 4
        spoilt = self._spoil(self._number, self._step)
        for k in range(len(context)):
            context[k] += spoilt.get("signal", float(self._cell))
        return spoilt.get("state", self._cell), spoilt.get("reward", 10.0 if ended else -1.0), ended, False

    def explorable(self, action):
        return True

    def enable(self, actions):
        self.enabled += tuple(actions)

    def get_state(self):
        return None

    def set_state(self, state):
        raise ValueError(f"a corridor carries nothing, and takes no {state}")

    def close(self):
        pass


class Carrying(Corridor):
    """Its reward grows from episode to episode."""

    played = 0

    def begin(self, episode):
        self.played += 1
        return super().begin(episode)

    def step(self, action, context):
        state, _, ended, truncated = super().step(action, context)
        return state, float(self.played), ended, truncated


class Standing(Corridor):
    """Never leaves its state; rewards are high, then low, so that its values rise and fall within an episode."""

    def step(self, action, context):
        self._step += 1
        spoilt = self._spoil(self._number, self._step)
        return 2, spoilt.get("reward", 50.0 if self._step <= 6 else -50.0), False, False


def corridor_loop(corridor=None, **over):
    table = {"name": "corridor", "episodes": 10, "system": {"id": "corridor"}, "plan": {"name": "morphin"}}
    return Loop(from_table(merge(table, over)), Corridor() if corridor is None else corridor)
