"""A gridworld with any number of moves, for what the number of actions costs: ``wide_gridworld:WideGridworld-v0``."""

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete

from managed_systems import ALWAYS, Gridworld, RulesEnvironment


class WideGridworld(Gridworld):
    """A gridworld whose action ``4 * k + d`` goes k + 1 cells in direction d: up, down, left, right.

    All else is the gridworld's, its rules among it.

    Parameters
    ----------
    n_actions
        Number of actions, of which each four are longer by a cell.
    options
        The gridworld's. Slip, jumps that come later and removals are not meant.
    """

    def __init__(self, n_actions=4, **options):
        super().__init__(**options)
        rules = self.rules
        wide = rules._replace(
            params=rules.params._replace(moves=self._moves(n_actions)),
            n_actions=n_actions,
            windows=np.array([(1, ALWAYS)] * n_actions, np.int64),
        )
        RulesEnvironment.__init__(self, wide, Discrete(wide.n_states), self.render_mode)


gymnasium.register("WideGridworld-v0", WideGridworld)
