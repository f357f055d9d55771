"""A planner of your own, chosen by one line of config: MORPHIN, but exploring in at most half of the steps."""

from adapters.systems import make_system
from mape import load, run_trial
from mape.plan.morphin import Morphin


class Gentle(Morphin):
    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        return plan._replace(epsilon=min(plan.epsilon, 0.5))


if __name__ == "__main__":
    for planner in ("morphin", "swap_planner:Gentle"):
        config = load("traffic", overrides=[f"plan.name={planner}", "episodes=4000"])
        print(planner, run_trial(config, 0, make_system).alarms)
