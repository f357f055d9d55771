"""A live swap that meets a restart, a refusal, a planned swap, or the end of the run."""

import sys
import threading
from types import SimpleNamespace

import pytest
from bus_small_loop import in_process
from real_processes import events, store
from roles_on_threads import Paced, Roles, paced

from mape.monitor.page_hinkley import PageHinkley
from mape.plan.exponential import Exponential
from mape.plan.morphin import Morphin


class Held(PageHinkley):
    """Page-Hinkley that does not go past some of its updates, or its making, before it may."""

    gates: dict[int, threading.Event] = {}  # noqa: RUF012

    def __init__(self, config):
        super().__init__(config)
        self.updates = 0
        self._pass()

    def update(self, x):
        self.updates += 1
        self._pass()
        return super().update(x)

    def _pass(self):
        if self.updates in self.gates:
            assert self.gates[self.updates].wait(60)


class Late(Exponential):
    """Keeps its contract wherever it is checked, can be made, and fails in its first pass in the thread of the role."""

    def advance(self, episode_return):
        self._fail()
        super().advance(episode_return)

    def reset(self):
        self._fail()
        super().reset()

    def _fail(self):
        if threading.current_thread().name == "plan":
            raise ZeroDivisionError("no budget left")


class Waits(Morphin):
    """Makes no plan of these passes before it may."""

    gates: dict[int, threading.Event] = {}  # noqa: RUF012

    def plan(self, request, knowledge):
        if request.pass_no in self.gates:
            assert self.gates[request.pass_no].wait(60)
        return super().plan(request, knowledge)


class Endless(Morphin):
    """Is still being made when the run is over."""

    over = threading.Event()

    def __init__(self, *given, **parts):
        assert self.over.wait(60)
        super().__init__(*given, **parts)


@pytest.fixture(autouse=True)
def own(monkeypatch):
    parts = SimpleNamespace(Held=Held, Late=Late, Waits=Waits, Endless=Endless)
    monkeypatch.setitem(sys.modules, "own", parts)
    monkeypatch.setattr(Waits, "gates", {})
    monkeypatch.setattr(Held, "gates", {})
    Endless.over.clear()


def swapped(number, part, to):
    return {"pass": number, "part": part, "to": to}


def alone(config):
    Paced.free.set()
    return in_process(config).log.sha256()


def test_a_swap_while_a_restarted_role_does_logged_passes_again_takes_effect_beyond_the_log(here):
    watched, to = {"monitor": {"detectors": ["own:Held"]}}, {"name": "page_hinkley", "threshold": 1.0}
    come, checked = threading.Event(), threading.Event()
    with Roles(paced(80, watched), here) as run:
        run.start_all()
        run.wait_for_pass(40)
        run.end("monitor")
        logged = run.last[1]
        Held.gates.update({0: come, 20: checked})
        run.start("monitor")
        monitor = run.roles["monitor"]
        run.until(lambda: monitor.member.joined.epoch, "the monitor to join")
        answer = run.ask_for("monitor.0", to, "monitor")
        run.until(lambda: not monitor.member._arrived.empty(), "the question")
        come.set()  # it came before the log did
        run.until(lambda: monitor._vetted or run.wanted("monitor"), "the new part to have been checked")
        assert monitor.units[0].sent < 20
        checked.set()
        (number,) = answer().passes
        assert number > logged >= 40
        digest = run.hash()
    assert events(run.path, "refused") == []
    assert digest == alone(paced(80, {**watched, "swap": [swapped(number, "monitor.0", to)]}))


def test_after_a_schedule_that_was_refused_the_next_planner_has_the_old_one(here):
    to = {"name": "morphin", "k": 9.0}
    with Roles(paced(60), here) as run:
        run.start_all()
        run.wait_for_pass(10)
        refused = run.ask_for("plan.schedule", {"name": "own:Late"}, "plan")()
        assert "'own:Late' was refused" in refused
        assert "no budget left, at pass" in refused
        (number,) = run.ask_for("plan", to, "plan")().passes
        digest = run.hash()
    assert digest == alone(paced(60, {"swap": [swapped(number, "plan", to)]}))


def test_of_a_planned_and_a_live_swap_at_one_pass_the_planned_one_is_first_whoever_drives_it(here):
    planned = {"plan": {"name": "own:Waits"}, "swap": [swapped(20, "learner", "expected_sarsa")]}
    held, on = threading.Event(), threading.Event()
    Waits.gates.update({19: held, 25: on})
    with Roles(paced(40, planned), here) as run:
        run.start_all()
        run.until(lambda: run.last[2] == 19, "the request for plan 19")
        answer = run.ask_for("learner", {"name": "q_learning"}, "execute")
        run.until(lambda: run.wanted("execute"), "the new learner to be let in")
        held.set()
        assert answer().passes == (20,)
        run.until(lambda: run.last[2] == 25, "the request for plan 25")
        run.again("execute")  # and does all again, for none of its states was kept
        run.until(lambda: run.roles["execute"].units and run.roles["execute"].units[0].sent == 25, "pass 25, again")
        on.set()
        digest = run.hash()
    with store(run.path) as log:
        assert [(s.pass_no, s.spec, s.planned) for s in log.swaps()] == [(20, {"name": "q_learning"}, False)]
    # For the next start, and for a replay. Asked for was the learner that there was before the planned one.
    assert digest == alone(paced(40, planned | {"swap": []})) != alone(paced(40, planned))


def test_who_asks_for_a_part_that_is_not_ready_before_the_end_is_told_that_the_run_is_over(here):
    with Roles(paced(30), here) as run:
        run.start_all()
        run.wait_for_pass(5)
        answer = run.ask_for("plan", {"name": "own:Endless"}, "plan")
        run.until(lambda: run.roles["plan"]._unanswered, "the question to have come")
        digest = run.hash()
        assert answer() == "plan stays as it is, 'own:Endless' was refused: the run is over"
        Endless.over.set()
    assert [event.kind for event in events(run.path)].count("swap refused") == 1
    assert digest == alone(paced(30))


def test_who_asks_for_a_learner_in_the_last_pass_is_told_that_the_run_is_over(here):
    held = threading.Event()
    Waits.gates[30] = held
    with Roles(paced(30, {"plan": {"name": "own:Waits"}}), here) as run:
        run.start_all()
        Paced.free.set()
        run.until(lambda: run.last[2] == 30, "the last request")
        answer = run.ask_for("learner", {"name": "expected_sarsa"}, "execute")
        run.until(lambda: run.wanted("execute"), "the new learner to be let in")
        held.set()
        run.hash()
        assert answer() == "learner stays as it is, 'expected_sarsa' was refused: the run is over"
