"""A detector of your own that declares its rule, so that it is compiled: an EWMA chart for a fall of the mean.

    z    <- z + weight * (x - z)
    fall  = (mean - z) / (sd * sqrt(weight / (2 - weight)))
    alarm iff  fall > width

Mean and standard deviation are those of all values since the last reset, of which the first `warm_up` never alarm.
Source: S. W. Roberts, Control Chart Tests Based on Geometric Moving Averages, Technometrics 1 (1959).
"""

import math

from adapters.systems import make_system
from knowledge.rows import DOWN
from mape import load, run_trial
from mape.ports import QuietRule


def ewma(state, params, x):
    weight, width, warm_up = params[0], params[1], params[2]
    n = state[0] + 1.0
    mean = state[1] + (x - state[1]) / n
    squares = state[2] + (x - state[1]) * (x - mean)
    z = x if n == 1.0 else state[3] + weight * (x - state[3])
    state[0], state[1], state[2], state[3] = n, mean, squares, z
    sd = math.sqrt(squares / n * weight / (2.0 - weight))
    fall = (mean - z) / sd if sd > 0.0 else 0.0
    return n > warm_up and fall > width, fall, DOWN


class Ewma:
    direction, statistic = "down", None

    def __init__(self, weight=0.1, width=3.0, warm_up=30):
        self._numbers, self._params = [0.0] * 4, (weight, width, warm_up)

    @property
    def quiet(self):
        return QuietRule(ewma, self._numbers, self._params)

    def update(self, x):
        alarm, self.statistic, _ = ewma(self._numbers, self._params, x)
        return alarm

    def reset(self):
        self._numbers[:] = [0.0] * 4

    def state(self):
        return list(self._numbers)

    def restore(self, state):
        self._numbers[:] = state


if __name__ == "__main__":
    for engine in ("compiled", "python"):
        config = load("own_rule", overrides=[f"execute.engine={engine}"])
        done = run_trial(config, 0, make_system)
        print(f"{engine:<10}{done.log_sha256}  alarms {done.alarms}")
