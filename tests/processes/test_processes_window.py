"""How far back a planner can read: in a process of its own no further than within one, so that both plan the same."""

import sys
import threading
from types import SimpleNamespace

import pytest
from bus_small_loop import in_process
from real_processes import until
from roles_on_threads import Paced, Roles, paced

from knowledge import STAGES, ChangePlan, Observation, QTable
from knowledge.store import TABLES
from mape.errors import PartError
from mape.plan.morphin import Morphin


class Digs(Morphin):
    """Plans by which of the records can still be read."""

    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        log, number = knowledge.log, request.pass_no
        found = [log.find(ChangePlan, 0), log.find(Observation, 0)]
        for back in (-1, 0, 1, 255, 256, 257):
            found += [log.find(kind, number - back) for kind in STAGES]
        oldest = 0
        for first in (number - 257, number - 256):
            try:
                read = list(log.since(first, 2))
                assert first > 0 or read[0].pass_no == 0
                oldest += sum(record.pass_no for record in read)
            except LookupError as error:
                oldest += len(str(error))
        seen = sum(0.01 for record in found if record is not None)
        later = [record.pass_no - number for record in log.since(number)]
        return plan._replace(epsilon=abs(plan.epsilon + seen + 1e-6 * oldest + sum(later) + 0.1 * len(later)) % 1.0)


class Remembers(Morphin):
    """Plans by which of the Q-tables it remembered can still be recalled, and adopts one of them."""

    def __init__(self, *options, **named):
        super().__init__(*options, **named)
        self.keys = []

    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        number = request.pass_no
        if number % 2:
            self.keys = [*self.keys, knowledge.remember(knowledge.q_table())][-TABLES - 3 :]
        if number % 3 == 0 and len(self.keys) > 4:  # a use of it: others go before it does
            knowledge.recall(self.keys[-4])
        if number % 7 == 0 and len(self.keys) > 5:
            return plan._replace(adopt=self.keys[-3])
        there = 0
        if number % 5 == 0:
            for key in self.keys:
                try:
                    there += int(knowledge.recall(key).values.sum() != number)
                except LookupError:
                    there += 100
        return plan._replace(epsilon=abs(plan.epsilon + there / 1000.0) % 1.0)

    def state(self):
        return [super().state(), self.keys]

    def restore(self, state):
        super().restore(state[0])
        self.keys = list(state[1])


class Forgetful(Morphin):
    """Adopts the first Q-table that it remembered, when that is no longer there."""

    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        key = knowledge.remember(knowledge.q_table())
        if request.pass_no == 1:
            self.first = key
        return plan._replace(adopt=self.first) if request.pass_no == TABLES + 4 else plan


class Spoils(Remembers):
    """Remembers as many Q-tables as there is room for, and fails; not while it is held against its contract."""

    def plan(self, request, knowledge):
        if threading.current_thread().name == "plan":
            for number in range(TABLES):
                knowledge.remember(QTable((0, 1), 5 + number))
            raise ZeroDivisionError("no budget left")
        return super().plan(request, knowledge)


@pytest.fixture(autouse=True)
def own(monkeypatch):
    parts = {one.__name__: one for one in (Digs, Remembers, Forgetful, Spoils)}
    monkeypatch.setitem(sys.modules, "own", SimpleNamespace(**parts))


def over_the_wire(config, folder, *, restart_at=None):
    with Roles(config, folder, snapshot_every=5) as run:
        run.start_all()
        if restart_at is None:
            Paced.free.set()
        else:
            run.wait_for_pass(restart_at)
            run.again("plan")
        run.until(lambda: run.ledger.complete, "the end")
        return run.hash()


def alone(config):
    Paced.free.set()
    return in_process(config).log.sha256()


def test_a_planner_finds_the_records_of_the_window_and_no_others(here):
    config = paced(275, {"plan": "own:Digs"})
    assert over_the_wire(config, here) == alone(config)


def test_a_planner_that_is_started_again_sees_nothing_that_was_not_there_the_first_time(here):
    config = paced(60, {"plan": "own:Digs"})
    assert over_the_wire(config, here, restart_at=23) == alone(config)


@pytest.mark.parametrize("restart_at", [None, 43])
def test_as_many_q_tables_stay_remembered_as_within_one_process(here, restart_at):
    """And the same ones; after a restart too."""
    config = paced(90, {"plan": "own:Remembers"})
    assert over_the_wire(config, here, restart_at=restart_at) == alone(config)


def test_what_a_refused_planner_remembered_takes_no_place(here):
    config = paced(90, {"plan": "own:Remembers"})
    with Roles(config, here) as run:
        run.start_all()
        run.wait_for_pass(25)
        said = run.ask_for("plan", {"name": "own:Spoils"}, "plan")()
        assert "ZeroDivisionError: no budget left" in said
        digest = run.hash()
    assert digest == alone(config)


def test_a_q_table_that_is_no_longer_remembered_is_adopted_nowhere(here):
    config = paced(20, {"plan": "own:Forgetful"})
    Paced.free.set()
    with pytest.raises(PartError, match=f"plan {TABLES + 4} cannot be executed: no Q-table .* is remembered") as alone:
        in_process(config)
    with Roles(config, here) as run:
        run.start_all()
        Paced.free.set()
        until(lambda: run.failed, "the end of Plan")
        (error,) = run.failed
    assert (type(error), str(error)) == (PartError, str(alone.value))
