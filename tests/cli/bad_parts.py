"""Detectors, planners, schedules, learners and analyzers that break the contract of their port in one way each."""

from mape.plan.exponential import Exponential, ExponentialConfig
from mape.plan.morphin import Morphin, MorphinConfig


class Quiet:
    direction = "unknown"
    statistic = None

    def update(self, x):
        return False

    def reset(self):
        pass

    def state(self):
        return None

    def restore(self, state):
        pass


class RaisingDetector(Quiet):
    def update(self, x):
        raise ZeroDivisionError("no variance")


class NanDetector(Quiet):
    statistic = float("nan")


class TextDetector(Quiet):
    statistic = "high"


class SidewaysDetector(Quiet):
    direction = "sideways"


class Nothing:
    pass


class Picky(Quiet):
    def __init__(self, size):
        raise ValueError(f"size {size} is odd")


class Unscheduled(Morphin):
    Config = None

    def __init__(self):
        super().__init__(MorphinConfig(), Exponential(ExponentialConfig()))


class Planned(Morphin):
    Config = None

    def __init__(self, schedule=None):
        super().__init__(MorphinConfig(), schedule or Exponential(ExponentialConfig()))

    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        return self.spoil(plan) if plan.pass_no == 2 else plan

    def spoil(self, plan):
        return plan


class EpsilonTwo(Planned):
    def spoil(self, plan):
        return plan._replace(epsilon=2.0)


class EpsilonNan(Planned):
    def spoil(self, plan):
        return plan._replace(epsilon=float("nan"))


class TwoRates(Planned):
    def spoil(self, plan):
        return plan._replace(learning_rate=(0.1, 0.2))


class RateNan(Planned):
    def spoil(self, plan):
        return plan._replace(learning_rate=(float("nan"), 0.5, 1.0))


class RateNone(Planned):
    def spoil(self, plan):
        return plan._replace(learning_rate=None)


class AddsList(Planned):
    def spoil(self, plan):
        return plan._replace(add=[1])


class DropsUnknown(Planned):
    def spoil(self, plan):
        return plan._replace(drop=(17,))


class DropsAll(Planned):
    def spoil(self, plan):
        return plan._replace(drop=(0, 1, 2, 3))


class Enables(Planned):
    def spoil(self, plan):
        return plan._replace(enable=(9,))


class AdoptsUnknown(Planned):
    def spoil(self, plan):
        return plan._replace(adopt="ab" * 32)


class NoPlan(Planned):
    def spoil(self, plan):
        return None


class WrongPass(Planned):
    def spoil(self, plan):
        return plan._replace(pass_no=7)


class RaisingPlanner(Planned):
    def spoil(self, plan):
        raise KeyError("budget")


class NoStart(Planned):
    def start(self, loop):
        return {"epsilon": 1.0}


class TextSchedule(Exponential):
    Config = None

    def __init__(self):
        super().__init__(ExponentialConfig())

    epsilon = "high"


class RaisingAnalyzer:
    def analyze(self, symptom):
        raise LookupError("no baseline")


class SilentAnalyzer:
    def analyze(self, symptom):
        return None
