"""`mapek swap` on a running loop: from the pass that it names on, as if the config had said so; or not at all."""

import json
import os
import re
import signal
import threading

import pytest
from process_chaos import LONGER_THAN_LEASE
from real_processes import (
    EXAMPLES,
    events,
    hashes,
    looking_on,
    records,
    run_here,
    started,
    store,
    swap,
    until,
    up,
    write_config,
)

from knowledge import ChangePlan, from_json
from mape import load

EPISODES = 400

OWN = '''
import time
from pathlib import Path

from mape.plan.morphin import Morphin


class SecondFails(Morphin):
    """Serves the first loop, and not the second."""

    def plan(self, request, knowledge):
        if knowledge.log.loop == 1:
            raise ZeroDivisionError("no budget for a second loop")
        return super().plan(request, knowledge)


class Gentle(Morphin):
    """MORPHIN that explores in at most an eighth of the steps; takes over Morphin's state."""

    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        return plan._replace(epsilon=min(plan.epsilon, 0.125))


class Late(Gentle):
    """Keeps its contract wherever `mapek check` looks, and fails over a pass of a run that is well under way."""

    def plan(self, request, knowledge):
        if knowledge.log.passes > 50 or request.pass_no > 50:
            raise ZeroDivisionError("no budget left")
        return super().plan(request, knowledge)


class Broken(Gentle):
    def plan(self, request, knowledge):
        return super().plan(request, knowledge)._replace(epsilon=1.5)


class OneRate(Gentle):
    def start(self, loop):
        return super().start(loop)._replace(learning_rate=(0.1,))

    def plan(self, request, knowledge):
        return super().plan(request, knowledge)._replace(learning_rate=(0.1,))


class Waits(Gentle):
    """Whose check begins, and ends when it is told to."""

    def start(self, loop):
        Path("check-began").touch()
        while not Path("check-may-end").exists():
            time.sleep(0.01)
        return super().start(loop)
'''


@pytest.fixture
def config(here, walk):
    table = json.loads(load(EXAMPLES / "gridworld_goals.toml").to_json())
    table["system"]["options"]["switch_at"] = [51, 301]
    table |= {"episodes": EPISODES, "analyze": walk.part}
    (here / "own_parts.py").write_text(OWN)
    return write_config(here, table)


def pass_named(said):
    found = re.match(r"from pass (\d+) on", said)
    assert found is not None, said
    return int(found[1])


def with_swaps(config, made):
    table = json.loads(config.read_text())
    table["swap"] = [{"pass": number, "part": part, "to": to} for number, part, to in made]
    path = config.parent / "swaps.json"
    path.write_text(json.dumps(table))
    return path


def plan_of(log, number):
    with store(log) as opened:
        record = from_json(opened.body(0, number, 3))
    assert isinstance(record, ChangePlan)
    return record


@pytest.mark.long
def test_a_swap_is_what_the_config_would_have_said(config, walk):
    swaps = [
        ("plan", "own_parts:Gentle", {"name": "own_parts:Gentle"}),
        ("monitor", '{name="two_window", reference=20, recent=5, threshold=30.0}',
         {"name": "two_window", "reference": 20, "recent": 5, "threshold": 30.0}),
        ("plan.schedule", '{name="constant", epsilon=0.0625}', {"name": "constant", "epsilon": 0.0625}),
        ("learner", "expected_sarsa", {"name": "expected_sarsa"}),
    ]  # fmt: skip
    owners = {"plan": "plan", "monitor": "monitor", "plan.schedule": "plan", "learner": "execute"}
    made = []
    with up(config, "--snapshot-every", "35") as running:
        for part, to, spec in swaps:
            running.wait_for_pass(made[-1][0] + 15 if made else 60)
            before = running.passes()
            code, said = swap(running, part, to)
            assert (code, part in said) == (0, True), said
            # The process that has just answered dies: from the same pass on, its successor works with the new part.
            os.kill(running.child(owners[part]), signal.SIGKILL)
            number = pass_named(said)
            assert before < number <= running.passes() + 2
            made.append((number, part, spec))
        walk.over()
        result = running.result()
    assert [event.pass_no for event in events(running.log, "swapped")] == [number for number, _, _ in made]
    first, _, other, _ = (number for number, _, _ in made)
    assert plan_of(running.log, first).epsilon <= 0.125
    assert [plan_of(running.log, n).epsilon for n in (other, EPISODES)] == [0.0625, 0.0625]
    assert records(running.log) == {0: 4 * EPISODES + 1}
    assert events(running.log, "refused") == []
    told = run_here(with_swaps(config, made))
    assert hashes(result) == hashes(told)
    assert result["trials"][0]["alarms"] == told["trials"][0]["alarms"]


@pytest.mark.long
def test_a_swap_reaches_a_role_that_is_just_being_started_again(config, walk):
    with up(config) as running:
        running.wait_for_pass(60)
        with looking_on(running.endpoint) as ask:
            os.kill(running.child("plan"), signal.SIGKILL)
            until(lambda: (status := ask()) and not status.roles["plan"].alive, "its absence")
        code, said = swap(running, "plan", "own_parts:Gentle")
        assert code == 0, said
        walk.over()
        running.result()
    assert [event.pass_no for event in events(running.log, "swapped")] == [pass_named(said)]


@pytest.mark.long
def test_a_swap_whose_answer_is_lost_is_asked_for_again_and_made_once(config, walk):
    asked = ("swap", "plan", "own_parts:Waits", "--connect")
    with up(config) as running:
        running.wait_for_pass(60)
        with started(*asked, running.endpoint, cwd=config.parent, name="swap") as asking:
            until((config.parent / "check-began").exists, "the check to begin")
            os.kill(running.child("knowledge"), signal.SIGSTOP)
            threading.Event().wait(LONGER_THAN_LEASE)  # who asks loses the link, and with it the answer
            os.kill(running.child("knowledge"), signal.SIGCONT)
            (config.parent / "check-may-end").touch()
            said = asking.end()
        walk.over()
        running.result()
    assert [event.pass_no for event in events(running.log, "swapped")] == [pass_named(said)]


def test_what_does_not_serve_is_refused_and_the_old_part_goes_on(config, walk):
    faulty = {
        ("plan", "own_parts:Late"): "no budget left",
        ("plan", "own_parts:Broken"): "epsilon",
        ("plan", "own_parts:OneRate"): "learning-rate parameters",
        ("plan", "morphine"): "did you mean 'morphin'",
        ("plan", '{name="morphin", alpah=0.2}'): "alpah",
        ("monitor", "page_hinkly"): "did you mean 'page_hinkley'",
        ("monitor", '{name="page_hinkley", signal="returns"}'): "returns",
        ("plan.schedule", "own_parts:Gentle"): "schedule",
        ("learner", "no_such_module:Learner"): "no_such_module",
        ("monitor.3", "page_hinkley"): "monitor.0",
        ("planner", "morphin"): "'plan'",
        ("plan", '{alpha=0.2}'): "names no part",
    }  # fmt: skip
    with up(config) as running:
        running.wait_for_pass(60)
        said = {}
        for part, to in faulty:
            said[part, to] = swap(running, part, to)
        assert not running.process.ended
        walk.over()
        result = running.result()
    for asked, (code, sentence) in said.items():
        assert code in (1, 2), (asked, sentence)
        assert faulty[asked] in sentence, (asked, sentence)
        assert sentence.count("\n") == 1, (asked, sentence)
    assert hashes(result) == hashes(run_here(config))
    assert records(running.log) == {0: 4 * EPISODES + 1}


@pytest.mark.long
def test_a_part_that_fails_in_one_of_two_loops_is_told_so(config, walk):
    with up(config, "--set", "loops=2", "--set", "episodes=300") as running:
        running.wait_for_pass(30)
        code, said = swap(running, "plan", "own_parts:SecondFails")
        taken = events(running.log, "swapped")
        walk.over()
        running.result()
    assert (code, "no budget for a second loop" in said) == (1, True)
    if taken:  # the first loop may have come first
        assert [event.loop for event in taken] == [0]
        assert f"loop 0 from pass {taken[0].pass_no} on" in said
    assert records(running.log) == {0: 1201, 1: 1201}
    assert events(running.log, "refused") == []
