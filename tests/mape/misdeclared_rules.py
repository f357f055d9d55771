"""Rules that Numba does not compile, each in another way, and parts that declare what is no rule."""

import functools
import math

import numba

from knowledge.rows import UNKNOWN
from mape.execute.rules import QLearning
from mape.plan.exponential import Exponential, exponential_next
from mape.ports import QuietRule


def sound(state, params, x):
    state[0] += 1.0
    return False, math.nan, UNKNOWN


def gives_nothing(state, params, x):
    state[0] += 1.0


def names_its_side(state, params, x):
    return False, math.nan, "down"


def takes_too_much(state, params, x, more):
    return False, math.nan, UNKNOWN


def asks_remainder(state, params, x):
    return False, math.fmod(x, 2.0), UNKNOWN


def writes_beyond(state, params, x):
    state[7] = x
    return False, math.nan, UNKNOWN


def reads_beyond(state, params, x):
    return False, params[len(params)], UNKNOWN


def writes_beyond_for_nothing(state, params, x):
    state[0 if x else 7] = x
    return False, math.nan, UNKNOWN


def divides(state, params, x):
    state[0] = 1.0 / (x * (x - 1.0))
    return False, math.nan, UNKNOWN


@numba.njit
def is_long(numbers):
    return len(numbers) > 9


def asks_what_is_compiled(state, params, x):
    return is_long(state), math.nan, UNKNOWN


FUNCTIONS = {
    "writes_beyond": writes_beyond,
    "reads_beyond": reads_beyond,
    "writes_beyond_for_nothing": writes_beyond_for_nothing,
    "divides": divides,
    "asks_what_is_compiled": asks_what_is_compiled,
    "sound": sound,
    "gives_nothing": gives_nothing,
    "names_its_side": names_its_side,
    "takes_too_much": takes_too_much,
    "asks_remainder": asks_remainder,
    "partial": functools.partial(takes_too_much, more=1.0),
    "none": None,
    "list": [sound],
}
NUMBERS = {
    "sound": [0.0],
    "text": "0.5",
    "texts": ["0.5"],
    "nested": [(1.0, 2.0)],
    "huge": [10**400],
    "nothing": None,
    "holds nothing": [None],
    "number": 3.0,
}


class Declares:
    """Declares a rule of that function, state and params, the latter two from value number `late` on."""

    direction, statistic = "unknown", None

    def __init__(self, function="sound", state="sound", params="sound", late=0):
        self._function, self._state, self._params, self._late = function, state, params, late
        self._seen, self._numbers = 0, [0.0]

    @property
    def quiet(self):
        early = self._seen < self._late
        return QuietRule(
            self.method if self._function == "method" else FUNCTIONS[self._function],
            self._numbers if early or self._state == "sound" else NUMBERS[self._state],
            () if early or self._params == "sound" else NUMBERS[self._params],
        )

    def method(self, state, params, x):
        return False, math.nan, UNKNOWN

    def update(self, x):
        self._seen += 1
        return False

    def reset(self):
        pass

    def state(self):
        return self._seen

    def restore(self, state):
        self._seen = state


def goes_nowhere(state, params, episode_return):
    state[0] += 1.0


class Nowhere(Exponential):
    """A schedule whose rule gives no rate."""

    @property
    def quiet(self):
        return QuietRule(goes_nowhere, self._state, self._params)


class Stateless(Exponential):
    """A schedule whose rule has no list of numbers."""

    @property
    def quiet(self):
        return QuietRule(exponential_next, None, self._params)


def worthless(q, rows, count, state, best, epsilon):
    return math.fmod(q[best, state], 1.0)


class Worthless(QLearning):
    """A learner whose worth of a state is none that Numba knows."""

    value = staticmethod(worthless)


def stands(params, phase, state, action, draws, at, context):
    """Stay where the system is, without a reward."""
    return state
