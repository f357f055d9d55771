"""A pass over five processes on TCP loopback, beside bare Zenoh and beside Redis pub/sub with the same hops."""

import json
import shutil
import socket
import statistics
import subprocess
import sys
from pathlib import Path

import hops
import pytest

HERE = Path(__file__).parent
ROUNDS = 5


def free_port():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]


def run(program, *arguments):
    command = [sys.executable, str(HERE / program), *map(str, arguments)]
    for _ in range(3):
        said = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=120)
        if said.returncode != hops.LOST:
            break
    assert said.returncode == 0
    return json.loads(said.stdout.splitlines()[-1])


def over_zenoh(passes, loops):
    return run("hops.py", "zenoh", f"tcp/127.0.0.1:{free_port()}", passes, loops)


def in_the_loop(passes, loops, durability):
    return run("loop_hops.py", f"tcp/127.0.0.1:{free_port()}", passes, loops, durability)


@pytest.fixture
def redis_server(tmp_path):
    if shutil.which("redis-server") is None:
        pytest.skip("redis-server is not installed")
    pytest.importorskip("redis", reason="the package redis is not installed")
    port = free_port()
    quiet = ["--save", "", "--appendonly", "no", "--dir", str(tmp_path), "--logfile", str(tmp_path / "log")]
    server = subprocess.Popen(["redis-server", "--port", str(port), "--bind", "127.0.0.1", *quiet])
    import redis

    client = redis.Redis(port=port)
    while not answers(client):
        assert server.poll() is None, "redis-server did not start"
    yield f"redis://127.0.0.1:{port}", client
    server.terminate()
    server.wait()


def answers(client):
    import redis

    try:
        return client.ping()
    except redis.ConnectionError:
        return False


def medians(rounds, **variants):
    """Run all variants in turn, so that a machine whose speed drifts is slow for each; return median figures."""
    found = {name: [] for name in variants}
    for _ in range(rounds):
        for name, once in variants.items():
            found[name].append(once())
    return {
        name: {key: statistics.median(one[key] for one in figures) for key in figures[0]}
        for name, figures in found.items()
    }


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_one_loop_in_lockstep(benchmark, request, capsys):
    address, client = request.getfixturevalue("redis_server") if benchmark.enabled else ("", None)
    passes, rounds = (3000, ROUNDS) if benchmark.enabled else (30, 1)

    def over_redis():
        client.flushall()
        return run("hops.py", "redis", address, passes, 1)

    variants = {"zenoh": lambda: over_zenoh(passes, 1), "normal": lambda: in_the_loop(passes, 1, "normal")}
    if benchmark.enabled:
        variants["memory"] = lambda: in_the_loop(passes, 1, "memory")
        variants["full"] = lambda: in_the_loop(passes, 1, "full")
        variants["redis"] = over_redis
    found = {}
    benchmark.pedantic(lambda: found.update(medians(rounds, **variants)), rounds=1)
    raw = found["zenoh"]["median_us"]
    with capsys.disabled():
        print("\none pass, five processes, TCP loopback, lockstep: median, and times bare Zenoh")
        for name, figures in found.items():
            print(f"  {name:<8} {figures['median_us']:>7,.0f} us  {figures['median_us'] / raw:.2f}")
    assert all(figures["median_us"] > 0 for figures in found.values())


@pytest.mark.long
@pytest.mark.timeout(600)
def test_sixteen_loops_at_once(benchmark, capsys):
    passes, rounds = (600, ROUNDS) if benchmark.enabled else (10, 1)
    variants = {"zenoh": lambda: over_zenoh(passes, 16), "normal": lambda: in_the_loop(passes, 16, "normal")}
    if benchmark.enabled:
        variants["memory"] = lambda: in_the_loop(passes, 16, "memory")
    found = {}
    benchmark.pedantic(lambda: found.update(medians(rounds, **variants)), rounds=1)
    with capsys.disabled():
        print("\n16 loops at once, five processes: passes per second in total")
        for name, figures in found.items():
            print(f"  {name:<8} {figures['passes_per_s']:>7,.0f}")
    assert all(figures["passes_per_s"] > 0 for figures in found.values())
