"""Execute after what broke off: it goes on where it was, and resets the managed system for no episode that is over."""

import itertools
import json

import pytest
from mape_interrupts import stopped_by_ctrl_c
from mape_runs import Corridor, config, corridor_loop, hashes, loop_of

from knowledge import ChangePlan, Knowledge, Log, QTable
from mape.config import from_table
from mape.errors import ManagedSystemError, PartError
from mape.execute import component, episode
from mape.loop import build_execute, layout_of

# An interrupt does not un-learn what is learnt

SMALL = {"system": {"options": {"max_steps": 4}}, "monitor": {"detectors": []}}


@pytest.mark.parametrize("method", ["drive", "_tried", "_attempt"])
@pytest.mark.parametrize("engine", ["compiled", "python"])
def test_an_interrupt_on_the_way_to_an_episode_leaves_the_one_before_learnt(engine, method):
    whole = loop_of(config(**SMALL, execute={"engine": engine}))
    whole.run(3)
    learnt = [whole.execute.q_table.sha256()]
    whole.execute.drive()
    learnt.append(whole.execute.q_table.sha256())
    for line in itertools.count():
        loop = loop_of(config(**SMALL, execute={"engine": engine}))
        loop.run(3)
        if not stopped_by_ctrl_c(loop.execute.drive, getattr(component.Execute, method).__code__, line):
            break
        assert loop.execute.q_table.sha256() in learnt
    assert line > (10 if method == "_attempt" else 1)


@pytest.mark.parametrize("line", range(12))
def test_after_an_interrupt_of_an_episode_it_is_driven_again_to_the_same_bits(line):
    whole, loop = (loop_of(config(**SMALL, execute={"engine": "python"})) for _ in range(2))
    whole.run(8)
    loop.run(3)
    assert stopped_by_ctrl_c(loop.execute.drive, episode.episode.__code__, line)
    loop.run(5)
    assert hashes(loop) == hashes(whole)


def test_a_table_that_was_just_put_in_force_is_not_rolled_back_to_another_ones_values():
    loop = corridor_loop()
    loop.run(3)
    execute = loop.execute
    key = loop.knowledge.remember(QTable((0, 1), 5))
    execute.adopt(execute.plan._replace(pass_no=4, adopt=key))
    execute.roll_back()
    assert not execute.q_table.values.any()


# What is refused is refused again


def test_withdrawn_actions_are_refused_however_often_the_episode_is_driven():
    corridor = Corridor(offers=lambda episode: (0, 1) if episode < 4 else (2, 3))
    loop = corridor_loop(corridor)
    loop.run(3)
    for _ in range(3):
        with pytest.raises(ManagedSystemError, match=r"offers actions \(2, 3\), of which the Q-table knows none"):
            loop.execute.drive()
        assert loop.execute.available == (0, 1)
    assert (loop.log.passes, len(loop.log.open_records)) == (3, 0)


def test_actions_that_come_back_are_used_by_the_episode_that_was_refused():
    withdrawn = [True]

    def offers(episode):
        return (2, 3) if episode == 4 and withdrawn[0] else (0, 1)

    whole, loop = corridor_loop(), corridor_loop(Corridor(offers=offers))
    whole.run(8)
    loop.run(3)
    with pytest.raises(ManagedSystemError, match="of which the Q-table knows none"):
        loop.execute.drive()
    # A plan with another learning rate takes the rows anew.
    plan = loop.execute.plan
    loop.execute.adopt(plan._replace(learning_rate=(0.5, 0.9, 5.0)))
    loop.execute.adopt(plan)
    withdrawn[0] = False
    loop.run(5)
    assert hashes(loop) == hashes(whole)


# What goes on from a state begins nothing that is over


class Plant(Corridor):
    """Cannot be driven again; says how often it was begun."""

    redrivable = False

    def get_state(self):
        return {"begun": len(self.begun)}

    def set_state(self, state):
        self.taken_up = state


def executes(system, sent, checkpoint=None):
    chosen = from_table({"name": "corridor", "episodes": 10, "system": {"id": "corridor"}})
    knowledge = Knowledge(Log(layout_of(chosen, system)))
    return build_execute(chosen, system, knowledge, sent.append, checkpoint=checkpoint), knowledge


def driven(execute, passes):
    for _ in range(passes):
        execute.drive()


PLAN = ChangePlan(0, 0, 0.5, (0.1, 0.99, 5.0), (), (), (), False, None)


@pytest.mark.parametrize("make", [Corridor, Plant])
def test_an_execute_that_goes_on_from_a_state_resets_its_system_for_the_next_episode_alone(make):
    whole, first, heir = make(), make(), make()
    undisturbed, heard = [], []
    one, _ = executes(whole, undisturbed)
    one.adopt(PLAN)
    driven(one, 7)
    other, _ = executes(first, heard)
    other.adopt(PLAN)
    driven(other, 4)
    state, table = other.state()

    successor, knowledge = executes(heir, heard, (json.loads(json.dumps(state)), table))
    assert heir.begun == []
    assert (successor.passes, successor.plan, knowledge.actions) == (4, PLAN, (0, 1))
    assert successor.q_table.sha256() == knowledge.q_table().sha256() == table.sha256()
    if make is Plant:
        assert heir.taken_up == {"begun": 4}
    driven(successor, 3)

    assert [told.number for told in heir.begun] == [5, 6, 7]
    assert heard == undisturbed
    assert successor.q_table.sha256() == one.q_table.sha256()


def test_without_a_state_the_first_reset_tells_the_actions_and_is_that_of_episode_1():
    corridor = Corridor(offers=lambda episode: (3, 1))
    execute, knowledge = executes(corridor, [])
    assert (corridor.begun, execute.available, knowledge.actions) == ([], (), ())
    with pytest.raises(PartError, match="corridor has, its first reset tells, which is that of episode 1"):
        knowledge.q_table()
    execute.adopt(PLAN)
    assert corridor.begun == []
    driven(execute, 1)
    assert (execute.available, knowledge.actions) == ((3, 1), (3, 1))
    driven(execute, 1)
    assert [told.number for told in corridor.begun] == [1, 2]


def test_a_first_plan_that_changes_the_table_begins_the_episode_that_follows_it():
    corridor = Corridor()
    execute, _ = executes(corridor, [])
    execute.adopt(PLAN._replace(add=(4,)))
    assert ([told.number for told in corridor.begun], execute.q_table.actions) == ([1], (0, 1, 4))
    driven(execute, 2)
    assert [told.number for told in corridor.begun] == [1, 2]


def test_an_execute_is_not_made_of_a_state_that_does_not_fit():
    loop = corridor_loop()
    loop.run(1)
    state, table = loop.execute.state()
    with pytest.raises(PartError, match="cannot go on with a Q-table of 9 states; corridor has 5"):
        executes(Corridor(), [], (state, QTable((0, 1), 9)))
    with pytest.raises(PartError, match="Execute cannot go on from"):
        executes(Corridor(), [], ({**state, "passes": "4"}, table))


# A plan that is refused changes nothing


def test_a_plan_that_drops_all_for_an_action_that_comes_only_with_a_reset_is_refused():
    loop = corridor_loop()
    loop.run(2)
    before = loop.execute.q_table, loop.execute.q_table.sha256(), loop.execute.plan
    plan = loop.execute.plan._replace(pass_no=3, add=(7,), drop=(0, 1), enable=(7,))
    with pytest.raises(PartError, match=r"offers \(0, 1\), of which at least one must stay"):
        loop.execute.adopt(plan)
    assert (loop.execute.q_table, loop.execute.q_table.sha256(), loop.execute.plan) == before
    assert loop.system.enabled == ()
    loop.run(2)
