"""Parts and a system with rules of their own, each of which can be told to do something odd at one pass.

What goes wrong is a number among the rule's params, so that all of it is one compiled function.
"""

import math
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from mape_runs import Corridor

from knowledge import ChangePlan, ChangeRequest, Drift
from knowledge.rows import DIRECTIONS, UNKNOWN, UP
from managed_systems.rules import ALWAYS, available
from mape.execute.rules import QLearning
from mape.monitor.page_hinkley import PageHinkley
from mape.plan.exponential import Exponential
from mape.plan.morphin import Morphin
from mape.ports import QuietRule
from mape.stretch.quiet import quiet_by

NOTHING, RAISES, INFINITE, NONE, ALARMS, NO_SIDE = range(6)
"""What a `Watch` does at its pass."""


def watch(state, params, x):
    state[0] += 1.0
    state[1] += (x - state[1]) / state[0]
    statistic, alarm, direction = abs(x - state[1]), False, UP if x > state[1] else UNKNOWN
    if state[0] == params[0]:
        if params[1] == RAISES:
            raise ValueError("the watch has stopped")
        if params[1] == INFINITE:
            statistic = math.inf
        if params[1] == NONE:
            statistic = math.nan
        if params[1] == NO_SIDE:
            direction = 0
        alarm = params[1] == ALARMS
    state[2] = statistic
    state[3] = float(direction)
    return alarm, statistic, direction


class Watch:
    """Keeps the mean of its signal in a list that `restore` and `reset` make anew."""

    def __init__(self, at=0, does=NOTHING):
        self._params = (float(at), float(does))
        self.reset()

    @property
    def quiet(self):
        return QuietRule(watch, self._numbers, self._params)

    @property
    def statistic(self):
        return None if math.isnan(self._numbers[2]) else self._numbers[2]

    @property
    def direction(self):
        return next((side for side, code in DIRECTIONS.items() if code == self._numbers[3]), "nowhere")

    def update(self, x):
        return watch(self._numbers, self._params, x)[0]

    def reset(self):
        self._numbers = [0.0, 0.0, math.nan, float(UNKNOWN)]

    def state(self):
        return [None if math.isnan(number) else number for number in self._numbers]

    def restore(self, state):
        self._numbers = [math.nan if number is None else number for number in state]


class Longer:
    """Has one number more, or one less, after each reset and `restore`; its statistic says how many it has."""

    direction = "unknown"

    def __init__(self, every=4):
        self._every = float(every)
        self._numbers = [0.0]

    @property
    def quiet(self):
        return QuietRule(count_long, self._numbers, (self._every,) * len(self._numbers))

    @property
    def statistic(self):
        return float(len(self._numbers))

    def update(self, x):
        return count_long(self._numbers, self.quiet.params, x)[0]

    def reset(self):
        self._numbers = [0.0] * (1 + len(self._numbers) % 3)

    def state(self):
        return list(self._numbers)

    def restore(self, state):
        self._numbers = list(state)


def count_long(state, params, x):
    state[-1] += 1.0
    return state[len(state) - 1] > params[len(params) - 1], float(len(state)), UNKNOWN


class Wavering(Longer):
    """Declares a rule before its first reset, and none after it."""

    @property
    def quiet(self):
        return QuietRule(count_long, self._numbers, (self._every,)) if len(self._numbers) == 1 else None

    def update(self, x):
        return count_long(self._numbers, (self._every,), x)[0]


def allocates(state, params, x):
    newer = np.array([x, params[0]])
    return newer.sum() > 1e9, newer[0], UNKNOWN


class Allocating(Watch):
    """Its rule makes an array."""

    @property
    def quiet(self):
        return QuietRule(allocates, self._numbers, self._params)

    def update(self, x):
        return bool(allocates(self._numbers, self._params, x)[0])


class Jumpy(PageHinkley):
    """Page-Hinkley that alarms at every seventh value, too; what it inherits of a rule is not its own."""

    seen = 0

    def update(self, x):
        self.seen += 1
        return super().update(x) or self.seen % 7 == 0


class Gentle(Morphin):
    """Morphin that explores in at most half of the steps."""

    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        return plan._replace(epsilon=min(plan.epsilon, 0.5))


class Halved(Exponential):
    """The exponential schedule at half of its rate."""

    @property
    def epsilon(self):
        return super().epsilon / 2.0


def headstrong(state, params, signals):
    state[0] += 1.0
    if state[0] == params[0]:
        if params[1] > 2.0:
            raise ValueError("no plan comes to mind")
        return params[1]
    return 0.5 + 0.25 * math.sin(state[0] + signals[1])


class Headstrong:
    """Explores by a rule of its own, at pass `at` at the rate `epsilon`; beyond 2 it raises there instead.

    Unless it `follows`, it leaves the actions of the Q-table as they are.
    """

    def __init__(self, at=0, epsilon=0.5, follows=True):
        self._numbers, self._params, self._follows = [0.0], (float(at), float(epsilon)), follows

    @property
    def quiet(self):
        return QuietRule(headstrong, self._numbers, self._params)

    def start(self, loop):
        return ChangePlan(loop, 0, 1.0, (0.1, 0.9, 5.0), (), (), (), False, None)

    def plan(self, request, knowledge):
        epsilon = headstrong(self._numbers, self._params, list(request.signals.values()))
        add, drop = (request.added, request.removed) if self._follows else ((), ())
        return ChangePlan(request.loop, request.pass_no, epsilon, (0.1, 0.9, 5.0), add, drop, (), False, None)

    def state(self):
        return list(self._numbers)

    def restore(self, state):
        self._numbers = list(state)


def fussy(state, params, signals):
    state[0] = 0.5 * state[0] + signals[1]
    state[1] += 1.0
    return state[1] == params[0] or signals[0] > params[1]


class Fussy:
    """Takes each pass of a return above `most`, and that of number `at`, for a rise of the return."""

    def __init__(self, at=0, most=1e9):
        self._numbers, self._params = [0.0, 0.0], (float(at), float(most))

    @property
    def quiet(self):
        return QuietRule(fussy, self._numbers, self._params)

    def analyze(self, symptom):
        loop, number, signals, available, known, readings = symptom
        changed = fussy(self._numbers, self._params, list(signals.values()))
        drifts = (Drift("return", "up"),) if changed or any(reading.alarm for reading in readings) else ()
        added = tuple(action for action in available if action not in known)
        removed = tuple(action for action in known if action not in available)
        return ChangeRequest(loop, number, drifts, added, removed, signals)

    def state(self):
        return list(self._numbers)

    def restore(self, state):
        self._numbers[:] = state


class Nostalgic(Morphin):
    """Morphin that on each drift remembers the Q-table, and takes up the one that it remembered before."""

    remembered = None

    @property
    def quiet(self):
        return quiet_by(self.schedule)

    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        if not request.drifts:
            return plan
        before, self.remembered = self.remembered, knowledge.remember(knowledge.q_table())
        return plan if before is None else plan._replace(adopt=before)

    def state(self):
        return {**super().state(), "remembered": self.remembered}

    def restore(self, state):
        super().restore(state)
        self.remembered = state["remembered"]


def stumbling(td_error, rate):
    if abs(td_error) > 9.5:
        raise ValueError("too great a step")
    return math.nan if abs(td_error) > 6.5 else rate[0]


class Stumbling(QLearning):
    """Has no learning rate for TD errors above 6.5, and raises over those above 9.5."""

    step_size = staticmethod(stumbling)


SOUND, REWARD_NAN, REWARD_INFINITE, TOO_FAR, BELOW, BREAKS, RESET_BREAKS, STARTS_OUTSIDE, SIGNAL_INFINITE = range(9)
"""What a `Ruled` system does wrong in its episode."""


class RuledParams(NamedTuple):
    cells: int
    at: int
    does: int
    reward: float
    goals: tuple[float, float]


def phase(params, episode):
    return episode


def reset(params, phase, draws, at):
    if phase == params.at:
        if params.does == RESET_BREAKS:
            raise ValueError("the door is shut")
        if params.does == STARTS_OUTSIDE:
            return params.cells
    return int(draws[at] * (params.cells - 1))


def step(params, phase, state, action, draws, at, context):
    reward, landed = params.reward, max(state - 1, 0)
    if action % 2 == 1 or draws[at] < 0.1:
        landed = state + 1
    ended = landed == params.cells - 1
    if ended:
        reward = params.goals[phase % 2]
    context[0] += landed
    if phase == params.at and draws[at] < 0.6:
        if params.does == REWARD_NAN:
            reward = math.nan
        if params.does == REWARD_INFINITE:
            reward = -math.inf
        if params.does == TOO_FAR:
            landed = params.cells + 2
        if params.does == BELOW:
            landed = -1
        if params.does == BREAKS:
            raise ValueError("the wheel came off")
        if params.does == SIGNAL_INFINITE:
            context[0] += math.inf
    return landed, reward, ended


def explorable(params, phase, state, action):
    return (state + action) % 5 != 0


class Ruled(Corridor):
    """A corridor by rules, with a wind, an own signal, and actions of any numbers that come and go.

    Parameters
    ----------
    at, does
        The episode in which it does something wrong, and what.
    reward, goals
        Reward of a step, and of the last one in even and odd episodes.
    windows
        Action -> first and last episode in which it is offered.
    cells, max_steps
        Length of the corridor and of an episode.
    """

    name = "ruled"
    draws = (1, 1)

    def __init__(self, at=0, does=SOUND, *, reward=-1.0, goals=(10.0, 10.0), windows=None, cells=6, max_steps=12):
        super().__init__(signal_names=("cell",))
        windows = {0: (1, ALWAYS), 1: (1, ALWAYS)} if windows is None else windows
        self.n_states, self.max_steps = cells, max_steps
        self.rules = SimpleNamespace(
            params=RuledParams(cells, at, does, float(reward), tuple(map(float, goals))),
            phase=phase,
            reset=reset,
            step=step,
            explorable=explorable,
            windows=np.array([windows.get(action, (ALWAYS, ALWAYS)) for action in range(max(windows) + 1)], np.int64),
            reset_draws=1,
            step_draws=1,
        )
        self._offered = ()

    def available(self, episode):
        found = available(self.rules.windows, episode)
        self._offered = self._offered if found == self._offered else found
        return self._offered

    def begin(self, episode):
        rules = self.rules
        self._number, self._uniforms, self._at = rules.phase(rules.params, episode.number), episode.uniforms.copy(), 1
        self._cell = rules.reset(rules.params, self._number, self._uniforms, 0)
        return self._cell, self.available(episode.number)

    def step(self, action, context):
        rules = self.rules
        landed, reward, ended = rules.step(
            rules.params, self._number, self._cell, action, self._uniforms, self._at, context
        )
        self._cell, self._at = landed, self._at + 1
        return landed, reward, ended, False

    def explorable(self, action):
        return self.rules.explorable(self.rules.params, self._number, self._cell, action)

    def enable(self, actions):
        self.rules.windows[list(actions), 0] = 1

    def set_state(self, state):
        raise ValueError(f"a corridor carries nothing, and takes no {state}")
