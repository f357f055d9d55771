"""What the loop itself costs: four components, four records, log rows and hash, without the episode."""

import json
import time
from pathlib import Path

import pytest

from adapters.systems import make_system
from mape import Loop, load

CONFIG = Path(__file__).parents[2] / "examples" / "gridworld_goals.toml"
PASSES = 100_000


@pytest.fixture
def passes(request):
    return PASSES if request.config.getoption("benchmark_enable") else 100


@pytest.fixture
def loop():
    config = load(CONFIG)
    made = Loop(config, make_system(config.system))
    made.run(1)
    # The episode is left out, not the work around it: its result is that of a finished one.
    made.execute._drive = lambda *arguments: (0, 10, 91.0, 0.1, 0.1)
    return made


@pytest.mark.benchmark(group="100,000 passes without episodes")
def test_passes_of_the_loop(benchmark, loop, passes):
    benchmark.pedantic(loop.run, args=(passes,), rounds=3)
    benchmark.extra_info["us per pass"] = _microseconds(benchmark, passes)
    assert loop.log.passes == 3 * passes + 1 if benchmark.enabled else passes + 1


@pytest.mark.benchmark(group="100,000 passes without episodes")
def test_writing_their_records_as_json(benchmark, loop, passes):
    loop.run(1)
    records = [record._asdict() for record in loop.log.window[-1]]

    def write():
        for _ in range(passes):
            for record in records:
                json.dumps(record)

    benchmark.pedantic(write, rounds=3)
    benchmark.extra_info["us per pass"] = _microseconds(benchmark, passes)


def test_a_pass_beside_its_records_as_json_turn_by_turn(loop, passes, capsys):
    """The machine's speed drifts; in slices of 200 passes both meet the same machine."""
    records = [record._asdict() for record in loop.log.window[-1]]
    seconds = {"pass": 0.0, "json": 0.0}
    for _ in range(passes // 200 or 1):
        begun = time.perf_counter()
        loop.run(200)
        between = time.perf_counter()
        for _ in range(200):
            for record in records:
                json.dumps(record)
        seconds["pass"] += between - begun
        seconds["json"] += time.perf_counter() - between
    passed = loop.log.passes - 1
    with capsys.disabled():
        if passed >= PASSES:
            us = {name: total / passed * 1e6 for name, total in seconds.items()}
            print(
                f"\na pass {us['pass']:.1f} us, its records as JSON {us['json']:.1f} us: {us['pass'] / us['json']:.2f}"
            )
    assert all(total > 0 for total in seconds.values())


def _microseconds(benchmark, passes):
    return round(benchmark.stats.stats.min / passes * 1e6, 2) if benchmark.enabled else None
