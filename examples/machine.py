"""What a system may say of itself: signals, which actions are worth trying, drifts. A machine that wears out."""

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete


class Machine(gymnasium.Env):
    """Ten degrees of wear: the more, the more costs work. A service costs 1 and makes it new; to wait costs as much."""

    observation_space, action_space = Discrete(10), Discrete(3)
    signal_names = ("vibration",)  # which each step puts into info["signals"]
    drifts = (301,)  # episodes from which it is another system: for figures and `mapek compare`, never for the loop

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.rate = 1 if (options or {}).get("episode", 1) < self.drifts[0] else 3
        self.wear = 0
        return 0, self._info()

    def step(self, action):
        work, service = action == 1, action == 2
        reward = -0.1 * self.wear if work else -1.0
        self.wear = 0 if service else min(9, self.wear + self.rate * int(work))
        return self.wear, reward, False, False, self._info()

    def _info(self):
        used = self.wear > 0
        mask = np.array([used, self.wear < 9, used])  # to wait, to work, to be serviced
        return {"signals": {"vibration": self.rate + 0.1 * self.wear}, "action_mask": mask}


gymnasium.register("Machine-v0", Machine, max_episode_steps=30)

if __name__ == "__main__":
    from adapters.systems import make_system
    from mape import load, run_trial

    print(run_trial(load("machine"), 0, make_system).alarms)
