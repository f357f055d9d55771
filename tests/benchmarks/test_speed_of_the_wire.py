"""What it costs to put a record on the wire and to take it off, for each kind, beside plain JSON of the same text."""

import json
import statistics
import time
from pathlib import Path

import pytest

from adapters.systems import make_system
from knowledge import STAGES, from_json, to_json
from mape import Loop, load

EXAMPLES = Path(__file__).parents[2] / "examples"
TURNS = 200


@pytest.fixture(scope="module", params=["gridworld_goals", "traffic"])
def passes(request):
    config = load(EXAMPLES / f"{request.param}.toml")
    loop = Loop(config, make_system(config.system))
    loop.run(50)
    return list(loop.log.window)


@pytest.fixture(params=range(len(STAGES)), ids=[kind.__name__ for kind in STAGES])
def record(request, passes):
    return passes[-1][request.param]


@pytest.mark.benchmark(group="to_json", max_time=0.2)
def test_writing_a_record(benchmark, record):
    assert benchmark(to_json, record).startswith(b'{"schema":')


@pytest.mark.benchmark(group="from_json", max_time=0.2)
def test_reading_a_record(benchmark, record):
    assert benchmark(from_json, to_json(record)) == record


def test_the_wire_beside_plain_json_turn_by_turn(passes, capsys, request):
    """The machine's speed drifts; record by record all four meet the same machine."""
    enabled = request.config.getoption("benchmark_enable")
    took = {name: [] for name in ("to_json", "json.dumps", "from_json", "json.loads")}
    for finished in passes * (TURNS if enabled else 1):
        for record in finished:
            text = to_json(record)
            fields = json.loads(text)
            for name, call, given in (
                ("to_json", to_json, record),
                ("json.dumps", json.dumps, fields),
                ("from_json", from_json, text),
                ("json.loads", json.loads, text),
            ):
                begun = time.perf_counter_ns()
                call(given)
                took[name].append(time.perf_counter_ns() - begun)
    if enabled:
        us = {name: statistics.median(times) / 1000 for name, times in took.items()}
        with capsys.disabled():
            print("\nmedian of a record: " + ", ".join(f"{name} {cost:.1f} us" for name, cost in us.items()))
    assert all(min(times) > 0 for times in took.values())
