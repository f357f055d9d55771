"""A Gymnasium environment as a managed system: which rules are its own, and what it carries."""

import re
from collections.abc import Iterator
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import WrapperSpec
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete, Tuple
from gymnasium.wrappers import TimeLimit, TransformReward

from adapters.systems import GymnasiumSystem, make_system
from adapters.systems.checking import default_view
from adapters.systems.gymnasium_system import make_env
from adapters.systems.state_index import state_index
from managed_systems.gridworld import Gridworld
from mape.config import SystemConfig, from_table
from mape.errors import ConfigError, ManagedSystemError
from mape.loop import Loop
from mape.ports import Episode
from mape.testing import check_system


def view(name):
    env = make_env(SystemConfig(id=name))
    try:
        return default_view(name, env)
    finally:
        env.close()


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
    assert view("Hundredth-v0").max_steps == 200
    assert view("mapek/Gridworld-v0").max_steps is None
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
    assert view("House-v0").max_steps is None
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


@pytest.mark.parametrize(
    ("space", "states"),
    [
        (Discrete(3, start=-1), 3),
        (MultiDiscrete([2, 3], start=[1, -1]), 6),
        (MultiDiscrete(np.array([[2, 3], [2, 1]]), start=np.array([[5, 6], [7, 8]])), 12),
        (Tuple((MultiDiscrete([2, 2], start=[3, 4]), Discrete(3, start=9), MultiBinary(2))), 48),
    ],
    ids=str,
)
def test_each_observation_has_an_index_of_its_own_wherever_its_counts_begin(space, states):
    size, index = state_index(space, None, "any")
    space.seed(5)
    seen = {repr(sample): index(sample) for sample in (space.sample() for _ in range(40 * states))}
    assert size == states
    assert sorted(seen.values()) == list(range(states))


class Boxed(gymnasium.Env):
    """Its observation is the middle of its box, or what of that is finite."""

    action_space = Discrete(2)

    def __init__(self, low, high):
        self.observation_space = Box(low, high, (1,), np.float64)
        self._seen = np.clip([0.0], low, high)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._seen, {}

    def step(self, action):
        return self._seen, 0.0, False, False, {}


@pytest.mark.parametrize(
    ("low", "high", "grid"),
    [
        (20.0, 30.0, (20.0, 30.0)),
        (-300.0, -200.0, (-300.0, -200.0)),
        (-4.8, 4.8, (-4.8, 4.8)),
        (-np.inf, np.inf, (-10.0, 10.0)),
        (float(np.finfo(np.float32).min), float(np.finfo(np.float32).max), (-10.0, 10.0)),
        (0.0, np.inf, (0.0, 20.0)),
        (50.0, np.inf, (50.0, 70.0)),
        (-np.inf, -50.0, (-70.0, -50.0)),
        (5.0, 5.0, (-1.0, 11.0)),
        (1e30, 1e30, (-1.0, 2e30)),
    ],
)
def test_a_box_is_checked_through_a_grid_of_its_own_bounds_where_they_are_of_use(low, high, grid):
    gymnasium.register("Boxed-v0", lambda: Boxed(low, high), max_episode_steps=4)
    config = view("Boxed-v0")
    assert (config.discretise.low, config.discretise.high) == ((grid[0],), (grid[1],))
    system = make_system(config)
    state, actions = system.begin(Episode(1, 0, np.empty(0)))
    assert 0 <= state < system.n_states == 3
    assert actions == (0, 1)
    system.close()


@pytest.mark.parametrize(
    ("space", "said"),
    [
        (Discrete(50_000_001), "50000001"),
        (MultiDiscrete([10] * 20), "more than 10^15"),
        (MultiBinary(20_000), "more than 10^15"),
    ],
)
def test_a_table_that_does_not_fit_is_refused_however_long_its_number_of_states_is(space, said):
    with pytest.raises(ConfigError, match=re.escape(f"any has {said} states; a table of more than 50000000")):
        state_index(space, None, "any")


class Offers(gymnasium.Env):
    """Offers these actions and this mask at its reset, and that mask after a step."""

    observation_space = Discrete(2)

    def __init__(self, actions=None, mask=None, later=None):
        self.action_space = Discrete(2, start=1)
        self.offered = {} if actions is None else {"available_actions": actions}
        self.mask = {} if mask is None else {"action_mask": mask}
        self.later = self.mask if later is None else {"action_mask": later}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, self.offered | self.mask

    def step(self, action):
        return 1, 0.0, False, False, self.later


def offering(**options):
    gymnasium.register("Offers-v0", Offers, max_episode_steps=4)
    return SystemConfig(id="Offers-v0", options=options)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (
            {"actions": (1, 7)},
            "Offers-v0 offers action 7 in info['available_actions'] = (1, 7) of episode 1; its action space has 1 .. 2",
        ),
        ({"actions": np.array([0, 1])}, "Offers-v0 offers action 0 in info['available_actions'] = (0, 1) of episode"),
        (
            {"mask": np.ones(3, np.int8)},
            "Offers-v0 gave an info['action_mask'] of shape (3,); it has a mark for each of 2 actions, shape (2,)",
        ),
        ({"mask": [1]}, "Offers-v0 gave an info['action_mask'] of shape (1,); it has a mark for each of 2 actions"),
        ({"mask": 1}, "Offers-v0 gave an info['action_mask'] of shape (); it has a mark for each of 2 actions"),
        ({"mask": [1, 1], "later": np.ones((2, 1))}, "Offers-v0 gave an info['action_mask'] of shape (2, 1); it has"),
    ],
)
def test_actions_and_marks_that_the_action_space_does_not_have_are_refused_and_found_by_the_check(options, says):
    system = offering(**options)
    chosen = from_table({"name": "one", "episodes": 2, "system": {"id": "any"}, "plan": {"name": "morphin"}})
    with pytest.raises(ManagedSystemError) as refused:
        Loop(chosen, make_system(system)).run(2)
    assert says in str(refused.value)
    found = {f.check: f for f in check_system(lambda: make_system(system))}
    told = found["stays within its states, with finite rewards and known actions"]
    assert told.verdict == "failed"
    assert says in told.detail


@pytest.mark.parametrize("options", [{"actions": [2]}, {"mask": [True, False]}, {"mask": (1, 1), "later": [0, 1]}])
def test_actions_and_marks_of_the_action_space_are_taken(options):
    system = offering(**options)
    found = check_system(lambda: make_system(system))
    assert "failed" not in {f.verdict for f in found}


def test_an_action_space_that_grows_between_two_episodes_is_asked_anew():
    system = make_system(offering(actions=(1, 2, 3), mask=(1, 0, 1)))
    system.env.unwrapped.action_space = Discrete(3, start=1)
    assert system.begin(Episode(1, 0, np.empty(0))) == (0, (1, 2, 3))
    assert [system.explorable(action) for action in (1, 2, 3)] == [True, False, True]
