"""What is said of an environment that refuses its options."""

import gymnasium
import pytest

from adapters.systems.refusals import refusal
from managed_systems import register_envs
from mape.config import SystemConfig
from mape.errors import UnknownName


def refused(identifier: str, **options: object) -> Exception:
    register_envs()
    with pytest.raises((TypeError, ValueError)) as raised:
        gymnasium.make(identifier, disable_env_checker=True, **options)
    return refusal(SystemConfig(id=identifier, options=options), raised.value)


@pytest.mark.parametrize("identifier", ["mapek/Gridworld-v0", "managed_systems:mapek/Gridworld-v0"])
def test_an_option_that_an_environment_does_not_have_is_named_with_those_it_has(identifier: str) -> None:
    error = refused(identifier, goal_rewards=1.0)

    assert isinstance(error, UnknownName)
    assert str(error).startswith(
        f"unknown option of system '{identifier}': 'goal_rewards'; did you mean 'goal_reward'? Known: "
    )
    assert "start, " in str(error)
    assert "self" not in str(error)
    assert "__init__" not in str(error)


def test_a_value_that_an_environment_refuses_is_said_in_its_own_words_once() -> None:
    assert str(refused("mapek/Gridworld-v0", walls=[[0, 0]], goals=[[0, 0]])).endswith(
        ": goal (0, 0) is a wall; take it out of walls, or give another goal"
    )
    said = str(refused("FrozenLake-v1", desc=3))
    assert said.startswith("system 'FrozenLake-v1' with options {'desc': 3}: ")
    assert said.count("'desc': 3") == 1
