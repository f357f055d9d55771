"""The five processes may be started in any order, on any machine of the run."""

import json
import sqlite3
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from itertools import permutations
from pathlib import Path

import pytest
from real_processes import EXAMPLES, ROLES, alone, end_all, endpoint, events, hashes, serve, until, up, write_config

from mape import load
from mape.errors import MapekError

SIDE_BY_SIDE = 3
FIRST = ("execute", "plan", "knowledge", "analyze", "monitor")
SOME = [
    *(FIRST[at:] + FIRST[:at] for at in range(len(FIRST))),
    ("knowledge", *ROLES[1:]),
    (*ROLES[1:], "knowledge"),
]
"""Seven: each role in each place; Knowledge first, and last, of the rest."""


def start_in(order, config, one_by_one):
    """Run a loop whose processes are started in an order; return the hashes, and what each role said."""
    name = "".join(role[0] for role in order)
    where, out = endpoint(config.parent, name), config.parent / name
    served = {}
    with ExitStack() as opened:
        for role in order:
            served[role] = opened.enter_context(serve(config, role, where, out=name))
            if one_by_one:
                until(lambda r=role: served[r].said or joined(out, r), f"{role} to be there", every=0.02)
        end_all(served)
        said = {role: process.said for role, process in served.items()}
    return hashes(json.loads((out / "result.json").read_bytes())), said


def joined(out, role):
    with suppress(MapekError, sqlite3.Error):  # it has not begun yet
        return any(event.role == role for event in events(out / "log.sqlite", "joined"))
    return False


def starts(here, orders):
    config = load(EXAMPLES / "gridworld_goals.toml", overrides=["episodes=20", "system.options.switch_at=[11]"])
    config = write_config(here, json.loads(config.to_json()))
    whole = alone(config)
    with ThreadPoolExecutor(SIDE_BY_SIDE) as side_by_side:
        # All at once, and each only when the one before is there.
        ended = side_by_side.map(lambda at: start_in(orders[at], config, at % 2 == 0), range(len(orders)))
        for at, (found, said) in enumerate(ended):
            assert found == whole, orders[at]
            yield at, orders[at], said


def waits(order, said):
    """Assert that who was there before the one whom it needs said for whom it waits."""
    for role in ROLES[1:]:
        if order.index(role) < order.index("knowledge"):
            assert f"{role}: waiting for Knowledge on unixsock-stream/" in said[role], order
        elif role != "execute" and order.index(role) < order.index("execute"):
            assert f"{role}: waiting for Execute, which has the managed system" in said[role], order


def test_the_processes_start_in_any_order(here):
    for at, order, said in starts(here, SOME):
        if at % 2 == 0:
            waits(order, said)


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_the_processes_start_in_all_orders(here):
    done = [waits(order, said) for at, order, said in starts(here, list(permutations(ROLES))) if at % 2 == 0]
    assert len(done) == 60


def test_what_lies_where_one_stands_takes_the_place_of_no_module_of_the_five(here):
    config = write_config(here, json.loads(load(EXAMPLES / "gridworld_goals.toml", overrides=["episodes=5"]).to_json()))
    for name in ("mapek", "mape", "adapters"):
        (here / name).mkdir()
    (here / "random.py").write_text("raise OSError('not the random of Python')")
    with up(config, start=(str(Path(sys.executable).with_name("mapek")),)) as running:
        assert hashes(running.result()) == alone(config)
