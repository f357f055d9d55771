import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mape import registry
from mape.specs import PartSpec

NAMES = ["exponential", "success", "geometric", "constant"]
returns = st.lists(st.sampled_from([93.0, 0.0, -37.0]), max_size=80)


def schedule(name, **options):
    return registry.build("schedule", PartSpec.model_validate({"name": name, **options}))


def epsilons(part, episode_returns):
    found = []
    for x in episode_returns:
        found.append(part.epsilon)
        part.advance(x)
    return found


def test_the_exponential_schedule_follows_its_formula_and_starts_anew_on_reset():
    part = schedule("exponential", eps_min=0.1, decay=0.05)
    formula = [0.1 + 0.9 * math.exp(-0.05 * e) for e in range(30)]
    assert epsilons(part, [0.0] * 30) == formula
    part.reset()
    assert epsilons(part, [93.0] * 30) == formula


def test_the_geometric_schedule_multiplies_down_to_its_floor_and_starts_anew_on_reset():
    part = schedule("geometric", eps_min=0.5, factor=0.8)
    assert epsilons(part, [0.0] * 5) == [1.0, 0.8, 0.8 * 0.8, 0.8 * (0.8 * 0.8), 0.5]
    part.reset()
    assert part.epsilon == 1.0


def test_the_constant_schedule_never_moves():
    part = schedule("constant", epsilon=0.25)
    assert epsilons(part, [0.0, 93.0, -37.0]) == [0.25] * 3
    part.reset()
    assert part.epsilon == 0.25


def test_before_the_first_response_the_success_rule_only_counts():
    part, plain = schedule("success"), schedule("exponential")
    assert epsilons(part, [93.0, -37.0] * 20) == epsilons(plain, [93.0, -37.0] * 20)


def test_after_a_response_the_success_rule_stretches_and_shrinks_the_counter_step_by_step():
    part = schedule("success", eps_min=0.1, decay=0.05)
    part.advance(93.0)
    part.reset()
    counter = 0.0
    for episode_return, factor in [(-37.0, 0.6), (-37.0, 0.6), (0.0, 0.6), (93.0, 15.0), (-37.0, 0.6), (1e-9, 15.0)]:
        assert part.epsilon == 0.1 + 0.9 * math.exp(-0.05 * counter)
        part.advance(episode_return)
        counter = (counter + 1.0) * factor
        assert part.state()["counter"] == counter
    part.reset()
    assert part.epsilon == 1.0
    part.advance(-37.0)
    assert part.state()["counter"] == 0.6


def test_the_success_rule_stays_near_full_exploration_until_the_first_success_and_then_stops_at_once():
    part = schedule("success", eps_min=0.1, decay=0.05)
    part.reset()
    assert min(epsilons(part, [-37.0] * 200)) > 0.93
    part.advance(93.0)
    part.advance(93.0)
    assert part.epsilon < 0.11


def test_the_success_rules_counter_is_capped_where_exploration_is_at_its_floor():
    part = schedule("success", eps_min=0.1, decay=0.05)
    part.reset()
    for _ in range(400):
        part.advance(93.0)
    assert part.state()["counter"] == 1e6
    assert part.epsilon == 0.1


@pytest.mark.parametrize("name", NAMES)
@given(returns, st.data())
def test_epsilon_is_a_probability_whatever_happens(name, episode_returns, data):
    part = schedule(name)
    for x in episode_returns:
        if data.draw(st.booleans()):
            part.reset()
        else:
            part.advance(x)
        assert 0.0 <= part.epsilon <= 1.0


@given(st.floats(0, 1), st.floats(0, 1e300), st.floats(0, 1e300))
def test_the_exponential_schedule_stays_within_its_limits_for_every_option(eps_min, decay, counter):
    part = schedule("exponential", eps_min=eps_min, decay=decay)
    part.restore({"counter": counter})
    assert eps_min <= part.epsilon <= 1.0


@pytest.mark.parametrize("name", NAMES)
@given(returns, returns, st.booleans())
def test_a_schedule_takes_up_where_its_state_was_given(name, before, after, responded):
    original, heir = schedule(name), schedule(name)
    if responded:
        original.reset()
    epsilons(original, before)
    heir.restore(json.loads(json.dumps(original.state())))
    assert epsilons(heir, after) == epsilons(original, after)
