"""Whoever is killed or frozen, whenever it is: nothing is lost, nothing is done twice, and the hashes are the same."""

import json
import os
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest
from process_chaos import blows, survive
from real_processes import EXAMPLES, ROLES, alone, events, hashes, records, until, up

from mape import load

NO_RECOVERY = str(Path(__file__).parent / "no_recovery.py")
STANDS_STILL = 8.0
"""Seconds; a restart takes one or two, on a busy machine."""


def example(folder: Path, name: str, *overrides: str) -> Path:
    config = load(EXAMPLES / f"{name}.toml", overrides=overrides)
    path = folder / "config.json"
    path.write_text(config.to_json())
    return path


def undisturbed(config, result, out="up"):
    """Assert that what the blows left is what no blow would have left."""
    log = config.parent / out / "log.sqlite"
    assert hashes(result) == alone(config)
    assert records(log) == dict.fromkeys(range(len(result["trials"])), 4 * result["passes"] + 1)
    assert [event.text for event in events(log, "refused")] == []


def test_a_run_outlives_kills_of_all_roles_and_a_freeze(here):
    # The run goes on long after the last moment, for a blow may come up to a second after it.
    config = example(here, "gridworld_goals", "episodes=850", "system.options.switch_at=[101,301]")
    plan = blows(seed=7, total=400, kills=4, freezes=1, must=("knowledge", "execute", "plan"))
    result, done, _ = survive(config, plan, "--snapshot-every", "37")
    assert len(done) == len(plan)
    undisturbed(config, result)


def outcome(running, victim, moments):
    """Kill one role at some passes; return how the run went on: "hangs", "fails" or its hashes."""
    moved_at, seen, moments = time.monotonic(), -1, list(moments)

    def ended_or_stands_still():
        nonlocal moved_at, seen
        if (now := running.passes()) != seen or len(running.children()) < len(ROLES):
            moved_at, seen = time.monotonic(), now
        if moments and now >= moments[0]:
            os.kill(running.child(victim), signal.SIGKILL)
            del moments[0]
        return running.process.ended or time.monotonic() - moved_at > STANDS_STILL

    until(ended_or_stands_still, "an end or a stop")
    if not running.process.ended:
        return "hangs"
    if running.process.process.returncode != 0:
        return "fails"
    return hashes(json.loads((running.out / "result.json").read_bytes()))


@pytest.mark.long
def test_without_recovery_the_same_kills_are_noticed(here):
    """The control: what the tests above would see if one part of the recovery were missing."""
    config = example(here, "gridworld_goals", "episodes=300", "system.options.switch_at=[101]")
    whole = alone(config)
    # Not every kill of Knowledge meets a record on its way.
    cuts = {
        "state": ("plan", [60]),
        "catching-up": ("monitor", [60]),
        "sending-again": ("knowledge", range(20, 260, 20)),
    }
    with ExitStack() as opened:
        runs = {
            cut: opened.enter_context(up(config, out=cut, start=(sys.executable, NO_RECOVERY, cut))) for cut in cuts
        }
        with ThreadPoolExecutor() as side_by_side:
            seen = dict(
                zip(cuts, side_by_side.map(outcome, runs.values(), *zip(*cuts.values(), strict=True)), strict=True)
            )
    assert seen["state"] not in ("hangs", whole)
    assert seen["catching-up"] == "hangs"
    assert seen["sending-again"] == "hangs"


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("name", "overrides", "seed"),
    [
        ("gridworld_goals", ("episodes=5000",), 1),
        ("gridworld_goals", ("episodes=1300", "loops=4"), 2),
        ("traffic", ("episodes=5000", "system.options.switch_at=[1001,3001]"), 3),
        ("frozen_lake", ("episodes=5000",), 4),
    ],
)
def test_a_long_run_outlives_thirty_kills_and_five_freezes(here, name, overrides, seed):
    config = example(here, name, *overrides)
    total = load(config).episodes
    plan = blows(seed, total, kills=32, freezes=5, must=("knowledge", "execute", "plan", "monitor", "analyze"))
    result, done, _ = survive(config, plan, within=600.0)
    assert len(done) == len(plan)
    undisturbed(config, result)
