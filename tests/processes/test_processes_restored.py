"""What is there again after a restart: of a planner, of a part with an odd state, of Knowledge, of a first episode."""

import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from bus_small_loop import in_process
from hypothesis import example, given
from hypothesis import strategies as st
from real_processes import events, store
from roles_on_threads import Paced, Roles, paced

from adapters.buses.messages import State
from adapters.processes import serve
from adapters.processes.role import plain
from adapters.roles import ROLES
from mape.errors import PartError
from mape.plan.morphin import Morphin


class Smooth(Morphin):
    """Explores half way between what MORPHIN wants and the plan in force."""

    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        return plan._replace(epsilon=0.5 * (plan.epsilon + knowledge.plan.epsilon))


class Recurs:
    """Alarms when a return comes the third time since the last alarm, of those that are no worse than the worst."""

    direction, statistic = "down", None

    def __init__(self):
        self.reset()

    def update(self, x):
        self.worst = min(self.worst, x)
        number = int(x)
        self.seen[number] = np.int64(self.seen.get(number, 0) + 1)
        if self.seen[number] < 3:
            return False
        self.reset()
        return True

    def reset(self):
        self.seen, self.worst = {}, float("inf")


class ByNumber(Recurs):
    def state(self):
        return {number: int(count) for number, count in self.seen.items()}

    def restore(self, state):
        self.seen = dict(state)


class OfNumPy(Recurs):
    def state(self):
        return [[number, count] for number, count in self.seen.items()]

    def restore(self, state):
        self.seen = dict(state)


class Infinite(Recurs):
    def state(self):
        return [[[number, int(count)] for number, count in self.seen.items()], self.worst, float("inf")]

    def restore(self, state):
        self.seen, self.worst = dict(state[0]), state[1]


@pytest.fixture(autouse=True)
def own(monkeypatch):
    parts = {one.__name__: one for one in (Smooth, ByNumber, OfNumPy, Infinite)}
    monkeypatch.setitem(sys.modules, "own", SimpleNamespace(**parts))


def run_with_a_restart_of(role, config, folder):
    """Run, but for one restart of a role on the way; return the hash of the log."""
    with Roles(config, folder, snapshot_every=5) as run:
        run.start_all()
        run.wait_for_pass(22)
        run.again(role)
        return run.hash()


def alone(config):
    Paced.free.set()
    return in_process(config).log.sha256()


def test_a_planner_reads_the_plan_in_force_after_a_restart_too(here):
    config = paced(45, {"plan": {"name": "own:Smooth"}})
    assert run_with_a_restart_of("plan", config, here) == alone(config)


@pytest.mark.parametrize("detector", ["ByNumber", "OfNumPy", "Infinite"])
def test_of_a_state_that_json_would_change_none_is_kept_and_all_is_done_again(here, detector):
    config = paced(45, {"monitor": {"detectors": [f"own:{detector}"]}})
    digest = run_with_a_restart_of("monitor", config, here)
    with store(here / "log.sqlite") as log:
        assert (log.snapshot(0, "monitor"), log.snapshot(0, "analyze").pass_no) == (None, 45)
    assert digest == alone(config)
    assert events(here / "log.sqlite", "refused") == []


scalars = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(st.characters()),
    st.floats().map(np.float64), st.integers(-9, 9).map(np.int64), st.booleans().map(np.bool_), st.binary(max_size=2),
)  # fmt: skip
states = st.recursive(
    scalars,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.tuples(inner, inner), st.sets(st.integers(), max_size=2),
        st.dictionaries(st.one_of(st.text(max_size=3), st.integers(), st.booleans(), st.none()), inner, max_size=3),
    ),
    max_leaves=8,
)  # fmt: skip


def as_lists(state):
    """Write a state with lists for tuples, and numbers as they are told: that is what JSON may change."""
    if isinstance(state, dict):
        return {key: as_lists(value) for key, value in state.items()}
    if isinstance(state, list | tuple):
        return [as_lists(value) for value in state]
    return repr(float(state)) if isinstance(state, float) else repr(state)


@given(states)
@example("\ud800")
@example({"\ud800": 1})
def test_a_state_is_kept_as_it_is_or_not_at_all(state):
    try:
        kept = plain(state)
    except PartError:
        return
    back = State.unpack(State(loop=0, pass_no=1, state=kept).pack())[0].state
    assert as_lists(back) == as_lists(state)


@pytest.fixture
def complete(here):
    """A run that is over, Knowledge included."""
    config = paced(3)
    with Roles(config, here) as run:
        run.start_all()
        run.hash()
    return run


@pytest.fixture
def knowledge(complete, monkeypatch):
    """Start Knowledge on what it has, as its process does."""
    monkeypatch.setattr(serve, "quick_switches", lambda: None)  # which would be for all tests after this one
    arguments = (complete.config, complete.wire, complete.path)
    return threading.Thread(target=serve.serve_knowledge, args=arguments, kwargs={"snapshot_every": 5})


def test_knowledge_on_a_complete_log_stays_until_the_roles_have_come_and_gone(complete, knowledge, monkeypatch):
    monkeypatch.setattr(serve, "LEFT_WITHIN", 50.0)
    knowledge.start()
    complete.threads, complete.roles = [], {}
    for role in ROLES:
        assert knowledge.is_alive()
        complete.start(role)
    complete.join()
    knowledge.join(60)
    assert not knowledge.is_alive()
    assert [event.kind for event in events(complete.path)].count("joined") == 2 * len(ROLES)


def test_knowledge_on_a_complete_log_to_which_nobody_comes_leaves_after_a_while(knowledge, monkeypatch):
    monkeypatch.setattr(serve, "LEFT_WITHIN", 0.5)
    begun = time.monotonic()
    knowledge.start()
    knowledge.join(60)
    assert not knowledge.is_alive()
    assert time.monotonic() - begun >= 0.5


@pytest.mark.parametrize(("redrivable", "noted"), [(False, [1]), (True, [])])
def test_a_first_episode_that_was_broken_off_and_cannot_be_driven_again_is_noted(here, redrivable, noted):
    config = paced(6, {"system": {"redrivable": redrivable, "retries": 1}})
    with Roles(config, here) as run:
        run.start("execute")
        run.until(lambda: run.roles["execute"].units, "an Execute")
        run.roles["execute"].member.note("begun", "", 0, 1)
        run.end("execute")  # without a plan it has driven nothing
        run.start_all()
        run.hash()
    assert [event.pass_no for event in events(run.path, "aborted")] == noted


@pytest.mark.parametrize("mode", ["lockstep", "free"])
def test_the_q_table_of_an_episode_that_is_not_over_is_not_handed_out(here, mode):
    asked, go = [], threading.Event()

    class Asks(Morphin):
        def plan(self, request, knowledge):
            if request.pass_no == 5:
                asked.append(knowledge.q_table())
                assert go.wait(60)
            return super().plan(request, knowledge)

    sys.modules["own"].Asks = Asks
    table = {"execute": {"mode": mode, "rate": 50.0} if mode == "free" else {}, "plan": {"name": "own:Asks"}}
    with Roles(paced(6, table), here) as run:
        run.start_all()
        run.until(lambda: asked, "a Q-table of what is over")
        for number in (7, 100):
            answers = list(run.operator.get(f"{run.wire.ask('table')}?loop=0;pass={number}", timeout=60))
            assert f"not at the end of {number}" in answers[0].err.payload.to_string()
        go.set()
        Paced.free.set()
        run.join()
