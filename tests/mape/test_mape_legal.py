"""What is not legal is never done, nor bootstrapped from; a mask is softer; what a guard did in its place is learnt."""

import gymnasium
import numpy as np
import pytest
from barred_world import ACTIONS, Barred, tables
from gymnasium.spaces import Discrete
from hypothesis import given, settings
from hypothesis import strategies as st
from mape_runs import hashes

from adapters.cli.main import main
from adapters.systems import GymnasiumSystem
from adapters.systems.checking import check_environment
from mape.config import SystemConfig, from_table
from mape.errors import ManagedSystemError
from mape.loop import Loop
from mape.testing import check_system

STAYS = "stays within its states, with finite rewards and known actions"


def loop_over(env, epsilon=0.5, learner="q_learning", engine="auto", mask_greedy=False, terminal=False, episodes=6):
    chosen = from_table(
        {
            "name": "barred",
            "episodes": episodes,
            "system": {"id": "any", "max_steps": 12},
            "learner": {"name": learner, "discount": 0.9, "bootstrap_terminal": terminal},
            "plan": {"name": "q_learning", "schedule": {"name": "constant", "epsilon": epsilon}},
            "execute": {"engine": engine, "mask_greedy": mask_greedy},
        }
    )
    return Loop(chosen, GymnasiumSystem(env, chosen.system))


def traced(loop, seed):
    """Drive an episode on random values; return these, and its steps."""
    values = loop.execute.q_table.values
    values[:] = np.random.default_rng(seed).normal(50.0, 20.0, values.shape)
    before, traces = values.copy(), []
    loop.execute.record_trace(1, 1, lambda number, trace: traces.append(trace.copy()))
    loop.run(1)
    return before, traces[0]


def policy(q, state, world, epsilon, mask_greedy):
    """Return the probability of each action in a state: written anew, of what the manual says."""
    legal = [a for a in range(ACTIONS) if world.legal[state, a]]
    worth = [a for a in legal if world.worth[state, a]]
    choice = max(worth if mask_greedy and worth else legal, key=lambda a: (q[a, state], -a))
    tried = worth or legal
    return [epsilon * (a in tried) / len(tried) + (1.0 - epsilon) * (a == choice) for a in range(ACTIONS)]


@pytest.mark.parametrize("engine", ["compiled", "python"])
@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**20),
    epsilon=st.floats(0.0, 1.0),
    learner=st.sampled_from(["q_learning", "expected_sarsa"]),
    mask_greedy=st.booleans(),
    terminal=st.booleans(),
)
def test_only_legal_actions_are_taken_and_bootstrapped_from(engine, seed, epsilon, learner, mask_greedy, terminal):
    world = tables(seed)
    loop = loop_over(Barred(seed), epsilon, learner, engine, mask_greedy, terminal)
    q, trace = traced(loop, seed)
    for state, action, _, new, td_error, _ in trace.tolist():
        at = (int(action), int(state))
        assert world.legal[at[1], at[0]]
        landed = int(world.next_states[at[1], at[0]])
        mean = 0.0
        if (terminal and world.legal[landed].any()) or not world.ends[landed]:
            chances = policy(q, landed, world, epsilon if learner == "expected_sarsa" else 0.0, mask_greedy)
            mean = float(np.dot(chances, q[:, landed]))
        assert td_error == pytest.approx(world.rewards[at[1], at[0]] + 0.9 * mean - q[at], abs=1e-9)
        q[at] = new


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**20), mask_greedy=st.booleans(), learner=st.sampled_from(["q_learning", "expected_sarsa"]))
def test_both_engines_bar_the_same_to_the_bit(seed, mask_greedy, learner):
    both = []
    for engine in ("python", "compiled"):
        loop = loop_over(Barred(seed), learner=learner, engine=engine, mask_greedy=mask_greedy)
        loop.run(6)
        both.append(hashes(loop))
    assert both[0] == both[1]


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**20))
def test_where_all_is_legal_a_rule_that_says_so_changes_no_bit(seed):
    both = []
    for hard in (True, False):
        loop = loop_over(Barred(seed, barred=0.0, hard=hard))
        loop.execute.system.rules.params.legal[:] = True
        loop.run(6)
        both.append(hashes(loop))
    assert both[0] == both[1]


@pytest.mark.parametrize("engine", ["compiled", "python"])
def test_a_state_without_a_legal_action_ends_in_a_sentence_and_nothing_of_the_episode_is_learnt(engine):
    env = Barred(7)
    loop = loop_over(env, epsilon=1.0, engine=engine)
    loop.run(2)
    before = hashes(loop)
    env.rules.params.legal[0] = False
    with pytest.raises(ManagedSystemError) as refused:
        loop.run(1)
    said = str(refused.value)
    assert [part for part in ("legal", "episode 3", "2 passes before") if part not in said] == []
    assert hashes(loop) == before


def test_the_checks_of_barred_worlds_find_nothing_and_take_no_illegal_action():
    findings = check_system(lambda: GymnasiumSystem(Barred(3), SystemConfig(id="barred")))
    assert {f.verdict for f in findings} <= {"ok", "note"}


class Plant(gymnasium.Env):
    """Opens a valve by action 1 alone at its first step, and after it by 0 and 1; any other one breaks it."""

    observation_space, action_space = Discrete(2), Discrete(3)

    def __init__(self, form=lambda ids: ids, guard=False, legal=True):
        self._form, self._guard, self._says = form, guard, legal

    def _told(self):
        return {"legal_actions": self._form(self._legal)} if self._says else {"action_mask": [0, 1, 0]}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._legal = (1,)
        return 0, self._told()

    def step(self, action):
        if action not in self._legal:
            if not self._guard:
                raise RuntimeError(f"the plant died of the illegal action {action}")
            action = 1
        self._legal = (0, 1)
        return 1, 10.0 * (action == 0) - 1.0, False, False, {**self._told(), "action_taken": action}


FORMS = {
    "ids": lambda ids: ids,
    "set": frozenset,
    "array of ids": np.array,
    "mask": lambda ids: np.isin(np.arange(3), ids).astype(np.int8),
    "mask of bool": lambda ids: np.isin(np.arange(3), ids),
    "list of bool": lambda ids: [a in ids for a in range(3)],
}


@pytest.mark.parametrize("mask_greedy", [False, True])
@pytest.mark.parametrize("epsilon", [0.0, 0.7])
@pytest.mark.parametrize("form", list(FORMS.values()), ids=list(FORMS))
def test_a_plant_that_says_what_is_legal_does_not_die(form, epsilon, mask_greedy):
    loop = loop_over(Plant(form), epsilon, mask_greedy=mask_greedy)
    loop.run(6)
    assert not loop.execute.q_table.values[2].any()
    assert not loop.execute.q_table.values[0, 0]
    made = lambda: GymnasiumSystem(Plant(form), SystemConfig(id="plant", max_steps=12))  # noqa: E731
    assert {f.verdict for f in check_system(made)} <= {"ok", "note"}


def test_a_mask_is_soft_and_the_check_says_so():
    with pytest.raises(ManagedSystemError, match="died of the illegal action 0"):
        loop_over(Plant(legal=False), epsilon=0.0).run(1)

    class Marked(Plant):
        def step(self, action):
            return 1, 0.0, False, False, self._told()

    found = check_system(lambda: GymnasiumSystem(Marked(legal=False), SystemConfig(id="marked", max_steps=12)))
    (note,) = [f for f in found if f.check == "bars by its mask only what may be taken nevertheless"]
    assert (note.verdict, "info['legal_actions']" in note.detail) == ("note", True)


def test_gymnasiums_own_checks_take_no_illegal_action_either():
    gymnasium.register("LegalPlant-v0", Plant, max_episode_steps=12)
    try:
        found = check_environment(SystemConfig(id="LegalPlant-v0"))
    finally:
        del gymnasium.registry["LegalPlant-v0"]
    assert "died" not in found.detail
    assert found.verdict != "failed"


def test_the_action_that_a_guard_took_is_learnt_from_and_not_the_one_it_barred():
    seen = []

    class Guarded(Plant):
        def _told(self):
            return {}

        def step(self, action):
            was, answer = int(len(self._legal) == 2), super().step(action)
            seen.append((was, int(action), answer[-1]["action_taken"], answer[1]))
            return answer

    loop = loop_over(Guarded(guard=True), epsilon=1.0)
    steps = []
    loop.execute.record_trace(1, 6, lambda number, trace: steps.extend(trace[:, :2].astype(int).tolist()))
    loop.run(6)
    assert steps == [[state, taken] for state, _, taken, _ in seen]
    assert any(chosen != taken for _, chosen, taken, _ in seen)
    assert not loop.execute.q_table.values[2].any()


def test_an_action_that_was_taken_and_is_in_no_row_is_refused():
    class Replaced(Plant):
        def reset(self, *, seed=None, options=None):
            seen, info = super().reset(seed=seed, options=options)
            return seen, info | {"available_actions": (0, 1)}

        def step(self, action):
            seen, reward, *ended, info = super().step(action)
            return seen, reward, *ended, info | {"action_taken": 2}

    with pytest.raises(ManagedSystemError, match=r"took action 2 in the place of action 1, .*\(0, 1\).* episode 1 at"):
        loop_over(Replaced()).run(1)


def test_a_legal_action_that_is_new_is_no_way_out_before_it_has_a_row():
    class Renewed(Plant):
        def reset(self, *, seed=None, options=None):
            seen, info = super().reset(seed=seed, options=options)
            new = options["episode"] > 1
            return seen, info | {
                "available_actions": (0, 1, 2) if new else (0, 1),
                "legal_actions": (2,) if new else (1,),
            }

    with pytest.raises(ManagedSystemError, match=r"\(2,\) that are legal .* \(0, 1\).* 1 passes before"):
        loop_over(Renewed()).run(2)


def test_what_is_legal_is_said_at_the_reset_and_at_each_step_or_never():
    class Forgets(Plant):
        def step(self, action):
            return *super().step(action)[:4], {}

    class Begins(Plant):
        def reset(self, *, seed=None, options=None):
            return super().reset(seed=seed, options=options)[0], {}

    for kind in (Forgets, Begins):
        with pytest.raises(ManagedSystemError, match=r"legal_actions.* or never, in episode 1 at step 1"):
            loop_over(kind(guard=True)).run(1)


def test_a_run_over_such_a_plant_and_its_check_end_well(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(gymnasium.registry, "LegalPlant-v0", gymnasium.envs.registration.EnvSpec(
        "LegalPlant-v0", entry_point=Plant, max_episode_steps=12
    ))  # fmt: skip
    (tmp_path / "plant.toml").write_text('name = "plant"\nepisodes = 20\nsystem = { id = "LegalPlant-v0" }\n')
    assert main(["run", "plant.toml", "--out", "out", "--no-figures"]) == 0
    assert main(["check", "plant.toml"]) == 0
    assert "died" not in capsys.readouterr().out
