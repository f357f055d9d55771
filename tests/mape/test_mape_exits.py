"""A part or a system that ends the program by `sys.exit()`, or raises what is no Exception, has failed.

Only who wants the run to end, as by a Ctrl-C, ends it.
"""

import sys
from types import SimpleNamespace

import pytest
from mape_runs import Corridor, config, corridor_loop, hashes, loop_of

from mape.analyze.changes import Changes
from mape.errors import ManagedSystemError, PartError, Stop
from mape.execute.rules import QLearning
from mape.monitor.page_hinkley import PageHinkley
from mape.plan.morphin import Morphin
from mape.specs import PartSpec
from mape.swap import vet
from mape.testing import CHECKS


class Panic(BaseException):
    """As code in Rust raises it: of a class that nobody can import beforehand."""


class Raised:
    kind: type[BaseException] = SystemExit


EITHER = "(SystemExit|Panic)"


def leave(*code):
    raise Raised.kind(*code)


class Detector(PageHinkley):
    def update(self, x):
        leave(5)


class Analyzer(Changes):
    def analyze(self, symptom):
        leave(5)


class Planner(Morphin):
    def plan(self, request, knowledge):
        leave(5)


class Starter(Morphin):
    def start(self, loop):
        leave(5)


class Forgetful(Morphin):
    def state(self):
        leave(5)


def ends(td_error, rate):
    leave(5)


class Learner(QLearning):
    step_size = staticmethod(ends)


@pytest.fixture(autouse=True, params=[SystemExit, Panic])
def own(monkeypatch, request):
    monkeypatch.setattr(Raised, "kind", request.param)
    classes = (Detector, Analyzer, Planner, Starter, Learner, Forgetful)
    monkeypatch.setitem(sys.modules, "own", SimpleNamespace(**{each.__name__: each for each in classes}))


PARTS = [
    (
        {"monitor": {"detectors": [{"name": "own:Detector"}]}},
        f"detector Detector raised {EITHER}: 5, at pass 1",
    ),
    ({"analyze": {"name": "own:Analyzer"}}, f"analyzer Analyzer raised {EITHER}: 5, at pass 1"),
    ({"plan": {"name": "own:Planner"}}, f"planner Planner raised {EITHER}: 5, at pass 1"),
    ({"plan": {"name": "own:Starter"}}, f"planner Starter raised {EITHER}: 5, at its start"),
]


@pytest.mark.parametrize(("over", "says"), PARTS)
def test_a_part_that_exits_is_named(over, says):
    with pytest.raises(PartError, match=says):
        loop_of(config(execute={"engine": "python"}, **over)).run(2)


@pytest.mark.parametrize("stop", [KeyboardInterrupt, GeneratorExit, Stop])
def test_who_wants_the_run_to_end_is_no_fault_of_a_part(stop, monkeypatch):
    monkeypatch.setattr(Raised, "kind", stop)
    for over, _ in PARTS:
        with pytest.raises(stop):
            loop_of(config(execute={"engine": "python"}, **over)).run(2)
    with pytest.raises(stop):
        corridor_loop(Corridor(spoil=exits_at(5, 4, 2))).run(5)


def test_an_exit_when_a_part_is_asked_for_its_state_is_told():
    loop = loop_of(config(plan={"name": "own:Forgetful"}))
    with pytest.raises(PartError, match=rf"planner Forgetful raised {EITHER}: 5, at state\(\)"):
        loop.plan.state()


def exits_at(code, episode, step):
    def spoil(e, s):
        if (e, s) == (episode, step):
            leave(*([] if code is None else [code]))
        return {}

    return spoil


@pytest.mark.parametrize(
    ("code", "says"),
    [
        (5, f"raised {EITHER}: 5, in"),
        (None, f"raised {EITHER}, in"),
        ("bye", f"{EITHER}: bye, in"),
    ],
)
def test_a_system_that_exits_in_a_step_is_named_and_nothing_of_the_episode_is_learnt(code, says):
    before = corridor_loop()
    before.run(3)
    loop = corridor_loop(Corridor(spoil=exits_at(code, 4, 2)))
    with pytest.raises(ManagedSystemError, match=f"corridor .*{says} episode 4 at step 2"):
        loop.run(5)
    assert hashes(loop) == hashes(before)


def test_a_system_that_exits_at_its_reset_is_named():
    def offers(episode):
        if episode == 4:
            leave()
        return 0, 1

    with pytest.raises(ManagedSystemError, match=f"corridor raised {EITHER}, at the reset of episode 4"):
        corridor_loop(Corridor(offers=offers)).run(5)


def test_a_learner_that_exits_in_an_episode_is_an_error_of_that_episode():
    with pytest.raises(PartError, match=f"step_size of learner Learner raised {EITHER}: 5, in episode 1"):
        loop_of(config(execute={"engine": "python"}, learner={"name": "own:Learner"})).run(2)


@pytest.mark.parametrize("method", ["get_state", "set_state", "enable"])
def test_a_system_that_exits_between_two_episodes_is_named(method):
    loop = corridor_loop()
    loop.run(2)
    state, table = loop.execute.state()
    state |= {"system": 1} if method == "set_state" else {"enabled": [2]}
    setattr(loop.system, method, lambda *_: leave(5))
    with pytest.raises(ManagedSystemError, match=f"corridor raised {EITHER}: 5"):
        loop.execute.state() if method == "get_state" else loop.execute.restore(state, table)


CANDIDATES = [
    ("detector", "monitor", Detector), ("analyzer", "analyze", Analyzer), ("planner", "plan", Planner),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "part", "exits"), CANDIDATES)
def test_a_check_and_a_vetting_find_a_part_that_exits(kind, part, exits):
    def make():
        return Planner(Planner.Config(), schedule=_schedule()) if kind == "planner" else exits(exits.Config())

    failed = [finding for finding in CHECKS[kind](make) if finding.verdict == "failed"]
    assert f"{Raised.kind.__name__} was raised: 5" in failed[0].detail
    faults = vet(part, PartSpec(name=f"own:{exits.__name__}"), config())
    assert f"{Raised.kind.__name__} was raised: 5" in faults[0]


def _schedule():
    from mape.plan.exponential import Exponential

    return Exponential(Exponential.Config())


def test_a_swap_to_a_part_that_exits_at_its_start_leaves_the_old_one():
    loop = loop_of(config(swap=[{"pass": 3, "part": "plan", "to": "own:Starter"}]))
    with pytest.raises(PartError, match=f"planner Starter raised {EITHER}: 5"):
        loop.run(5)
    assert type(loop.plan.planner) is Morphin
    assert loop.log.passes == 2
