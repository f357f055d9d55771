"""A free-running Execute that restarts behind gaps and outages, or is driven faster than the loop can follow."""

import json
from itertools import pairwise

import pytest
from real_processes import rows, store, up, write_config
from roles_on_threads import Paced, Roles, paced

from knowledge import from_json
from mape.execute import Execute

OTHERS = ("monitor", "analyze", "plan")


def free(episodes, rate=200.0, backlog=2000, engine="auto"):
    # The compiled episode takes no time to speak of, so that the rate is kept.
    execute = {"mode": "free", "rate": rate, "backlog": backlog, "engine": engine}
    return paced(episodes, {"execute": execute, "system": {"options": {"switch_at": [31]}}})


def observations(log):
    return [from_json(body) for (body,) in rows(log, "SELECT body FROM records WHERE stage = 0 ORDER BY pass")]


def dropped(log):
    with store(log) as opened:
        return opened.dropped(0)


def refused(log):
    """Return what was refused; that which came late from an Execute that had ended is rightly so."""
    texts = [text for (text,) in rows(log, "SELECT text FROM events WHERE kind = 'refused'")]
    return [text for text in texts if not text.startswith("another execute has joined since")]


@pytest.fixture
def adopted(monkeypatch):
    """List the passes of the plans that any Execute puts in force."""
    passes, true_adopt = [], Execute.adopt

    def adopt(self, plan):
        passes.append(plan.pass_no)
        return true_adopt(self, plan)

    monkeypatch.setattr(Execute, "adopt", adopt)
    return passes


def test_execute_restarts_across_a_gap_of_dropped_episodes_that_have_no_plans(here, adopted):
    with Roles(free(1200, backlog=40), here) as run:
        Paced.free.set()
        run.start_all()
        run.wait_for_pass(40)
        run.close()
        run.until(lambda: run.roles["execute"].units[0].dropped, "more episodes than are held back")
        run.open()
        _, final = run.until(lambda: dropped(run.path), "a gap")[0]
        run.until(lambda: observations(run.path)[-1].plan > final, "an episode under a plan from after it")
        run.end("execute")
        adopted.clear()
        run.start("execute")
        run.until(lambda: adopted, "a plan after the restart")
        with store(run.path) as log:
            kept, gaps = log.snapshot(0, "execute").pass_no, log.dropped(0)
        run.join()
        assert run.last == (1200,) * 4
    # Its state is that after the last gap (a busy machine makes more of them), under a plan from before its end.
    assert 40 < adopted[0] <= max(last for _, last in gaps if last < kept) + 1
    # What was dropped was planned by nobody.
    missing = {number for first, last in dropped(run.path) for number in range(first, last + 1)}
    assert adopted == [number for number in range(adopted[0], 1201) if number not in missing]
    assert refused(run.path) == []


@pytest.mark.long
def test_a_restarted_execute_puts_the_plans_in_force_that_came_while_it_was_behind_with_them(here, adopted):
    with Roles(free(1000), here, snapshot_every=20) as run:
        Paced.free.set()
        run.start_all()
        run.wait_for_pass(40)
        for role in OTHERS:
            run.end(role)
        driven = run.last[0]
        run.until(lambda: run.last[0] >= driven + 100, "episodes without plans")
        run.end("execute")
        with store(run.path) as log:
            kept = log.snapshot(0, "execute").pass_no
        adopted.clear()
        run.start("execute")
        back = run.last[0]
        run.until(lambda: run.last[0] > back + 10, "episodes after the restart")
        for role in OTHERS:
            run.start(role)
        run.join()
        assert run.last == (1000,) * 4
    assert adopted[0] < kept - 50, "the state was not far ahead of its plan"
    assert adopted == [*range(adopted[0], 1001)]
    seen = observations(run.path)
    assert [one.pass_no for one in seen] == [*range(1, 1001)]
    assert refused(run.path) == []


@pytest.mark.long
def test_behind_a_rate_that_cannot_be_reached_plans_and_acknowledgements_are_heard(here):
    """In processes: on threads Execute would keep the others from their work."""
    backlog, total = 200, 8000
    config = write_config(here, json.loads(free(total, 1e5, backlog, "python").to_json()) | {"analyze": "changes"})
    with up(config) as running:
        result = running.result()
    seen, gaps = observations(running.log), dropped(running.log)
    plans = sorted({one.plan for one in seen})
    print(f"{len(seen)} episodes in the log, {len(gaps)} gaps {gaps[:9]}; {len(plans)} plans, up to {plans[-1]}")
    missing = sum(final - first + 1 for first, final in gaps)
    assert len(seen) + missing == total
    assert result["trials"][0]["dropped"] == missing
    assert f"dropped:  {missing:,} episodes of which there is no record" in running.process.said
    # Who hears nothing fills its backlog once, and drives on under plan 0.
    assert len(seen) > 2 * backlog
    assert plans[-1] > backlog
    assert len(plans) > 2
    # Once full, the backlog is half empty before it takes again: gaps are few, and not one for each place.
    between = [after - final - 1 for (_, final), (after, _) in pairwise(gaps)]
    assert all(taken >= backlog // 2 for taken in between), between
