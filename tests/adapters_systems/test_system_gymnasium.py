"""A Gymnasium environment as a managed system: which rules are its own, and what it carries."""

from collections.abc import Iterator
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import WrapperSpec
from gymnasium.spaces import Discrete
from gymnasium.wrappers import TimeLimit, TransformReward

from adapters.systems import GymnasiumSystem, make_system
from adapters.systems.checking import default_view
from managed_systems.gridworld import Gridworld
from mape.config import SystemConfig, from_table
from mape.errors import ConfigError
from mape.loop import Loop
from mape.ports import Episode
from mape.testing import check_system


class Shifted(gymnasium.Env):
    """Its actions begin at 3, and only the last of them is worth exploring."""

    def __init__(self):
        self.observation_space, self.action_space = Discrete(2), Discrete(3, start=3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {"action_mask": np.array([0, 0, 1], dtype=np.int8)}

    def step(self, action):
        return 1, 0.0, False, False, {"action_mask": np.array([1, 0, 0], dtype=np.int8)}


class House(Shifted):
    rules = "house rules"


class Grows(gymnasium.Env):
    """Its reward grows from episode to episode, and it says how far it is."""

    def __init__(self):
        self.observation_space, self.action_space, self.played = Discrete(2), Discrete(2), 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.played += 1
        return 0, {}

    def step(self, action):
        return 1, float(self.played), False, False, {}

    def get_state(self):
        return {"played": self.played}

    def set_state(self, state):
        self.played = state["played"]


class Loose(TimeLimit):
    """A subclass may do anything."""


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    before = dict(gymnasium.registry)
    hundredth = WrapperSpec("Hundredth", "gymnasium.wrappers:TransformReward", {"func": lambda reward: reward / 100})
    gymnasium.register("Hundredth-v0", Gridworld, additional_wrappers=(hundredth,))
    for kind in (Shifted, House, Grows):
        gymnasium.register(f"{kind.__name__}-v0", kind, max_episode_steps=4)
    yield
    gymnasium.registry.clear()
    gymnasium.registry.update(before)


def first_return(**system: object) -> float:
    chosen = from_table({"name": "one", "episodes": 1, "system": system, "plan": {"name": "morphin"}})
    loop = Loop(chosen, make_system(chosen.system))
    loop.run(1)
    return loop.log.window[-1].observation.signals["return"]


def test_rules_count_only_where_no_wrapper_changes_what_they_say() -> None:
    options = {"max_steps": 3}  # out of reach: three times -1
    assert first_return(id="mapek/Gridworld-v0", options=options) == -3.0
    assert first_return(id="Hundredth-v0", options=options) == pytest.approx(-0.03)
    chosen = from_table(
        {"name": "one", "episodes": 1, "system": {"id": "Hundredth-v0"}, "execute": {"engine": "compiled"}}
    )
    with pytest.raises(ConfigError, match="offers its rules"):
        Loop(chosen, make_system(chosen.system))


def test_a_wrapped_system_keeps_what_it_declares_and_every_clause() -> None:
    system = make_system(SystemConfig(id="Hundredth-v0", options={"switch_at": [3]}))
    assert (system.rules, system.max_steps, system.drifts, system.draws) == (None, 37, (3,), (0, 0))
    assert default_view("Hundredth-v0").max_steps == 200
    assert default_view("mapek/Gridworld-v0").max_steps is None
    assert "failed" not in {f.verdict for f in check_system(lambda: make_system(SystemConfig(id="Hundredth-v0")))}


def test_time_limits_are_transparent_and_the_least_of_them_caps_both_engines() -> None:
    config = SystemConfig(id="grid")
    inner = TimeLimit(Gridworld(), 5)
    inner.unwrapped.spec = gymnasium.spec("mapek/Gridworld-v0")
    system = GymnasiumSystem(TimeLimit(inner, 9), config)
    assert (system.rules, system.max_steps) == (inner.unwrapped.rules, 5)
    assert GymnasiumSystem(Loose(Gridworld(), 9), config).rules is None
    assert GymnasiumSystem(TransformReward(Gridworld(), abs), config).rules is None
    longer = SystemConfig(id="Shifted-v0", options={"max_episode_steps": 6})
    assert make_system(longer).max_steps == 6


def test_an_attribute_that_is_called_rules_and_is_none_is_no_rules() -> None:
    system = make_system(SystemConfig(id="House-v0"))
    assert (system.rules, system.draws, system.max_steps) == (None, (0, 0), 4)
    assert default_view("House-v0").max_steps is None
    env = Shifted()
    env.rules = SimpleNamespace(**{**Gridworld().rules._asdict()})
    del env.rules.explorable
    assert GymnasiumSystem(env, SystemConfig(id="house", max_steps=4)).rules is None


def test_the_mask_is_of_the_actions_in_their_order_wherever_they_begin() -> None:
    system = make_system(SystemConfig(id="Shifted-v0"))
    assert system.begin(Episode(1, 0, np.empty(0))) == (0, (3, 4, 5))
    assert [system.explorable(action) for action in (3, 4, 5)] == [False, False, True]
    system.step(3, np.empty(0))
    assert [system.explorable(action) for action in (3, 4, 5)] == [True, False, False]


def test_what_an_environment_carries_is_seen_by_the_check() -> None:
    found = {f.check: f for f in check_system(lambda: make_system(SystemConfig(id="Grows-v0")))}
    assert found["plays an episode the same whatever was played before"].verdict == "ok"


def test_state_goes_through_to_the_environment_and_the_windows_are_read_anew() -> None:
    one, other = (make_system(SystemConfig(id="mapek/TrafficJunction-v0")) for _ in range(2))
    offered = one.available(1)
    assert one.get_state() == {"enabled": []}
    assert offered == other.available(1)
    one.enable((3,))
    other.set_state(one.get_state())
    assert other.available(1) == one.available(1) == (*offered, 3)
    other.set_state({"enabled": []})
    assert other.available(1) == offered


def test_without_a_state_there_is_none_to_give_or_take() -> None:
    system = make_system(SystemConfig(id="Shifted-v0"))
    assert system.get_state() is None
    system.set_state(None)
    with pytest.raises(ValueError, match="takes no state"):
        system.set_state({"played": 3})


class Plant(Shifted):
    """Something that goes on while nobody looks."""

    redrivable = False


@pytest.mark.parametrize(
    ("name", "said", "redrivable"),
    [
        ("Grows-v0", None, True),
        ("Grows-v0", False, False),
        ("Plant-v0", None, False),
        ("Plant-v0", True, True),
        ("FrozenLake-v1", None, True),
    ],
)
def test_an_environment_can_be_driven_again_unless_it_or_the_config_says_no(name, said, redrivable):
    gymnasium.register("Plant-v0", Plant, max_episode_steps=4)
    system = make_system(SystemConfig(id=name, redrivable=said))
    assert system.redrivable is redrivable
    system.close()
