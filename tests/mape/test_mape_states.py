"""A fresh component that takes up the state of another goes on as that one would have."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from mape_configs import EPISODES, configs, gridworlds, junctions
from mape_runs import GRID, TRAFFIC, Carrying, Corridor, config, corridor_loop, hashes, loop_of

from adapters.systems import make_system
from knowledge import STAGES, ChangePlan, Observation, QTable
from mape.config import from_table
from mape.errors import ConfigError, ManagedSystemError, PartError
from mape.execute.uniforms import Uniforms
from mape.loop import Loop
from mape.parts import config_at

CALLED = {
    "frozen_lake": {"id": "FrozenLake-v1", "options": {"map_name": "4x4"}},
    "taxi": {"id": "Taxi-v4", "max_steps": 40},
    "cliff": {"id": "CliffWalking-v1", "max_steps": 30},
}


class Counting(Carrying):
    """It says how far it is."""

    def get_state(self):
        return {"played": self.played, "enabled": list(self.enabled)}

    def set_state(self, state):
        self.played, self.enabled = state["played"], tuple(state["enabled"])


def travelled(state):
    return json.loads(json.dumps(state, allow_nan=False))


def taken_up(chosen, after, make, trial=0):
    """Run `after` passes, and give their records and what the components carry to a loop that is made anew."""
    first = Loop(chosen, make(chosen.system), trial)
    records, states = [], {}
    for kind in STAGES:
        first.bus.subscribe(kind, records.append)

    def take(record):
        if record.pass_no == after:
            if isinstance(record, Observation):  # sent, and no plan has answered it
                states["execute"], states["monitor"] = first.execute.state(), first.monitor.state()
            else:
                states["analyze"], states["plan"] = first.analyze.state(), first.plan.state()

    first.bus.subscribe(Observation, take)
    first.bus.subscribe(ChangePlan, take)
    first.run(after)

    left = tuple(swap for swap in chosen.swap if swap.pass_no > after)
    heir = Loop(config_at(chosen, after).model_copy(update={"swap": left}), make(chosen.system), trial)
    for record in records:
        heir.log.append(record)
    execute, table = states["execute"]
    heir.execute.restore(travelled(execute), table)
    for name in ("monitor", "analyze", "plan"):
        getattr(heir, name).restore(travelled(states[name]))
    heir.knowledge.plan = records[-1]
    heir.execute.adopt(records[-1])
    return heir


def outcome(loop, passes):
    try:
        loop.run(passes)
    except ManagedSystemError as error:
        return str(error), loop.log.passes, loop.execute.q_table.sha256()
    return hashes(loop)


@pytest.mark.parametrize("engine", ["compiled", "python"])
@pytest.mark.parametrize("systems", [gridworlds(), junctions()], ids=["gridworld", "junction"])
@settings(max_examples=8)
@given(st.data())
def test_a_run_that_is_taken_up_after_any_pass_is_the_run_in_one_piece(systems, engine, data):
    table = data.draw(configs(systems))
    table["execute"]["engine"] = engine
    after, trial = data.draw(st.integers(1, EPISODES - 1)), data.draw(st.integers(0, 2))
    chosen = from_table(table)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("mape.execute.uniforms.DRAWS_AT_ONCE", data.draw(st.sampled_from([1, 150, 8192])))
        try:
            whole = loop_of(chosen, trial=trial)
        except ConfigError:
            assume(False)  # no such grid: a goal that cannot be reached, say
        wanted = outcome(whole, EPISODES)
        assume(whole.log.passes > after)
        heir = taken_up(chosen, after, make_system, trial)
        assert outcome(heir, EPISODES - after) == wanted


@pytest.mark.parametrize("after", [1, 5, 11])
@pytest.mark.parametrize("learner", ["q_learning", "expected_sarsa"])
@pytest.mark.parametrize("name", CALLED)
def test_a_run_on_an_environment_that_only_a_reset_knows_is_taken_up_too(name, learner, after):
    chosen = from_table({
        "episodes": 14,
        "system": CALLED[name],
        "learner": learner,
        "monitor": {"detectors": [{"name": "page_hinkley", "threshold": 2.0}]},
        "plan": {"name": "morphin", "schedule": {"name": "geometric", "factor": 0.9}},
        "execute": {"mask_greedy": name == "taxi"},
    })  # fmt: skip
    whole = loop_of(chosen)
    whole.run(14)
    heir = taken_up(chosen, after, make_system)
    heir.run(14 - after)
    assert hashes(heir) == hashes(whole)


@pytest.mark.parametrize("after", range(1, 10))
@pytest.mark.parametrize("make", [Corridor, Counting], ids=["without a state of its own", "with one"])
def test_what_plans_have_enabled_is_enabled_again(make, after):
    chosen = from_table({
        "episodes": 10,
        "system": {"id": "corridor"},
        "monitor": {"detectors": [{"name": "oracle", "episodes": [4]}]},
        "plan": {"name": "morphin", "enable_on_drift": [5, 3]},
    })  # fmt: skip
    whole = Loop(chosen, make())
    whole.run(10)
    assert whole.execute.q_table.actions == (0, 1, 5, 3)
    heir = taken_up(chosen, after, lambda _: make())
    heir.run(10 - after)
    assert hashes(heir) == hashes(whole)


@pytest.mark.parametrize("after", range(1, 10))
def test_a_run_whose_first_actions_have_all_gone_is_taken_up_with_those_of_now(after):
    chosen = from_table({"episodes": 10, "system": {"id": "corridor"}})

    def offers(episode):
        return (0, 1) if episode < 3 else (0, 1, 2, 3) if episode < 6 else (2, 3)

    whole = Loop(chosen, Corridor(offers=offers))
    whole.run(10)
    assert whole.execute.q_table.actions == (2, 3)
    heir = taken_up(chosen, after, lambda _: Corridor(offers=offers))
    heir.run(10 - after)
    assert hashes(heir) == hashes(whole)


@pytest.mark.parametrize("after", range(1, 9))
def test_a_run_with_swaps_is_taken_up_with_the_parts_that_serve_it_then(after):
    swaps = [
        {"pass": 3, "part": "plan", "to": {"name": "q_learning", "schedule": {"name": "constant", "epsilon": 0.4}}},
        {"pass": 5, "part": "learner", "to": "expected_sarsa"},
        {"pass": 5, "part": "monitor", "to": {"name": "two_window", "reference": 2, "recent": 2, "threshold": 0.5}},
        {"pass": 7, "part": "plan", "to": "morphin"},
    ]
    chosen = config(TRAFFIC, swap=swaps)
    whole = loop_of(chosen)
    whole.run(10)
    heir = taken_up(chosen, after, make_system)
    heir.run(10 - after)
    assert hashes(heir) == hashes(whole)


def test_an_execute_takes_up_a_state_from_before_the_first_episode():
    plain, used = loop_of(config(TRAFFIC)), loop_of(config(TRAFFIC))
    used.execute.restore(*plain.execute.state())
    plain.run(5)
    used.run(5)
    assert hashes(plain) == hashes(used)


def test_where_only_a_reset_tells_the_actions_there_is_no_state_before_the_first_one():
    loop = corridor_loop()
    with pytest.raises(PartError, match="there is no Q-table yet"):
        loop.execute.state()
    loop.run(1)
    assert loop.execute.state()[1].actions


def test_a_state_that_was_given_does_not_change_with_what_is_driven_after_it():
    loop = loop_of(config(TRAFFIC))
    loop.run(3)
    state, table = loop.execute.state()
    before = json.dumps(state), table.sha256()
    loop.run(4)
    assert (json.dumps(state), table.sha256()) == before


@given(st.integers(1, 300), st.lists(st.integers(0, 2000), max_size=6), st.integers(0, 2**63 - 1))
def test_the_uniforms_of_a_pass_are_the_same_whatever_was_asked_for_before(width, before, seed):
    asked, fresh = Uniforms(seed, (1, 2), width), Uniforms(seed, (1, 2), width)
    for passes in [*before, 700]:
        at = asked.find(passes)
    found = fresh.find(700)
    np.testing.assert_array_equal(asked.values[at : at + width], fresh.values[found : found + width])


class Stateless:
    """Has the members that a run asks for, and no state to give."""

    direction, statistic = "down", None
    epsilon = 0.5

    def update(self, x):
        return False

    def reset(self):
        pass

    def analyze(self, symptom):
        raise NotImplementedError

    def start(self, loop):
        raise NotImplementedError

    plan = start


def component(kind, part):
    loop = corridor_loop(monitor={"detectors": ["page_hinkley"]})
    if kind == "detector":
        loop.monitor.detectors = (("return", part),)
        return loop.monitor
    if kind == "analyzer":
        loop.analyze.analyzer = part
        return loop.analyze
    loop.plan.planner = part
    return loop.plan


KINDS = ["detector", "analyzer", "planner"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_part_without_state_is_named_when_it_is_asked_for(kind):
    asked = component(kind, Stateless())
    with pytest.raises(PartError, match=rf"{kind} Stateless has no state\(\).*give it state\(\) and restore\(\)"):
        asked.state()
    with pytest.raises(PartError, match=rf"{kind} Stateless has no restore\(\)"):
        asked.restore([None])


@pytest.mark.parametrize("kind", KINDS)
def test_a_part_that_raises_over_its_state_is_named(kind):
    def refuse(*state):
        raise KeyError("n")

    asked = component(kind, SimpleNamespace(state=refuse, restore=refuse))
    with pytest.raises(PartError, match=rf"{kind} SimpleNamespace raised KeyError: 'n', at state\(\)"):
        asked.state()
    with pytest.raises(PartError, match=r"raised KeyError: 'n', at restore\(\) of None"):
        asked.restore([None] if kind == "detector" else None)


@pytest.mark.parametrize("state", [None, {}, [], [1, 2], "ab"])
def test_a_monitor_takes_a_state_for_each_of_its_detectors(state):
    with pytest.raises(PartError, match="give a state for each of 1"):
        loop_of(config()).monitor.restore(state)


def spoilt(**fields):
    return lambda state: state | fields


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda state: None, "cannot go on from None"),
        (lambda state: {}, "cannot go on from {}: KeyError"),
        (spoilt(passes="3"), "passes '3'"),
        (spoilt(plan={"schema": "ChangePlan/1"}), "MalformedRecord"),
        (spoilt(available=None), "TypeError"),
    ],
)
def test_an_execute_says_from_what_it_cannot_go_on(spoil, says):
    loop = loop_of(config())
    loop.run(3)
    state, table = loop.execute.state()
    with pytest.raises(PartError, match=says):
        loop_of(config()).execute.restore(spoil(state), table)


def test_an_execute_takes_no_table_of_another_system():
    state, _ = loop_of(config()).execute.state()
    with pytest.raises(PartError, match="cannot go on with a Q-table of 7 states; mapek/Gridworld-v0 has 20"):
        loop_of(config()).execute.restore(state, QTable((0, 1, 2, 3), 7))


def test_a_system_that_does_not_take_up_its_state_is_named():
    state, table = loop_of(config(TRAFFIC)).execute.state()
    state["system"] = {"enabled": [99]}
    with pytest.raises(ManagedSystemError, match=r"TrafficJunction-v0 raised ValueError: .*99.* go on from the state"):
        loop_of(config(TRAFFIC)).execute.restore(state, table)


def test_a_system_that_raises_when_asked_for_its_state_is_named():
    class Mute(Corridor):
        def get_state(self):
            raise OSError("no answer")

    with pytest.raises(ManagedSystemError, match="corridor raised OSError: no answer, when it was asked for its state"):
        corridor_loop(Mute()).execute.state()


@pytest.mark.parametrize("base", [GRID, TRAFFIC], ids=["gridworld", "junction"])
def test_the_states_of_all_components_are_plain_json(base):
    loop = loop_of(config(base))
    loop.run(6)
    states = [loop.monitor.state(), loop.analyze.state(), loop.plan.state(), loop.execute.state()[0]]
    assert travelled(states) == states
