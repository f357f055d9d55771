"""The whole of Table 1, and one trial of it, beside the plain way."""

import json
import subprocess
import sys
import time
from pathlib import Path

import plain_way
import pytest

from adapters.systems import make_system
from mape import load, run_trial

CONFIG = Path(__file__).parents[2] / "examples" / "gridworld_goals.toml"
AGENTS = ("morphin", "q_learning")


@pytest.fixture
def episodes(request):
    return 1500 if request.config.getoption("benchmark_enable") else 20


@pytest.mark.benchmark(group="one trial of Table 1, both agents, one process")
def test_trial_in_the_plain_way(benchmark, episodes):
    def both():
        plain_way.morphin_trial(0, episodes)
        plain_way.q_learning_trial(0, episodes)

    benchmark.pedantic(both, rounds=3)


@pytest.mark.benchmark(group="one trial of Table 1, both agents, one process")
def test_trial_in_the_loop(benchmark, episodes):
    configs = [load(CONFIG, agent=agent, overrides=[f"episodes={episodes}"]) for agent in AGENTS]

    def both():
        for config in configs:
            run_trial(config, 0, make_system)

    both()  # compiles
    benchmark.pedantic(both, rounds=5)


@pytest.mark.benchmark(group="Table 1 whole")
def test_table1_whole_with_two_workers(benchmark, tmp_path):
    """Process start to end, statistics included, figures left out; the plain way is measured on 2 trials and scaled."""
    trials = 1000 if benchmark.enabled else 2

    def whole():
        command = [sys.executable, "-m", "mape", "reproduce", "table1", "--no-figures", "-q", "--workers", "2"]
        subprocess.run(
            [*command, "--trials", str(trials), "--out", str(tmp_path / "out"), "--json", str(tmp_path / "out.json")],
            check=True,
            capture_output=True,
        )

    benchmark.pedantic(whole, rounds=1)
    assert json.loads((tmp_path / "out.json").read_text())["trials"] == trials
    if benchmark.enabled:
        begun = time.perf_counter()
        for seed in range(2):
            plain_way.morphin_trial(seed)
            plain_way.q_learning_trial(seed)
        scaled = (time.perf_counter() - begun) / 2 * trials
        seconds = benchmark.stats.stats.min
        benchmark.extra_info["plain way, scaled from 2 trials, s"] = round(scaled)
        benchmark.extra_info["times as fast"] = round(scaled / seconds, 1)
        print(
            f"\nTable 1 whole: {seconds:.1f} s; plain way {scaled:.0f} s (scaled); {scaled / seconds:.1f} times as fast"
        )


@pytest.mark.parametrize("agent", AGENTS)
def test_plain_way_is_the_same_algorithm(agent):
    """Statistically: the plain way's own randomness gives totals within five standard errors of the loop's."""
    config = load(CONFIG, agent=agent, overrides=["episodes=120"])
    ours = [run_trial(config, trial, make_system).total_steps for trial in range(12)]
    theirs = [getattr(plain_way, f"{agent}_trial")(trial, 120)[0] for trial in range(12)]
    mean, error = _mean_and_error(ours)
    other, other_error = _mean_and_error(theirs)
    assert abs(mean - other) < 5 * (error**2 + other_error**2) ** 0.5


def _mean_and_error(values):
    mean = sum(values) / len(values)
    return mean, (sum((v - mean) ** 2 for v in values) / (len(values) - 1) / len(values)) ** 0.5
