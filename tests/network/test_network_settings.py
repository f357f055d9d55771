"""Five roles over TLS join and go on, whatever the network is like, and come to what one process makes."""

import subprocess
import time

import pytest
from bad_networks import alone, deployed, grid
from real_processes import passes, until
from real_runs import MAPEK
from user_space_switch import why_not

REASON = why_not()
pytestmark = [pytest.mark.skipif(REASON is not None, reason=str(REASON)), pytest.mark.long, pytest.mark.timeout(900)]

KBIT, MBIT = 1e3 / 8, 1e6 / 8  # bytes a second

SETTINGS = {
    # name: (config, line)
    "50 ms": ({"episodes": 60}, {"delay": 0.025}),
    "120 ms": ({"episodes": 40}, {"delay": 0.060}),
    "200 ms": ({"episodes": 30}, {"delay": 0.100, "jitter": 0.02}),
    "400 ms": ({"episodes": 20}, {"delay": 0.200, "jitter": 0.04}),
    "1000 ms": ({"episodes": 10}, {"delay": 0.500, "jitter": 0.05}),
    "10 % lost": ({"episodes": 30}, {"delay": 0.025, "loss": 0.1}),
    "400 ms, 10 % lost": ({"episodes": 8}, {"delay": 0.2, "loss": 0.1}),
    "out of order": ({"episodes": 40}, {"delay": 0.025, "jitter": 0.01, "late": 0.2}),
    "twice": ({"episodes": 40}, {"delay": 0.025, "twice": 0.3}),
    "64 kbit/s": ({"episodes": 20}, {"delay": 0.025, "rate": 64 * KBIT}),
    "2 Mbit/s, 2 MB": ({"episodes": 8, "side": 250}, {"delay": 0.025, "rate": 2 * MBIT}),
}


@pytest.mark.parametrize("setting", SETTINGS)
def test_all_roles_join_and_come_to_the_hashes_of_one_process(here, setting):
    config, line = SETTINGS[setting]
    table = grid(**config)
    begun = time.monotonic()
    with deployed(here, table, "--snapshot-every", "4", seed=time.monotonic_ns() & 0xFFFF, **line) as run:
        run.start_all()
        until(lambda: passes(run.log) >= 1 or run.served["knowledge"].ended, "the first pass", 300.0, every=0.1)
        joined = time.monotonic() - begun
        found = run.end()
        print(f"{setting}: joined after {joined:.1f} s, done after {time.monotonic() - begun:.1f} s; {run.switch.seen}")
    assert found == alone(table)


def test_who_looks_on_from_afar_is_answered_and_hears_nothing_that_is_false(here):
    with deployed(here, grid(10), delay=0.5, jitter=0.05) as run:
        run.start("knowledge")
        until(lambda: "Knowledge listens" in run.served["knowledge"].said, "Knowledge to listen")
        operator = [*run.switch.start("operator"), *MAPEK, "status", "--connect", run.endpoint, "--tls", str(run.keys)]
        done = subprocess.run(operator, capture_output=True, text=True, timeout=200, check=False)
        assert done.returncode == 0, done.stderr
        assert "0 of 10 passes" in done.stdout
        assert "uses no keys" not in done.stderr
        # One that is too impatient is told that the network is slow, and not that keys are wrong.
        done = subprocess.run([*operator, "--patience", "1"], capture_output=True, text=True, timeout=200, check=False)
        assert done.returncode == 1
        assert "uses no keys" not in done.stderr
