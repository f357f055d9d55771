"""A detector of your own, chosen by one line of config: eight failed episodes in a row."""

from adapters.systems import make_system
from mape import load, run_trial


class Failures:
    direction, statistic = "down", None

    def __init__(self, floor=-37.0):
        self.floor, self.failures = floor, 0

    def update(self, x):
        self.failures = self.failures + 1 if x <= self.floor else 0
        return self.failures == 8

    def reset(self):
        self.failures = 0

    def state(self):
        return self.failures

    def restore(self, state):
        self.failures = state


if __name__ == "__main__":
    line = 'monitor.detectors=["swap_detector:Failures"]'
    config = load("gridworld_goals", overrides=[line])
    print(run_trial(config, 0, make_system).alarms)
