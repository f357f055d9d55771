"""Links cut one way or both for up to a minute: the loop goes on with equal hashes, a free system all along."""

import itertools
import json
import threading

import pytest
from bad_networks import alone, deployed, grid
from real_processes import last, passes, rows, until
from user_space_switch import why_not

from knowledge import from_json

REASON = why_not()
pytestmark = [pytest.mark.skipif(REASON is not None, reason=str(REASON)), pytest.mark.long, pytest.mark.timeout(900)]

WAYS = {"both ways": (True, True), "to Knowledge": (True, False), "from Knowledge": (False, True)}


def pause(seconds):
    threading.Event().wait(seconds)


@pytest.mark.parametrize("seconds", [6, 60])
@pytest.mark.parametrize("way", WAYS)
def test_a_loop_whose_links_were_cut_goes_on_where_it_was(here, way, seconds):
    table = grid(120)
    there, back = WAYS[way]
    with deployed(here, table, "--snapshot-every", "20", delay=0.02) as run:
        run.start_all()
        for role, number in (("monitor", 10), ("execute", 40)):
            until(lambda number=number: passes(run.log) >= number, f"pass {number}", 200)
            run.cut(role, there=there, back=back)
            pause(seconds)
            run.cut(role, there=False, back=False)
        assert run.end() == alone(table)


@pytest.mark.parametrize("way", WAYS)
def test_a_free_running_system_is_driven_on_while_its_link_is_cut(here, way):
    episodes, rate = 2400, 40.0
    table = grid(episodes, {"execute": {"mode": "free", "rate": rate, "backlog": 10_000}})
    there, back = WAYS[way]
    with deployed(here, table, delay=0.02) as run:
        run.start_all()
        until(lambda: passes(run.log) >= 40, "a run that is on its way", 200)
        reached = last(run.log)[0]
        run.cut("execute", there=there, back=back)
        pause(20)
        run.cut("execute", there=False, back=False)
        # What was driven meanwhile comes now, all of it, and in order.
        until(lambda: last(run.log)[0] > reached + 10 * rate, "the episodes of the cut", 200)
        run.end()
        found = rows(run.log, "SELECT body FROM records WHERE stage = 0 ORDER BY pass")
        dropped = rows(run.log, "SELECT * FROM dropped")
    seen = [from_json(body) for (body,) in found]
    assert [one.pass_no for one in seen] == list(range(1, episodes + 1))
    assert dropped == []
    plans = [one.plan for one in seen]
    assert plans == sorted(plans)
    assert all(after.age >= 0 for after in seen)
    # Those of the cut were driven under the last plan that had come.
    longest = max(len(list(group)) for _, group in itertools.groupby(plans))
    print(f"{way}: {longest} episodes under one plan")
    assert longest > 5 * rate
    assert json.loads((here / "served" / "result.json").read_bytes())["passes"] == episodes
