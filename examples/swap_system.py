"""A system of your own, chosen by one line of config: three levers, of which another one pays from episode 51 on."""

import gymnasium
from gymnasium.spaces import Discrete

from adapters.systems import make_system
from mape import load, run_trial


class Levers(gymnasium.Env):
    observation_space, action_space = Discrete(1), Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.best = 0 if (options or {}).get("episode", 1) <= 50 else 2
        return 0, {}

    def step(self, action):
        return 0, float(action == self.best), False, False, {}


gymnasium.register("Levers-v0", Levers, max_episode_steps=10)

if __name__ == "__main__":
    lines = ["system={id='Levers-v0'}", "episodes=200", "plan.schedule.decay=0.1"]
    watch = 'monitor.detectors=[{name="page_hinkley", threshold=10.0}]'
    config = load("frozen_lake", overrides=[*lines, watch])
    print(run_trial(config, 0, make_system).alarms)
