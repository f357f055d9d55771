"""The rules compile, and compiled they give the same bits."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from managed_systems import ALWAYS, NEVER, Gridworld, TrafficJunction, available, traffic


def tables(rate):
    sums = np.array([*traffic.poisson_sums(rate), 1.0])
    return sums, traffic.guide_to(sums)


@pytest.fixture(scope="module")
def compiled():
    """Compile each rule once for all the examples."""
    numba = pytest.importorskip("numba")
    from numba.extending import register_jitable

    register_jitable(traffic.poisson)
    cache = {}

    def compile_rule(rule):
        if rule not in cache:
            cache[rule] = numba.njit(rule)
        return cache[rule]

    return compile_rule


@st.composite
def gridworlds(draw):
    rows, columns = draw(st.integers(2, 6)), draw(st.integers(2, 6))
    cells = draw(st.permutations([(r, c) for r in range(rows) for c in range(columns)]))
    n_goals = draw(st.integers(1, 3))
    n_walls = draw(st.integers(0, max(len(cells) // 5, 0)))
    assume(1 + n_goals + n_walls <= len(cells))
    config = {
        "size": (rows, columns),
        "start": cells[0],
        "goals": cells[1 : 1 + n_goals],
        "walls": cells[1 + n_goals : 1 + n_goals + n_walls],
        "switch_at": sorted(draw(st.sets(st.integers(2, 9), max_size=3))) if n_goals > 1 else (),
        "max_steps": draw(st.integers(1, 40)),
        "step_reward": draw(st.floats(-10, 10)),
        "goal_reward": draw(st.floats(-1e3, 1e3)),
        "slip": draw(st.sampled_from([0.0, 0.1, 0.75])),
        "jump_from": draw(st.sampled_from([None, 1, 5])),
    }
    try:
        return Gridworld(**config)
    except ValueError:  # walled off
        assume(False)


@st.composite
def junctions(draw):
    capacity = draw(st.integers(1, 20))
    pairs = st.tuples(st.integers(0, 9), st.integers(0, 9))
    switch_at = sorted(draw(st.sets(st.integers(2, 9), max_size=3)))
    rate = st.floats(0, 12) | st.sampled_from([0.0, 200.0, 700.0])
    return TrafficJunction(
        capacity=capacity,
        initial=sorted(draw(st.tuples(st.integers(0, capacity), st.integers(0, capacity)))),
        services=draw(st.lists(pairs, min_size=1, max_size=4)),
        rates=[draw(st.tuples(rate, rate)) for _ in range(len(switch_at) + 1)],
        switch_at=switch_at,
        long_queue=draw(st.integers(0, 20)),
        unused_penalty=draw(st.floats(0, 50)),
    )


def bits(value):
    """Exact content of a number, so that -0.0 differs from 0.0."""
    return float(value).hex()


@given(env=gridworlds() | junctions(), seed=st.integers(0, 2**32 - 1), episode=st.integers(1, 10))
@settings(max_examples=40, deadline=None)
def test_compiled_rules_give_the_same_bits_as_plain_python(compiled, env, seed, episode):
    rules = env.rules
    generator = np.random.default_rng(seed)
    draws = generator.random(rules.episode_draws)
    plain_context, fast_context = np.zeros(2), np.zeros(2)

    phase = rules.phase(rules.params, episode)
    assert compiled(rules.phase)(rules.params, episode) == phase
    state = rules.reset(rules.params, phase, draws, 0)
    assert compiled(rules.reset)(rules.params, phase, draws, 0) == state
    for number in range(rules.max_steps):
        action = int(generator.integers(rules.n_actions))
        explorable = rules.explorable(rules.params, phase, state, action)
        assert compiled(rules.explorable)(rules.params, phase, state, action) is explorable, f"step {number}"
        given_to_both = (rules.params, phase, state, action, draws, rules.reset_draws + number * rules.step_draws)
        plain = rules.step(*given_to_both, plain_context)
        fast = compiled(rules.step)(*given_to_both, fast_context)
        assert (fast[0], bits(fast[1]), fast[2]) == (plain[0], bits(plain[1]), plain[2]), f"step {number}"
        assert fast_context.tobytes() == plain_context.tobytes(), f"step {number}"
        assert [type(part) for part in plain] == [int, float, bool], f"step {number}"
        state, _, terminated = plain
        assert 0 <= state < rules.n_states
        if terminated:
            break


@given(
    rate=st.floats(0, 700),
    u=st.floats(0, 1, exclude_max=True) | st.sampled_from([0.0, 1 - 2**-53, 1 - 2**-52, 1 - 2**-40]),
)
@settings(max_examples=200, deadline=None)
def test_poisson_ends_for_every_rate_and_uniform_and_is_equal_when_compiled(compiled, rate, u):
    sums, guide = tables(rate)
    k = traffic.poisson(sums, guide, u)
    assert compiled(traffic.poisson)(sums, guide, u) == k
    assert u < sums[k]
    assert k == 0 or u >= sums[k - 1]


@pytest.mark.parametrize("rate", [0.5, 1.0, 2.0, 4.0, 7.0, 30.0])
def test_poisson_steps_up_exactly_at_the_distribution_function(rate):
    probability = [math.exp(-rate + k * math.log(rate) - math.lgamma(k + 1)) for k in range(80)]
    for k in range(int(rate + 4 * math.sqrt(rate))):
        below = math.fsum(probability[: k + 1])
        ahead = 1e-4 * min(probability[k : k + 2])
        assert traffic.poisson(*tables(rate), below - ahead) == k, f"k {k}"
        assert traffic.poisson(*tables(rate), below + ahead) == k + 1, f"k {k}"


@pytest.mark.parametrize("rate", [2.0, 7.0, 700.0])
def test_poisson_draws_have_the_mean_and_variance_of_the_distribution(rate):
    made, n = tables(rate), 20_000 if rate < 100 else 2_000
    draws = np.array([traffic.poisson(*made, u) for u in np.random.default_rng(5).random(n)])
    # Five standard errors of a mean and of a variance.
    assert abs(draws.mean() - rate) < 5 * math.sqrt(rate / len(draws))
    assert abs(draws.var() - rate) < 5 * math.sqrt((rate + 2 * rate**2) / len(draws))


def test_no_vehicle_arrives_at_rate_zero():
    assert [traffic.poisson(*tables(0.0), u) for u in (0.0, 0.5, 1 - 2**-53)] == [0, 0, 0]


def test_an_action_is_available_from_its_first_to_its_last_episode():
    windows = np.array([[1, ALWAYS], [3, 5], [NEVER, ALWAYS]])
    found = [available(windows, episode) for episode in (1, 2, 3, 5, 6, 10**12)]
    assert found == [(0,), (0,), (0, 1), (0, 1), (0,), (0,)]


class Schedule(NamedTuple):
    switch_at: np.ndarray


@given(switches=st.sets(st.integers(2, 50), max_size=6), episode=st.integers(1, 60))
@settings(deadline=None)
def test_the_phase_counts_the_switches_that_have_come(switches, episode):
    params = Schedule(np.array(sorted(switches), np.int64))
    assert Gridworld().rules.phase(params, episode) == sum(switch <= episode for switch in switches)
