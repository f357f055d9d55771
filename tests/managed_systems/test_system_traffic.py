"""The junction."""

import json

import numpy as np
import pytest

from managed_systems import ALWAYS, NEVER, TrafficJunction, traffic

BALANCED = 2


def uniform_for(rate, k):
    """Return a uniform that inversion turns into k arrivals."""
    sums = np.array([*traffic.poisson_sums(rate), 1.0])
    guide = traffic.guide_to(sums)
    return next(u for u in np.linspace(0, 0.9999, 5_000) if traffic.poisson(sums, guide, u) == k)


def after(queues, action, arrivals, **config):
    """Take one step from given queues with given arrivals; return (queues, reward, signals)."""
    env = TrafficJunction(initial=(0, 0), **config)
    rules = env.rules
    draws = np.array([uniform_for(env.rates[0][1], arrivals[1]), uniform_for(env.rates[0][0], arrivals[0])])
    context = np.zeros(2)
    side = env.capacity + 1
    state, reward, terminated = rules.step(rules.params, 0, queues[0] * side + queues[1], action, draws, 0, context)
    assert terminated is False
    return divmod(state, side), reward, tuple(context)


def test_a_step_serves_lane_1_fills_lane_2_serves_lane_2_and_fills_lane_1():
    # Lane 1: 4 - 3 = 1, + 5 = 6. Lane 2: 1 + 3 = 4, - 3 = 1. Lane 2 is served after its arrivals: nothing is unused.
    assert after((4, 1), BALANCED, (5, 3)) == ((6, 1), -7.0, (5.0, 3.0))


def test_service_that_finds_no_vehicle_costs_three_a_unit():
    # Lane 1 is served before its arrivals: 3 - 1 = 2 unused. Lane 2: 0 + 1 arrived, 2 unused.
    assert after((1, 0), BALANCED, (4, 1)) == ((4, 0), -4.0 - 3 * 4, (4.0, 1.0))


def test_the_longer_lane_counts_twice_only_beyond_the_long_queue():
    assert after((5, 6), BALANCED, (5, 3))[:2] == ((7, 6), -13.0)
    assert after((5, 6), BALANCED, (6, 3))[:2] == ((8, 6), -14.0 - 8)
    assert after((5, 10), BALANCED, (2, 0))[:2] == ((4, 7), -11.0)
    assert after((5, 10), BALANCED, (2, 0), long_queue=6)[:2] == ((4, 7), -11.0 - 7)


def test_of_two_equally_long_lanes_one_counts_twice():
    assert after((10, 10), 0, (3, 0))[:2] == ((8, 8), -16.0 - 8)


def test_lanes_are_clipped_at_their_capacity_but_every_arrival_is_counted():
    # Lane 2 is clipped before it is served: 10 + 4 -> 10, - 3 = 7.
    assert after((10, 10), BALANCED, (8, 4)) == ((10, 7), -17.0 - 10, (8.0, 4.0))


def test_the_papers_actions_and_rates_are_the_defaults():
    env = TrafficJunction()
    assert env.rules.params.services.tolist() == [[5, 2], [2, 5], [3, 3], [7, 3], [3, 7]]
    assert env.rates == ((4, 2), (5, 7), (3, 1))
    assert env.rules.drifts == (3001, 8001)
    assert [env.rules.phase(env.rules.params, e) for e in (3000, 3001, 8000, 8001)] == [0, 1, 1, 2]
    assert env.rules.n_states == 121


def test_both_queues_start_uniform_in_one_to_three():
    env = TrafficJunction()
    env.reset(seed=4)
    starts = [tuple(env.reset()[0].tolist()) for _ in range(1_800)]
    counts = np.array([starts.count((a, b)) for a in (1, 2, 3) for b in (1, 2, 3)])
    assert counts.sum() == len(starts)
    # Chi-square with 8 degrees of freedom exceeds 26.1 once in a thousand times.
    assert ((counts - 200) ** 2 / 200).sum() < 26.1


@pytest.mark.parametrize(("episode", "rates"), [(1, (4, 2)), (3001, (5, 7)), (8001, (3, 1))])
def test_signals_tell_the_arrival_rates_of_the_phase(episode, rates):
    env = TrafficJunction()
    env.reset(seed=6)
    seen = []
    for _ in range(60):
        env.reset(options={"episode": episode})
        seen += [tuple(env.step(BALANCED)[4]["signals"].values()) for _ in range(30)]
    # 1,800 steps: five standard errors of the mean of the largest rate are 0.31.
    assert np.abs(np.mean(seen, axis=0) - rates).max() < 0.32


def test_only_the_cap_of_30_steps_ends_an_episode():
    env = TrafficJunction()
    env.reset(seed=1)
    assert [env.step(0)[2:4] for _ in range(30)] == [(False, False)] * 29 + [(False, True)]


def test_a_policy_near_the_optimum_returns_a_little_more_than_the_minus_317_of_a_learner():
    env = TrafficJunction()
    rules = env.rules
    # Value iteration over 60 sampled pairs of uniforms stands in for a learner.
    draws = np.random.default_rng(8).random((60, 2))
    landed = np.empty((rules.n_states, 3, len(draws)), np.int64)
    rewards = np.empty_like(landed, dtype=np.float64)
    for state, action, i in np.ndindex(*landed.shape):
        landed[state, action, i], rewards[state, action, i], _ = rules.step(
            rules.params, 0, state, action, draws[i], 0, np.zeros(2)
        )
    values = np.zeros(rules.n_states)
    for _ in range(60):
        q = (rewards + 0.9 * values[landed]).mean(axis=2)
        values = q.max(axis=1)
    env.reset(seed=9)
    returns = []
    for _ in range(150):
        queues, _ = env.reset(options={"episode": 1})
        total = 0.0
        for _ in range(30):
            queues, reward, *_ = env.step(q[queues[0] * 11 + queues[1]].argmax())
            total += reward
        returns.append(total)
    # The mean of 150 returns has a standard error of 3.8; it is -293 for this policy, which never explores.
    assert -312 < np.mean(returns) < -274


def test_the_reserve_is_closed_until_it_is_enabled():
    env = TrafficJunction()
    assert env.rules.windows.tolist() == [[1, ALWAYS]] * 3 + [[NEVER, ALWAYS]] * 2
    assert env.reset()[1]["available_actions"] == (0, 1, 2)
    env.enable_actions([4])
    assert env.rules.windows[:, 0].tolist() == [1, 1, 1, NEVER, 1]
    info = env.step(4)[4]
    assert info["available_actions"] == (0, 1, 2, 4)
    assert info["action_mask"].tolist() == [1, 1, 1, 0, 1]
    env.enable_actions((3, 4))
    assert env.reset()[1]["available_actions"] == (0, 1, 2, 3, 4)


def test_the_reserve_opens_by_itself_from_its_episode():
    env = TrafficJunction(reserve_from=10)
    assert env.reset(options={"episode": 9})[1]["available_actions"] == (0, 1, 2)
    assert env.reset(options={"episode": 10})[1]["available_actions"] == (0, 1, 2, 3, 4)
    assert env.get_state() == {"enabled": []}


@pytest.mark.parametrize("ids", [[2], [3, 5], [3, True], [3.0], 3, "3"])
def test_enabling_what_is_not_in_reserve_is_refused_and_enables_nothing(ids):
    env = TrafficJunction()
    with pytest.raises(ValueError, match=r"ids (is|has) .* in reserve.*\(3, 4\)"):
        env.enable_actions(ids)
    assert env.get_state() == {"enabled": []}
    assert env.reset()[1]["available_actions"] == (0, 1, 2)


def test_what_is_enabled_survives_as_json():
    env = TrafficJunction()
    env.enable_actions([np.int64(4)])
    state = json.loads(json.dumps(env.get_state()))
    assert state == {"enabled": [4]}
    twin = TrafficJunction()
    twin.enable_actions([3])
    twin.set_state(state)
    assert twin.get_state() == state
    assert np.array_equal(twin.rules.windows, env.rules.windows)
    assert twin.reset()[1]["available_actions"] == (0, 1, 2, 4)


def test_setting_back_the_state_gives_the_reserve_its_own_episode_again():
    env = TrafficJunction(reserve_from=10)
    env.enable_actions([3, 4])
    env.set_state({"enabled": []})
    assert env.reset()[1]["available_actions"] == (0, 1, 2)
    assert env.rules.windows[3:, 0].tolist() == [10, 10]


@pytest.mark.parametrize("state", [{}, [], {"enabled": [9]}, {"enabled": None}, {"enabled": [3], "more": 1}])
def test_a_malformed_state_is_refused_and_changes_nothing(state):
    env = TrafficJunction()
    env.enable_actions([3])
    with pytest.raises(ValueError, match=r"state"):
        env.set_state(state)
    assert env.get_state() == {"enabled": [3]}


def test_text_shows_each_queue_as_a_bar():
    env = TrafficJunction(render_mode="ansi", initial=(9, 9))
    env.reset()
    assert env.render() == "lane 1 |#######!!.|  9\nlane 2 |#######!!.|  9"


def test_an_image_shows_a_vehicle_in_each_place_taken():
    def coloured(queue):
        env = TrafficJunction(render_mode="rgb_array", initial=(queue, queue))
        env.reset()
        image = env.render()
        assert image.dtype == np.uint8
        assert image.shape == (404, 404, 3)
        return [int((image == colour).all(axis=2).sum()) for colour in ((240, 196, 84), (208, 76, 62))]

    none, three, nine = coloured(0), coloured(3), coloured(9)
    assert none == [0, 0]
    assert three[1] == 0
    assert nine[0] * 3 == three[0] * 7
    assert nine[1] * 3 == three[0] * 2


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"capacity": 0}, r"capacity is 0; give an integer of at least 1"),
        ({"initial": (1,)}, r"initial is \(1,\); give two integers"),
        ({"initial": (1, 11)}, r"initial\[1\] is 11; give an integer in 0..10"),
        ({"initial": (-1, 3)}, r"initial\[0\] is -1; give an integer in 0..10"),
        ({"initial": (3, 1)}, r"initial is \(3, 1\); give the fewest vehicles first"),
        ({"max_steps": 0}, r"max_steps is 0; give an integer of at least 1"),
        ({"services": []}, r"services is \(\); give at least one action"),
        ({"services": [(5, 2, 1)]}, r"services\[0\] is \(5, 2, 1\); give two integers"),
        ({"services": [(5, -2)]}, r"services\[0\]\[1\] is -2; give an integer of at least 0"),
        ({"services": [(5, 2.5)]}, r"services\[0\]\[1\] is 2.5; give an integer"),
        ({"services": 5}, r"services is 5; give a sequence of pairs"),
        ({"reserve": [(7,)]}, r"reserve\[0\] is \(7,\); give two integers"),
        ({"reserve_from": 0}, r"reserve_from is 0; give an integer of at least 1"),
        ({"reserve": [], "reserve_from": 5}, r"reserve_from is 5, but reserve is empty"),
        ({"rates": [(4, 2)]}, r"rates has 1 rows, but switch_at \(3001, 8001\) makes 3 phases; give one row for each"),
        ({"rates": [(4, -2), (1, 1), (1, 1)]}, r"rates\[0\]\[1\] is -2.0; give a finite number in 0..700"),
        ({"rates": [(4, 701), (1, 1), (1, 1)]}, r"rates\[0\]\[1\] is 701.0; give a finite number in 0..700"),
        ({"rates": [(4, float("nan")), (1, 1), (1, 1)]}, r"rates\[0\]\[1\] is nan; give a finite number"),
        ({"rates": [4, 2, 1]}, r"rates\[0\] is 4; give two arrival rates"),
        ({"switch_at": (8001, 3001)}, r"switch_at is \(8001, 3001\); give strictly increasing episodes"),
        ({"switch_at": (1, 3001)}, r"switch_at\[0\] is 1; give an integer of at least 2"),
        ({"long_queue": -1}, r"long_queue is -1; give an integer of at least 0"),
        ({"unused_penalty": -3}, r"unused_penalty is -3.0; give a finite number of at least 0"),
        ({"unused_penalty": float("inf")}, r"unused_penalty is inf; give a finite number of at least 0"),
    ],
)
def test_a_bad_value_is_refused_with_its_name_what_is_legal_and_the_way_out(config, message):
    with pytest.raises(ValueError, match=message):
        TrafficJunction(**config)
