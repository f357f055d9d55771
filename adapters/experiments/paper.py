"""What arXiv 2601.20714 prints, and what was found with its settings: to be held against, never to be copied from."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt


class Printed(NamedTuple):
    """A number as printed: mean and standard deviation over trials."""

    mean: float
    sd: float


def against(found: npt.NDArray[Any], printed: Printed | None) -> dict[str, float | None]:
    """Return how far the mean of a sample lies from a printed one; None where that cannot be said.

    Returns
    -------
    d : difference in the printed standard deviations, which are those of one trial.
    z : difference in standard errors of the sample's mean, sd / sqrt(n). The paper's own n is not known, so the error
        of its mean is left out; with as many trials as ours it would make z smaller by about sqrt(2).
    """
    if printed is None or len(found) == 0:
        return {"d": None, "z": None}
    difference = float(np.mean(found)) - printed.mean
    sd = float(np.std(found, ddof=1)) if len(found) > 1 and np.ptp(found) > 0 else 0.0
    return {"d": difference / printed.sd, "z": difference / (sd / math.sqrt(len(found))) if sd > 0 else None}


# Table 1. The paper gives the spread of columns 2 and 3 in % of the absolute episode number, 300 + x and 600 + x.
TABLE1_TOTAL = {
    "morphin": Printed(23_292.07, 0.0633 * 23_292.07),
    "q_learning": Printed(40_683.74, 0.0133 * 40_683.74),
}
TABLE1_STAGES = {
    "morphin": (
        Printed(135.81, 0.0931 * 135.81),
        Printed(175.17, 0.0580 * (300 + 175.17)),
        Printed(167.81, 0.0313 * (600 + 167.81)),
    ),
    "q_learning": (Printed(256.40, 0.0435 * 256.40), None, None),
}
TABLE1_RATIO = 1.747

# Mean return of the last 500 episodes, found over 100-200 trials with the settings of the paper's traffic experiment.
TRAFFIC_EPISODES = (500, 3000, 3500, 4000, 5000, 8000, 8500, 10000)
TRAFFIC = {
    "morphin": (-488, -317, -601, -541, -474, -411, -363, -340),
    "q_learning": (-486, -320, -708, -700, -688, -678, -361, -336),
    "same_actions": (-486, -320, -504, -492, -447, -409, -360, -340),
    "three_actions": (-489, -321, -722, -713, -697, -684, -375, -333),
}

# Mean steps over episodes 281-300 and 381-400, and share of greedy paths that are optimal; the paper's layout is not
# published, so these were found on the layout of examples/jump.toml.
JUMP = {
    "morphin": (18.3, 5.90, 0.986),
    "success_rule": (18.3, 7.10, 0.58),
    "fixed_alpha": (18.2, 15.7, 0.0),
    "q_learning": (18.2, 17.8, 0.0),
}
