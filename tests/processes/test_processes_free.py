"""A managed system that runs freely: whatever happens to the loop, it keeps its pace, and the loop catches up."""

import json
import signal
import time
from contextlib import ExitStack
from itertools import accumulate, pairwise

import pytest
from real_processes import (
    EXAMPLES,
    end_all,
    endpoint,
    events,
    five,
    last,
    looking_on,
    passes,
    resident,
    rows,
    serve,
    store,
    until,
    write_config,
)
from real_runs import run

from knowledge import from_json
from mape import load

RATE = 200.0


def free_config(here, episodes, *overrides):
    config = load(
        EXAMPLES / "gridworld_goals.toml",
        overrides=[
            f"episodes={episodes}", "system.options.switch_at=[101]", 'execute.mode="free"', f"execute.rate={RATE}",
            *overrides,
        ],
    )  # fmt: skip
    return write_config(here, json.loads(config.to_json()))


def driven(log):
    return last(log)[0]


def rate_over(log, episodes):
    """Wait until that many more have reached the log; return how many came in a second, for who reads it."""
    first, begun = driven(log), time.monotonic()
    until(lambda: driven(log) >= first + episodes, f"{episodes} episodes", every=0.001)
    return episodes / (time.monotonic() - begun)


def ages(log):
    found = rows(log, "SELECT body FROM records WHERE stage = 0")
    return {seen.pass_no: seen.age for seen in (from_json(body) for (body,) in found)}


@pytest.mark.parametrize(
    ("dead_for", "megabytes"),
    [
        pytest.param(400, 16, marks=pytest.mark.long),  # a busy machine may stand still for a moment
        pytest.param(2000, 4, marks=pytest.mark.long),
    ],
)
def test_the_system_goes_on_while_the_loop_is_dead_and_is_caught_up_with(here, dead_for, megabytes):
    config = free_config(here, round(RATE * 9) + dead_for, "execute.backlog=5000")
    where, log = endpoint(here), here / "served" / "log.sqlite"
    with ExitStack() as opened:
        served = opened.enter_context(five(config, where))
        until(lambda: passes(log) > 100, "a run that is on its way")
        before = rate_over(log, 300)
        held = {role: resident(served[role].pid) for role in ("execute", "knowledge")}
        killed_at = driven(log)
        for role in ("monitor", "analyze", "plan"):
            served[role].signalled(signal.SIGKILL)
        stuck = last(log)[1:]
        during = rate_over(log, dead_for)
        assert last(log)[1:] == pytest.approx(stuck, abs=50)  # the others finish what the first to die had said
        grown = {role: resident(served[role].pid) - size for role, size in held.items()}
        back_at = driven(log)
        served |= {role: opened.enter_context(serve(config, role, where)) for role in ("monitor", "analyze", "plan")}
        until(lambda: passes(log) >= driven(log) - 20, "the loop to have caught up")
        caught_up_at = driven(log)
        end_all(served)
    print(f"{before:.1f} episodes/s before, {during:.1f} while dead; bytes grown {grown}")
    print(f"the loop was back at {back_at}, and had caught up at {caught_up_at}")
    assert all(size < megabytes << 20 for size in grown.values()), grown
    total = load(config).episodes
    assert last(log) == (total,) * 4
    old = ages(log)
    assert len(old) == total
    assert old[back_at] >= back_at - killed_at - 50
    with store(log) as opened:
        assert opened.dropped(0) == []


@pytest.mark.long
def test_what_a_small_backlog_drops_while_knowledge_is_away_is_one_row(here):
    config = free_config(here, round(RATE * 8), "execute.backlog=150")
    where, log = endpoint(here), here / "served" / "log.sqlite"
    kept = ("--snapshot-every", "100000")  # what Execute did before the gap, it does again
    with ExitStack() as opened:
        served = opened.enter_context(five(config, where, *kept))
        until(lambda: passes(log) > 100, "a run that is on its way")
        served["knowledge"].signalled(signal.SIGKILL)
        reached = driven(log)
        # Nobody can tell from outside how far Execute is now: it has to be beyond its backlog.
        time.sleep(2 * 150 / RATE)
        served["knowledge"] = opened.enter_context(serve(config, "knowledge", where, *kept))
        until(lambda: driven(log) > reached + 250, "episodes after the gap")
        with looking_on(where) as ask:
            status = until(ask, "an answer")
        served["execute"].signalled(signal.SIGKILL)
        served["execute"] = opened.enter_context(serve(config, "execute", where, *kept))
        end_all(served)
    with store(log) as opened:
        dropped = opened.dropped(0)
    logged = [number for (number,) in rows(log, "SELECT pass FROM records WHERE stage = 0 ORDER BY pass")]
    total = load(config).episodes
    # What is missing is in one row per gap: between two of them something was logged.
    missing = [number for first, final in dropped for number in range(first, final + 1)]
    assert missing == sorted({*range(1, total + 1)} - {*logged})
    assert reached < dropped[-1][0]  # a machine that stands still for a moment makes gaps of its own
    assert all(final + 1 < first for (_, final), (first, _) in pairwise(dropped))
    counts = [final - first + 1 for first, final in dropped]
    assert status.dropped in accumulate(counts)
    assert [event.text.split()[0] for event in events(log, "dropped")] == [str(count) for count in counts]
    said = run("log", str(log), "--events", "--pass", str(dropped[0][0]), cwd=here).stdout
    assert f"{counts[0]} episodes" in said
    result = json.loads((here / "served" / "result.json").read_bytes())
    assert (result["passes"], result["trials"][0]["dropped"]) == (total, sum(counts))
    assert events(log, "refused") == []
    print(f"dropped {dropped}")
