"""A rule that takes an expectation takes it over what the behaviour policy does, with its own probabilities."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mape_runs import config, hashes, loop_of

from knowledge import ChangePlan, Knowledge, Log, RowLayout
from mape.execute import Execute
from mape.execute.component import SIGNALS
from mape.execute.rules import ExpectedSarsa, LearnerConfig, QLearning, expected_value
from mape.testing import check_learner

GOAL, STEP = 100.0, -1.0


def driven(chosen, seed):
    """Drive an episode on random values; return them as they were, those after it, the trace, and the system."""
    loop = loop_of(chosen)
    values = loop.execute.q_table.values
    values[:] = np.random.default_rng(seed).normal(50.0, 20.0, values.shape)
    before, traces = values.copy(), []
    loop.execute.record_trace(1, 1, lambda number, trace: traces.append(trace.copy()))
    loop.run(1)
    return before, loop, traces[0]


def policy(q, state, rules, epsilon, mask_greedy):
    """Return the probability of each row: written anew, of what the manual says."""
    rows = range(len(q))
    worth = [row for row in rows if rules.explorable(rules.params, 0, state, row)] or list(rows)
    choice = max(worth if mask_greedy else rows, key=lambda row: (q[row, state], -row))
    return [epsilon * (row in worth) / len(worth) + (1.0 - epsilon) * (row == choice) for row in rows]


@pytest.mark.parametrize("engine", ["compiled", "python"])
@settings(max_examples=25, deadline=None)
@given(
    size=st.tuples(st.integers(2, 5), st.integers(2, 5)),
    epsilon=st.floats(0.0, 1.0),
    discount=st.floats(0.0, 1.0),
    mask_greedy=st.booleans(),
    seed=st.integers(0, 2**31),
)
@example(size=(3, 3), epsilon=1.0, discount=1.0, mask_greedy=False, seed=1)
def test_expected_sarsa_bootstraps_from_the_mean_over_what_it_would_do(
    engine, size, epsilon, discount, mask_greedy, seed
):
    chosen = config(
        seed=seed,
        system={
            "options": {
                "size": list(size),
                "start": [0, 0],
                "goals": [[size[0] - 1, size[1] - 1]],
                "switch_at": [],
                "goal_reward": GOAL,
                "step_reward": STEP,
            }
        },
        monitor={"detectors": []},
        learner={"name": "expected_sarsa", "discount": discount},
        plan={"name": "q_learning", "schedule": {"name": "constant", "epsilon": epsilon}},
        execute={"engine": engine, "mask_greedy": mask_greedy},
    )
    q, loop, trace = driven(chosen, seed)
    rules = loop.system.rules
    for (state, action, _, new, td_error, _), after in zip(trace[:-1], trace[1:, 0], strict=True):
        at, following = (int(action), int(state)), int(after)
        mean = float(np.dot(policy(q, following, rules, epsilon, mask_greedy), q[:, following]))
        assert td_error == pytest.approx(STEP + discount * mean - q[at], abs=1e-9)
        q[at] = new


def test_what_a_learner_of_ones_own_averages_over_is_what_exploration_chooses_from():
    seen = []

    class Spy(ExpectedSarsa):
        @staticmethod
        def value(q, rows, count, state, best, epsilon):
            seen.append((state, sorted(rows[:count].tolist()), int(best)))
            return expected_value(q, rows, count, state, best, epsilon)

    system = loop_of(config(system={"options": {"switch_at": []}}, execute={"engine": "python"})).system
    layout = RowLayout(SIGNALS + system.signal_names, 0, 3)
    execute = Execute(system, Spy(LearnerConfig()), Knowledge(Log(layout, 0)), lambda seen: None, engine="python")
    execute.q_table.values[:] = np.random.default_rng(5).normal(0.0, 9.0, execute.q_table.values.shape)
    execute.adopt(ChangePlan(0, 0, 1.0, (0.1, 0.99, 5.0), (), (), (), False, None))
    execute.drive()
    rules = system.rules
    assert seen
    for state, rows, _ in seen:
        assert rows == [row for row in range(4) if rules.explorable(rules.params, 0, state, row)]
    assert any(best not in rows for _, rows, best in seen)


def test_a_value_of_ones_own_gets_the_rows_unless_it_says_that_it_needs_none():
    class Mine(QLearning):
        value = staticmethod(expected_value)

    class Denies(Mine):
        on_policy = False

    assert (QLearning(LearnerConfig()).on_policy, Mine(LearnerConfig()).on_policy) == (False, True)
    found = {f.check: f for f in check_learner(lambda: Denies(LearnerConfig()))}
    told = found["says whether its value looks at what exploration chooses from"]
    assert (told.verdict, "on_policy is False" in told.detail) == ("failed", True)
    for kind in (QLearning, ExpectedSarsa, Mine):
        assert {f.verdict for f in check_learner(lambda kind=kind: kind(LearnerConfig()))} == {"ok"}


@pytest.mark.parametrize("mask_greedy", [False, True])
@pytest.mark.parametrize("learner", ["q_learning", "expected_sarsa"])
def test_both_engines_average_over_the_same(learner, mask_greedy):
    over = {"learner": {"name": learner}, "episodes": 10}
    both = []
    for engine in ("python", "compiled"):
        loop = loop_of(config(**over, execute={"engine": engine, "mask_greedy": mask_greedy}))
        loop.run(10)
        both.append(hashes(loop))
    assert both[0] == both[1]
