"""`mapek up` and `mapek run` of the same config: the same hashes, and a replay that finds no difference."""

import json
import random
from typing import Any

import pytest
from real_processes import EXAMPLES, SHORT, hashes, say, up, write_config

from mape import load

SYSTEMS = ("gridworld_goals", "traffic", "jump", "frozen_lake", "taxi")


def drawn(seed: int) -> dict[str, Any]:
    """Draw a config of a small run, of every system in turn."""
    draw = random.Random(seed)
    name = SYSTEMS[seed % len(SYSTEMS)]
    profile = draw.choice([None, "paper"]) if name == "gridworld_goals" else None
    episodes = draw.randint(30, 150)
    table = load(EXAMPLES / f"{name}.toml", profile=profile).model_dump(mode="json", by_alias=True)
    options = table["system"]["options"]
    if "switch_at" in options:
        options["switch_at"] = sorted(draw.sample(range(2, episodes), len(options["switch_at"])))
    if "jump_from" in options:
        options["jump_from"] = draw.randint(2, episodes)
    detectors = [
        {"name": "page_hinkley", "delta": 0.5, "threshold": draw.uniform(20.0, 200.0)},
        {
            "name": "two_window",
            "reference": 10,
            "recent": 5,
            "threshold": draw.uniform(3.0, 60.0),
            "signal": "td_error",
        },
        {"name": "oracle", "episodes": [draw.randint(2, episodes)]},
        {"name": "adwin", "signal": "steps"},
    ]
    schedules = [
        {"name": "exponential", "eps_min": 0.1, "decay": draw.uniform(0.0, 0.5)},
        {"name": "success", "eps_min": 0.05, "decay": 0.1},
        {"name": "geometric", "eps_min": 0.01, "factor": 0.99},
        {"name": "constant", "epsilon": draw.random()},
    ]
    swaps = [
        {"part": "plan", "to": {"name": "morphin", "alpha": 0.1, "alpha_max": 0.5, "k": 2.0}},
        {"part": "plan.schedule", "to": draw.choice(schedules)},
        {"part": "analyze", "to": {"name": "changes"}},
        {"part": "learner", "to": {"name": "expected_sarsa"}},
        {"part": "monitor.0", "to": detectors[0]},
    ]
    table["plan"]["schedule"] = draw.choice(schedules)
    table["monitor"] = {"detectors": draw.sample(detectors, draw.randint(1, 2))}
    table["swap"] = [{"pass": draw.randint(1, episodes), **swap} for swap in draw.sample(swaps, draw.randint(0, 2))]
    loops, trials = draw.choice([(1, 1), (2, 1), (3, 1), (1, 2), (2, 2)])
    return table | {"episodes": episodes, "seed": draw.getrandbits(63), "loops": loops, "trials": trials}


@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(seed, marks=pytest.mark.long) for seed in (3, 5, *range(100, 120)))]
)
def test_five_processes_give_the_bits_of_one(here, seed):
    config = write_config(here, drawn(seed), engine=None)
    with up(config, "--snapshot-every", "20") as running:
        together = running.result()
    assert say("run", str(config), "--out", str(here / "run"), "--workers", "1", *SHORT)[0] == 0
    alone = json.loads((here / "run" / "result.json").read_bytes())
    assert hashes(together) == hashes(alone)
    gone = {"command": None, "sha256": None}  # which is over the command too
    assert together | gone == alone | gone
    code, said = say("replay", str(here / "up"), "--workers", "1", "-q")
    assert (code, "no difference" in said) == (0, True), said
