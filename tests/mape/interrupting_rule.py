"""A detector whose rule sends this process the signal of Ctrl-C at one pass, from compiled code too."""

import ctypes
import math
import signal

from knowledge.rows import UNKNOWN
from mape.ports import QuietRule

_raise = ctypes.CDLL(None)["raise"]
_raise.argtypes, _raise.restype = [ctypes.c_int], ctypes.c_int
CTRL_C = int(signal.SIGINT)


def interrupt(state, params, x):
    state[0] += 1.0
    if state[0] == params[0]:
        _raise(CTRL_C)
    return False, math.nan, UNKNOWN


class Interrupting:
    direction, statistic = "unknown", None

    def __init__(self, at):
        self._numbers, self._params = [0.0], (float(at),)

    @property
    def quiet(self):
        return QuietRule(interrupt, self._numbers, self._params)

    def update(self, x):
        return interrupt(self._numbers, self._params, x)[0]

    def reset(self):
        pass

    def state(self):
        return self._numbers[0]

    def restore(self, state):
        self._numbers[0] = state
