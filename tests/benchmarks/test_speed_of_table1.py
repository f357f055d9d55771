"""The whole of Table 1, and one trial of it, beside the plain way and beside a plain C program."""

import json
import statistics
import subprocess
import sys
import time
from pathlib import Path

import c_reference
import plain_way
import pytest

from adapters.systems import make_system
from mape import load, run_trial

CONFIG = Path(__file__).parents[2] / "examples" / "gridworld_goals.toml"
AGENTS = ("morphin", "q_learning")
ROUNDS = 3


@pytest.fixture
def episodes(request):
    return 1500 if request.config.getoption("benchmark_enable") else 20


def described(folder, *lines):
    """Write for the C program what both agents are to do; return the descriptions by agent."""
    configs = {agent: load(CONFIG, agent=agent, overrides=lines) for agent in AGENTS}
    return {agent: c_reference.describe(config, folder / f"{agent}.txt") for agent, config in configs.items()}


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
@pytest.mark.timeout(1200)
def test_table1_whole_with_two_workers(benchmark, tmp_path, capsys):
    """Process start to end, import included, statistics and figures left out; what is compiled is in the cache.

    The C program does both agents on one core, one after the other, in turn with the loop. The plain way is measured
    on 2 trials and scaled.
    """
    trials = 1000 if benchmark.enabled else 2
    with_c = c_reference.compiler() is not None
    descriptions = described(tmp_path, f"trials={trials}") if with_c else {}
    steps, in_c = {}, []
    runs = iter(range(ROUNDS))

    def in_c_first():
        begun = time.perf_counter()
        for agent, description in descriptions.items():
            steps[agent] = c_reference.timing(description).steps
        in_c.append(time.perf_counter() - begun)

    def whole():
        command = [sys.executable, "-m", "mape", "reproduce", "table1", "--no-figures", "--no-statistics", "-q"]
        command += ["--workers", "2"]
        out = ["--out", str(tmp_path / f"out-{next(runs)}"), "--json", str(tmp_path / "out.json")]
        subprocess.run([*command, "--trials", str(trials), *out], check=True, capture_output=True)

    if with_c:
        c_reference.build()
    benchmark.pedantic(whole, setup=in_c_first if with_c else None, rounds=ROUNDS)
    found = json.loads((tmp_path / "out.json").read_text())
    assert found["trials"] == trials
    for agent, counted in steps.items():
        assert found["agents"][agent]["steps"] == counted
    if not benchmark.enabled:
        return
    begun = time.perf_counter()
    for seed in range(2):
        plain_way.morphin_trial(seed)
        plain_way.q_learning_trial(seed)
    scaled = (time.perf_counter() - begun) / 2 * trials
    seconds = benchmark.stats.stats.median
    benchmark.extra_info["plain way, scaled from 2 trials, s"] = round(scaled)
    benchmark.extra_info["times as fast"] = round(scaled / seconds, 1)
    with capsys.disabled():
        print(f"\nTable 1 whole, two workers: {seconds:.2f} s, median of {ROUNDS}")
        print(f"  plain way {scaled:.0f} s (scaled): {scaled / seconds:.1f} times as fast")
        if with_c:
            c_seconds = statistics.median(in_c)
            benchmark.extra_info["C on one core, s"] = round(c_seconds, 3)
            print(f"  C on one core {c_seconds:.2f} s: {seconds / c_seconds:.2f} times the time of C")


@pytest.mark.skipif(c_reference.compiler() is None, reason="there is no C compiler")
@pytest.mark.benchmark(group="one long trial, one process")
@pytest.mark.parametrize("agent", AGENTS)
def test_step_of_one_long_trial(benchmark, agent, tmp_path, capsys):
    """What a step costs within a process, the four components and the log in it, in turn with the C program's."""
    episodes = 30_000 if benchmark.enabled else 50
    config = load(CONFIG, agent=agent, overrides=[f"episodes={episodes}"])
    description = c_reference.describe(config, tmp_path / "description.txt")
    in_c, results = [], []
    run_trial(load(CONFIG, agent=agent, overrides=["episodes=50"]), 0, make_system)  # compiles
    benchmark.pedantic(
        lambda: results.append(run_trial(config, 0, make_system)),
        setup=lambda: in_c.append(c_reference.timing(description)),
        rounds=ROUNDS,
    )
    steps = results[-1].total_steps
    assert in_c[-1].steps == steps
    if benchmark.enabled:
        ns, c_ns = 1e9 * benchmark.stats.stats.median / steps, statistics.median(one.ns_per_step for one in in_c)
        benchmark.extra_info.update({"ns per step": round(ns, 1), "C, ns per step": round(c_ns, 1)})
        with capsys.disabled():
            print(
                f"\na step of {agent}, {steps / episodes:.1f} of them an episode: {ns:.1f} ns, in C {c_ns:.1f} ns: "
                f"{ns / c_ns:.1f} times the time of C"
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
