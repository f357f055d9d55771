"""A part whose first pass does not fit the run is refused before anything of it is kept, as if it never was."""

import sys
import threading
from types import SimpleNamespace

import gymnasium
import pytest
from bus_small_loop import in_process
from gymnasium import spaces
from real_processes import events, store
from roles_on_threads import Paced, Roles, paced

from adapters.replay.records import LogReplay
from knowledge import Drift
from mape.analyze.changes import Changes
from mape.config import from_table
from mape.execute.rules import QLearning, alpha_star
from mape.monitor.page_hinkley import PageHinkley
from mape.plan.morphin import Morphin


def serves(role):
    """Whether this is the thread of a role: a part that is only held against its contract is elsewhere."""
    return threading.current_thread().name == role


class Smooth(Morphin):
    """Explores half way between what MORPHIN wants and the plan in force, which it reads."""

    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        return plan._replace(epsilon=0.5 * (plan.epsilon + knowledge.plan.epsilon))


class Adds(Morphin):
    """Wants an action that the run's records have no place for, and those of its check have."""

    def plan(self, request, knowledge):
        return super().plan(request, knowledge)._replace(add=(100,), epsilon=0.125)


class Ahead(Morphin):
    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        return plan._replace(pass_no=plan.pass_no + 1) if serves("plan") else plan


class Elsewhere(Morphin):
    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        return plan._replace(loop=7) if serves("plan") else plan


class DropsUnknown(Morphin):
    """Drops an action that has no row."""

    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        return plan._replace(drop=(9,)) if serves("plan") else plan


class DropsAll(Morphin):
    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        return plan._replace(drop=knowledge.actions) if serves("plan") else plan


class AdoptsUnknown(Morphin):
    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        return plan._replace(adopt="0" * 64) if serves("plan") else plan


class Invents(Changes):
    """Hands on signals that the pass did not have."""

    def analyze(self, symptom):
        request = super().analyze(symptom)
        signals = dict(request.signals)
        if serves("analyze"):
            signals["return"] += 1.0
        return request._replace(signals=signals)


class Unheard(Changes):
    def analyze(self, symptom):
        request = super().analyze(symptom)
        return request._replace(drifts=(Drift("noise", "up"),)) if serves("analyze") else request


class Turns(PageHinkley):
    """Points to a side that there is not, as soon as it serves."""

    def update(self, x):
        alarm = super().update(x)
        if serves("monitor"):
            self.direction = "left"
        return alarm


class Unlike(float):
    """A number that cannot be compared."""

    def __ge__(self, other):
        raise ZeroDivisionError("it is unlike all others")


class Quits(Morphin):
    """Raises what is no error of the loop's own, when it is asked nothing."""

    def plan(self, request, knowledge):
        plan = super().plan(request, knowledge)
        return plan._replace(epsilon=Unlike(0.5)) if serves("plan") else plan


def fails(td_error, rate):
    if 900.0 < td_error < 900_000.0:  # which no check of a learner asks about
        raise ZeroDivisionError
    return alpha_star(td_error, rate)


class Stumbles(QLearning):
    """Fails at a large error, when its episode has begun."""

    step_size = staticmethod(fails)


class Carries(gymnasium.Env):
    """Pays more and more, by what all its episodes so far came to, which it says."""

    observation_space, action_space = spaces.Discrete(6), spaces.Discrete(3)

    def __init__(self, render_mode=None):
        self.turned = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 6
        return self.turned % 6, {}

    def step(self, action):
        self.turned += int(action) + 1
        self.left -= 1
        reward = 100.0 * self.turned if self.left == 2 else float(self.turned % 7)
        return self.turned % 6, reward, self.left == 0, False, {}

    def get_state(self):
        return {"turned": self.turned}

    def set_state(self, state):
        self.turned = state["turned"]


gymnasium.register("Carries-v0", Carries, max_episode_steps=6)

OWN = [Smooth, Adds, Ahead, Elsewhere, DropsUnknown, DropsAll, AdoptsUnknown, Invents, Unheard, Turns, Quits, Stumbles]


@pytest.fixture(autouse=True)
def own(monkeypatch):
    monkeypatch.setitem(sys.modules, "own", SimpleNamespace(**{one.__name__: one for one in OWN}))


def alone(config):
    Paced.free.set()
    return in_process(config).log.sha256()


REFUSED = [
    ("plan", "Adds", "action id 100 is outside 0 .. 63"),
    ("plan", "Ahead", "says pass_no = "),
    ("plan", "Elsewhere", "says loop = 7, and was given 0"),
    ("plan", "DropsUnknown", "cannot be executed: actions [9] have no row"),
    ("plan", "DropsAll", "leaves a Q-table of the actions ()"),
    ("plan", "AdoptsUnknown", "cannot be executed: "),
    ("analyze", "Invents", "says signals = "),
    ("analyze", "Unheard", "'noise'"),
    ("plan", "Quits", "ZeroDivisionError: it is unlike all others"),
    ("monitor", "Turns", "direction"),
]


@pytest.mark.parametrize(("part", "name", "says"), REFUSED, ids=[name for _, name, _ in REFUSED])
def test_a_part_whose_first_record_knowledge_would_not_take_is_refused_and_never_was(here, part, name, says):
    config = paced(40, {"plan": {"name": "own:Smooth"}})
    with Roles(config, here, snapshot_every=5) as run:
        run.start_all()
        run.wait_for_pass(10)
        said = run.ask_for(part, {"name": f"own:{name}"}, part)()
        assert isinstance(said, str), said
        assert f"{part} stays as it is, 'own:{name}' was refused" in said
        assert says in said
        run.wait_for_pass(run.last[3] + 2)
        run.again(part)
        digest = run.hash()
    with store(run.path) as log:
        assert log.swaps() == []
    assert events(run.path, "refused") == []
    assert digest == alone(config)


def test_a_learner_that_fails_in_an_episode_leaves_the_environment_as_it_was_before(here):
    table = {
        "episodes": 300,  # it takes its time to check a learner
        "system": {"id": "Carries-v0"},
        "analyze": "roles_on_threads:Paced",
        "execute": {"engine": "python"},
        "monitor": {"detectors": [{"name": "page_hinkley", "threshold": 3.0}]},
    }
    config = from_table(table)
    with Roles(config, here, snapshot_every=7) as run:
        run.start_all()
        run.wait_for_pass(9)
        said = run.ask_for("learner", {"name": "own:Stumbles"}, "execute")()
        assert "learner stays as it is, 'own:Stumbles' was refused" in said
        assert "raised ZeroDivisionError" in said
        run.wait_for_pass(run.last[3] + 2)
        run.again("execute")  # drives what came after its last state once more
        digest = run.hash()
    assert events(run.path, "refused") == []
    assert digest == alone(config)
    with store(run.path) as log:
        assert LogReplay(log).replay(0).difference is None
