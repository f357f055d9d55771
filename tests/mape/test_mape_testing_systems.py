"""The conformance checks find each fault in a system that has just that one, and none in systems that have none."""

import random
from types import SimpleNamespace

import faulty_rules
import gymnasium
import numpy as np
import pytest
from faulty_parts import MEMBERS, faults, variant, without
from mape_runs import Carrying, Corridor
from worn_worlds import CARRIES, Said

from adapters.systems import make_system
from mape.config import BoxGrid, SystemConfig
from mape.testing import check_system


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("mapek/Gridworld-v0", {"slip": 0.2, "jump_from": 3, "switch_at": [2], "remove": {"1": 4}}),
        ("mapek/TrafficJunction-v0", {"switch_at": [2, 4], "reserve_from": 3}),
        ("FrozenLake-v1", {}),
    ],
)
def test_systems_that_keep_every_clause_are_found_to_do_so(name, options):
    made = []

    def make():
        made.append(make_system(SystemConfig(id=name, options=options)))
        return made[-1]

    findings = check_system(make)
    rules = made[0].rules is not None
    soft = ["note" if "Gridworld" in name else "ok"]
    assert [f.verdict for f in findings] == ["ok"] * 3 + soft + ["ok"] * 4 + (["ok"] * 2 if rules else ["note"] * 2)


STAYS = "stays within its states, with finite rewards and known actions"
FORETELLS = "says beforehand which actions an episode offers, or nothing"
PLAYS_THE_SAME = "is deterministic: two fresh ones play the same episodes"
WHATEVER = "plays an episode the same whatever was played before"
BY_RULES = "has rules that equal its steps, bit for bit"
COMPILED = "learns the same Q-table compiled and called"


class Walk(Corridor):
    """The corridor by rules: six cells, from the left end to the right one."""

    n_states, max_steps = 6, 9
    by_step = staticmethod(faulty_rules.step)
    by_rule = staticmethod(faulty_rules.step)

    def __init__(self):
        super().__init__()
        self.first_state = 0
        self.rules = SimpleNamespace(
            params=faulty_rules.WalkParams(6),
            phase=faulty_rules.phase,
            reset=faulty_rules.reset,
            step=self.by_rule,
            explorable=faulty_rules.explorable,
            windows=np.array([[1, 99], [1, 99]]),
            reset_draws=0,
            step_draws=0,
        )

    def begin(self, episode):
        self._cell = 0
        return 0, (0, 1)

    def step(self, action, context):
        self._cell, reward, ended = self.by_step(self.rules.params, 0, self._cell, action, None, 0, context)
        return self._cell, reward, ended, False


class Stateful(Carrying):
    def get_state(self):
        return {"played": self.played}

    def set_state(self, state):
        self.played = state["played"]


def corridor(**members):
    return variant(Corridor, **members)


def spoilt(**fields):
    return lambda: Corridor(spoil=lambda episode, step: fields)


@pytest.mark.parametrize(
    ("make", "check", "says"),
    [
        (without(Corridor, member="explorable"), MEMBERS, "has no explorable()"),
        (corridor(n_states=0), "describes itself in numbers", "n_states is 0"),
        (corridor(max_steps=2.5), "describes itself in numbers", "max_steps is 2.5"),
        (corridor(draws=(0, -1)), "describes itself in numbers", "draws[1] is -1"),
        (corridor(redrivable=None), "describes itself in numbers", "redrivable is None; it is True or False"),
        (without(Corridor, member="get_state"), MEMBERS, "has no get_state()"),
        (corridor(drifts=(5, 3)), "describes itself in numbers", "increasing episodes"),
        (lambda: Corridor(signal_names=("return",)), "describes itself in numbers", "none of return, steps"),
        (lambda: Corridor(signal_names=("a", "a")), "describes itself in numbers", "distinct names"),
        (lambda: Corridor(offers=lambda episode: ()), STAYS, "episode 1 offers ()"),
        (lambda: Corridor(offers=lambda episode: (0, 1, 1)), STAYS, "distinct ints from 0"),
        (lambda: Corridor(offers=lambda episode: (np.int64(0), 1)), STAYS, "distinct ints from 0"),
        (corridor(begin=lambda self, episode: (5, (0, 1))), STAYS, "begin() of episode 1 went to state 5"),
        (spoilt(state=9), STAYS, "went to state 9; states are ints from 0 to 4"),
        (spoilt(state=1.0), STAYS, "went to state 1.0"),
        (spoilt(reward=float("nan")), STAYS, "gave reward nan"),
        (spoilt(reward=None), STAYS, "gave reward None"),
        (
            corridor(step=lambda self, action, context: (*Corridor.step(self, action, context)[:2], 0, False)),
            STAYS,
            "gave terminated 0",
        ),
        (
            lambda: Corridor(signal_names=("cell",), spoil=lambda e, s: {"signal": float("inf")}),
            STAYS,
            "gave signals {'cell': inf}",
        ),
        (
            corridor(available=lambda self, episode: (0,)),
            FORETELLS,
            "available(1) is (0,), and episode 1 offers (0, 1)",
        ),
        (
            lambda: Corridor(spoil=lambda episode, step: {"reward": random.random()}),
            PLAYS_THE_SAME,
            "episode 1 of two fresh ones differs at step 1",
        ),
        (variant(Stateful, set_state=lambda self, state: None), WHATEVER, "get_state() holds all that it carries"),
        (
            variant(Walk, by_rule=staticmethod(faulty_rules.step_with_another_reward)),
            BY_RULES,
            "by step() and by rules",
        ),
        (variant(Walk, draws=(1, 0)), BY_RULES, "draws says (1, 0)"),
        (
            variant(
                Walk,
                by_step=staticmethod(faulty_rules.overflowing_step),
                by_rule=staticmethod(faulty_rules.overflowing_step),
            ),
            COMPILED,
            "episode 1 learns",
        ),
    ],
)
def test_a_system_with_a_fault_is_told_its_fault(make, check, says):
    assert says in faults(check_system(make))[check]


def verdicts(findings):
    return {finding.check: finding.verdict for finding in findings}


def test_a_system_whose_episodes_depend_on_those_before_is_noted_as_not_resumable():
    (finding,) = (f for f in check_system(Carrying) if f.check == WHATEVER)
    assert finding.verdict == "note"
    assert finding.detail.startswith("not resumable from a state: episode")


def test_a_system_that_cannot_be_driven_again_says_so_and_is_noted():
    (finding,) = (f for f in check_system(corridor(redrivable=False)) if f.check == WHATEVER)
    assert finding.verdict == "note"
    assert finding.detail.startswith("not redrivable, as it says itself (redrivable = False)")


def test_a_system_that_gives_and_takes_its_state_is_resumable():
    assert verdicts(check_system(Stateful))[WHATEVER] == "ok"


def test_a_system_without_rules_is_noted_and_not_failed():
    findings = verdicts(check_system(Corridor))
    assert (findings[BY_RULES], findings[COMPILED]) == ("note", "note")
    assert set(findings.values()) == {"ok", "note"}


def test_every_system_that_a_check_makes_is_closed():
    closed, made = [], []

    class Closing(Corridor):
        def __init__(self):
            super().__init__()
            made.append(self)

        def close(self):
            closed.append(self)

    check_system(Closing)
    assert closed == made != []


def held(findings):
    (finding,) = (finding for finding in findings if finding.check == WHATEVER)
    return finding


@pytest.mark.parametrize(("name", "carried"), [*CARRIES.items(), ("Class", "shared Class.turns")])
def test_what_an_environment_carries_is_named_though_its_episodes_show_nothing_of_it(name, carried):
    finding = held(check_system(lambda: make_system(SystemConfig(id=f"{name}-v0"))))
    assert finding.verdict == "note"
    assert carried in finding.detail


@pytest.mark.parametrize(
    "name", ["Fresh", "Said", "Watched", "FrozenLake-v1", "Taxi-v4", "CartPole-v1", "Blackjack-v1"]
)
def test_an_environment_that_carries_nothing_or_says_it_is_found_to_do_so(name):
    grid = BoxGrid(low=(-1.0,) * 4, high=(1.0,) * 4, bins=(2,) * 4) if name == "CartPole-v1" else None
    config = SystemConfig(
        id=name if "-v" in name else f"{name}-v0",
        max_steps=50 if "-v" in name else None,  # the others end earlier by themselves
        discretise=grid,
    )
    assert held(check_system(lambda: make_system(config), 3)) == (WHATEVER, "ok", "")


def test_a_state_that_leaves_something_out_is_told_what():
    class Forgets(Said):
        def get_state(self):
            return 0

    gymnasium.register("Forgets-v0", Forgets, max_episode_steps=3)
    try:
        finding = held(check_system(lambda: make_system(SystemConfig(id="Forgets-v0"))))
    finally:
        del gymnasium.registry["Forgets-v0"]
    assert finding.verdict == "failed"
    assert "does not hold the same total" in finding.detail
    assert "although its state was set; get_state() holds all" in finding.detail
