"""What an environment returns outside of what it declares is refused, by its value; nothing is taken for another."""

from fractions import Fraction

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete, Tuple
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from adapters.cli.main import main
from adapters.systems import GymnasiumSystem, make_system
from adapters.systems.state_index import state_index
from mape.config import BoxGrid, SystemConfig, from_table
from mape.errors import ConfigError, ManagedSystemError, NonFiniteError
from mape.loop import Loop
from mape.testing import check_system

STAYS = "stays within its states, with finite rewards and known actions"

numbers = st.integers(-9, 9) | st.floats() | st.sampled_from([2**70, -0.0, 1.5, np.int8(2), np.uint8(3), np.float64(2)])
anything = st.one_of(
    numbers,
    st.none(),
    st.booleans(),
    st.text(max_size=3),
    st.complex_numbers(),
    st.lists(numbers, max_size=4),
    arrays.arrays(
        st.sampled_from([np.int64, np.int8, np.uint8, np.bool_]), arrays.array_shapes(max_dims=2, max_side=3)
    ),
)


def index_or_none(space, seen, grid=None):
    size, index = state_index(space, grid, "any")
    try:
        state = index(seen)
    except ManagedSystemError as error:
        said = str(error)
    else:
        said = ""
    if said:
        assert said.startswith("any gave the observation ")
        assert str(space) in said
        return None
    assert type(state) is int
    assert 0 <= state < size
    return state


@settings(max_examples=300)
@given(start=st.integers(-4, 4), n=st.integers(1, 6), seen=anything)
@example(start=0, n=3, seen=np.array([1]))
@example(start=0, n=3, seen="1")
@example(start=-1, n=3, seen=2)
def test_a_discrete_observation_has_a_state_exactly_where_its_space_contains_it(start, n, seen):
    space = Discrete(n, start=start)
    state = index_or_none(space, seen)
    assert (state is not None) == space.contains(seen)
    assert state is None or state == int(seen) - start


@settings(max_examples=300)
@given(data=st.data(), kind=st.sampled_from(["counts", "bits"]))
def test_an_array_of_counts_has_a_state_exactly_where_each_of_them_is_a_count_of_its_space(data, kind):
    shape = data.draw(arrays.array_shapes(max_dims=2, max_side=3))
    counts = data.draw(arrays.arrays(np.int64, shape, elements=st.integers(1, 4)))
    space = MultiDiscrete(counts) if kind == "counts" else MultiBinary(shape)
    kinds = st.sampled_from([np.int64, np.int8, np.float64])
    seen = data.draw(anything | kinds.flatmap(lambda dtype: arrays.arrays(dtype, shape, elements=st.integers(-1, 4))))
    as_array = np.asarray(seen, dtype=object) if isinstance(seen, list) else np.asarray(seen)
    most = counts if kind == "counts" else np.full(shape, 2)
    legal = as_array.shape == shape and all(
        isinstance(value, (bool, int, float, np.number)) and 0 <= value < n and value == int(value)
        for value, n in zip(as_array.ravel().tolist(), most.ravel().tolist(), strict=True)
    )
    assert (index_or_none(space, seen) is not None) == legal


@settings(max_examples=200)
@given(seen=arrays.arrays(st.sampled_from([np.float32, np.float64]), (2,)), bins=st.integers(1, 5))
@example(seen=np.array([1e300, -1e300]), bins=3)
@example(seen=np.array([np.nan, 0.0]), bins=3)
@example(seen=np.array([0.1 + 1e-9, 0.0]), bins=3)  # as a float32 it is the bound
def test_a_box_is_binned_exactly_where_it_contains_what_is_seen(seen, bins):
    space = Box(np.array([-1.0, -np.inf], np.float32), np.array([0.1, np.inf], np.float32))
    with np.errstate(over="ignore"):
        as_float32 = seen.astype(np.float32)
    state = index_or_none(space, seen, BoxGrid(low=(-1.0, -3.0), high=(0.1, 3.0), bins=(bins, bins)))
    assert (state is not None) == bool(np.isfinite(seen).all() and -1.0 <= as_float32[0] <= np.float32(0.1))


@pytest.mark.parametrize("seen", [(1, 2, 3), 4, (5, np.array([0, 0])), (1, np.array([0, 2])), "ab", None])
def test_a_tuple_is_refused_for_any_part_that_is_outside(seen):
    assert index_or_none(Tuple((Discrete(3), MultiBinary(2))), seen) is None
    assert index_or_none(Tuple((Discrete(3), MultiBinary(2))), (1, np.array([0, 1]))) is not None


class Answers(gymnasium.Env):
    """Returns what it is told to at the first step of episode 2, or at its reset; else what fits."""

    def __init__(self, space=None, seen=0, step=None, reset=None):
        self.observation_space, self.action_space = space or Discrete(2), Discrete(2)
        self._seen, self._step, self._reset = seen, step or {}, reset or {}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._episode, self._steps = options["episode"], 0
        return self._seen, dict(self._reset) if self._episode == 2 else {}

    def step(self, action):
        self._steps += 1
        spoilt = self._step if (self._episode, self._steps) == (2, 1) else {}
        plain = {"seen": self._seen, "reward": 1.0, "terminated": False, "truncated": False, "info": {}}
        return tuple({**plain, **spoilt}.values())


@pytest.fixture
def system_of(own_registry):
    def make(kind=Answers, **options):
        name = f"{kind.__name__}-v0"
        gymnasium.registry.pop(name, None)
        gymnasium.register(name, lambda: kind(**options), max_episode_steps=4)
        return make_system(SystemConfig(id=name))

    return make


@pytest.fixture
def own_registry():
    before = dict(gymnasium.registry)
    yield
    gymnasium.registry.clear()
    gymnasium.registry.update(before)


def refused(system, episodes=3):
    """Return what a run over a system is refused with, and the passes before it."""
    chosen, loops = from_table({"name": "one", "episodes": episodes, "system": {"id": "any"}}), []

    def run():
        loops.append(Loop(chosen, system))
        loops[0].run(episodes)

    with pytest.raises(ManagedSystemError) as error:
        run()
    return str(error.value), loops[0].log.passes if loops else 0


@pytest.mark.parametrize(
    ("step", "says"),
    [
        ({"seen": [0, 4]}, ["[0, 4]", "Discrete(2)"]),
        ({"seen": 1.0}, ["1.0", "Discrete(2)"]),
        ({"seen": np.array([1])}, ["[1]", "Discrete(2)"]),
        ({"reward": "3"}, ["reward '3'", "real number"]),
        ({"reward": np.array([1.0])}, ["reward [1.0]", "real number"]),
        ({"reward": np.array("1.0")}, ["reward '1.0'", "real number"]),
        ({"reward": np.complex128(1 + 2j)}, ["reward (1+2j)", "real number"]),
        ({"reward": 10**400}, ["reward", "real number"]),
        ({"reward": None}, ["reward None", "real number"]),
        ({"terminated": None}, ["terminated = None", "True or False"]),
        ({"terminated": "no"}, ["terminated = 'no'", "True or False"]),
        ({"truncated": np.array([False, True])}, ["truncated = [False, True]", "True or False"]),
        ({"truncated": 2}, ["truncated = 2", "True or False"]),
        ({"info": None}, ["info None", "a dict"]),
        ({"info": {"action_mask": [2, 1]}}, ["[2, 1]", "0 or 1"]),
        ({"info": {"action_mask": [float("nan"), 1]}}, ["[nan, 1]", "0 or 1"]),
        ({"info": {"action_taken": 1.0}}, ["info['action_taken'] = 1.0", "0 .. 1"]),
    ],
)
def test_what_a_step_gives_outside_of_what_is_declared_is_refused_where_it_happens(system_of, step, says):
    system = system_of(step=step)
    told, passes = refused(system)
    assert [part for part in ["Answers-v0", *says, "episode 2 at step 1", "1 passes before"] if part not in told] == []
    assert passes == 1
    found = {f.check: f for f in check_system(lambda: system_of(step=step))}
    assert found[STAYS].verdict == "failed"
    assert says[0] in found[STAYS].detail


@pytest.mark.parametrize(
    ("reset", "says"),
    [
        ({"available_actions": "01"}, ["'01'", "0 .. 1"]),
        ({"available_actions": 1}, ["= 1", "0 .. 1"]),
        ({"available_actions": [True, False]}, ["[True, False]", "0 .. 1"]),
        ({"available_actions": np.array([0.0, 1.0])}, ["[0.0, 1.0]", "0 .. 1"]),
        ({"action_mask": "11"}, ["shape ()", "shape (2,)"]),
        ({"action_mask": [0, 0]}, ["[0, 0]", "legal_actions"]),
        ({"legal_actions": [2]}, ["action 2", "0 .. 1"]),
        ({"legal_actions": [1, 1]}, ["[1, 1]", "each id once"]),
        ({"legal_actions": np.array([1, 0, 1], np.int8)}, ["[1, 0, 1]", "each of 2 actions"]),
        ({"legal_actions": np.zeros(2, np.int8)}, ["[0, 0]", "one action at least"]),
        ({"legal_actions": None}, ["None", "0 .. 1"]),
    ],
)
def test_what_a_reset_gives_outside_of_what_is_declared_is_refused(system_of, reset, says):
    told, passes = refused(system_of(reset=reset))
    assert [part for part in ["Answers-v0", *says, "episode 2", "1 passes before"] if part not in told] == []
    assert passes == 1
    found = {f.check: f for f in check_system(lambda: system_of(reset=reset))}
    assert found[STAYS].verdict == "failed"


def test_the_first_finding_of_a_wrong_cell_is_its_observation(system_of):
    told, _ = refused(system_of(space=MultiDiscrete([3, 4]), seen=np.array([0, 3]), step={"seen": np.array([0, 4])}))
    assert told.startswith(
        "Answers-v0 gave the observation [0, 4], which is not in its observation space MultiDiscrete("
    )


@pytest.mark.parametrize("reward", [True, np.True_, 3, np.float32(0.5), np.int8(2), np.array(2.0), Fraction(1, 2)])
@pytest.mark.parametrize("ended", [np.False_, 0, np.array(False)])
def test_a_number_and_a_truth_value_of_any_library_are_what_they_are(system_of, reward, ended):
    system = system_of(step={"reward": reward, "terminated": ended})
    chosen = from_table({"name": "one", "episodes": 2, "system": {"id": "any"}})
    loop = Loop(chosen, system)
    loop.run(2)
    assert loop.log.window[-1].observation.signals["return"] == 3.0 + float(reward)


@settings(max_examples=100, deadline=None)
@given(signal=anything, reward=anything)
def test_signals_and_rewards_are_learnt_as_they_are_or_not_at_all(signal, reward):
    class Signalling(Answers):
        signal_names = ("load",)

        def step(self, action):
            seen, _, terminated, truncated, _ = super().step(action)
            return seen, reward, terminated, truncated, {"signals": {"load": signal}}

    def real(value):
        plain = isinstance(value, (bool, int, float, np.number)) or (np.shape(value) == () and hasattr(value, "dtype"))
        return plain and not isinstance(value, (str, complex)) and np.isfinite(float(value))

    assume(not any(isinstance(value, float) and abs(value) > 1e300 for value in (signal, reward)))
    loop = Loop(
        from_table({"name": "one", "episodes": 1, "system": {"id": "any"}}),
        GymnasiumSystem(Signalling(), SystemConfig(id="signalling", max_steps=1)),
    )
    if real(signal) and real(reward):
        loop.run(1)
        signals = loop.log.window[-1].observation.signals
        assert (signals["load"], signals["return"]) == (float(signal), float(reward))
    else:
        with pytest.raises((ManagedSystemError, NonFiniteError), match="episode 1"):
            loop.run(1)


def test_the_places_of_a_table_hold_what_they_say_or_are_refused(own_registry):
    class Table(gymnasium.Env):
        observation_space, action_space = Discrete(1), Discrete(1)
        initial_state_distrib = np.ones(1)

        def __init__(self, outcome, mask=None):
            self.P = {0: {0: [outcome]}}
            if mask is not None:
                self.action_mask = lambda state: mask

    gymnasium.register("Table-v0", Table, max_episode_steps=4)
    for outcome in ((1.0, 0, "1.0", False), ("1.0", 0, 1.0, False), (1.0, 0, 1.0, "False"), (1.0, 0.0, 1.0, False)):
        with pytest.raises(ConfigError, match=r"P\[0\]\[0\] of Table-v0 is no list of outcomes"):
            make_system(SystemConfig(id="Table-v0", tabulated=True, options={"outcome": outcome}))
    for mask in (["1"], [2], [0.5]):
        with pytest.raises(ConfigError, match="a mark is 0 or 1"):
            make_system(
                SystemConfig(id="Table-v0", tabulated=True, options={"outcome": (1.0, 0, 1.0, False), "mask": mask})
            )


class OldStep(Answers):
    def step(self, action):
        seen, reward, terminated, _, info = super().step(action)
        return seen, reward, terminated, info


class OldReset(Answers):
    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed, options=options)[0]


@pytest.mark.parametrize("kind", [OldStep, OldReset])
def test_the_api_of_before_gymnasium_026_is_named_whatever_stands_around_the_environment(system_of, kind):
    through_wrappers, _ = refused(system_of(kind))
    bare, _ = refused(GymnasiumSystem(kind(), SystemConfig(id="bare", max_steps=4)))
    for told in (through_wrappers, bare):
        assert "before 0.26" in told
        assert "episode 1" in told


def test_what_a_reset_raises_has_no_circle_among_its_causes(system_of):
    class Stuck(Answers):
        def reset(self, *, seed=None, options=None):
            raise RuntimeError("the valve is stuck")

    loop = Loop(from_table({"name": "one", "episodes": 1, "system": {"id": "any"}}), system_of(Stuck))
    with pytest.raises(ManagedSystemError, match="the valve is stuck") as error:
        loop.run(1)
    assert error.value.__cause__.__cause__ is None


class Unseeded(Answers):
    def reset(self):
        return super().reset(options={"episode": 1})


class NoOptions(Answers):
    def reset(self, *, seed=None):
        return super().reset(seed=seed, options={"episode": 1})


@pytest.mark.parametrize(
    ("kind", "takes", "redrivable"), [(Unseeded, (), False), (NoOptions, ("seed",), True), (Answers, None, True)]
)
def test_a_reset_is_given_what_the_config_says_that_it_takes(own_registry, kind, takes, redrivable):
    gymnasium.register(f"{kind.__name__}-v0", kind, max_episode_steps=4)
    name = f"{kind.__name__}-v0"
    if takes is not None:
        with pytest.raises(ConfigError, match=r"system\.reset_takes = "):
            make_system(SystemConfig(id=name))
    switch = {} if takes is None else {"reset_takes": takes}
    system = make_system(SystemConfig(id=name, **switch))
    assert system.redrivable is redrivable
    loop = Loop(from_table({"name": "one", "episodes": 3, "system": {"id": "any"}}), system)
    loop.run(3)
    assert loop.log.passes == 3


def test_a_reset_that_needs_its_options_is_not_kept_from_them():
    with pytest.raises(ConfigError, match="its randomness"):
        make_system(SystemConfig(id="mapek/Gridworld-v0", reset_takes=("seed",)))


def test_rewards_of_any_size_are_printed_in_a_few_digits(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = (
        "size = [1, 3], start = [0, 0], goals = [[0, 2]], switch_at = [], step_reward = -1e200, goal_reward = 1e200"
    )
    (tmp_path / "large.toml").write_text(
        f'name = "large"\nepisodes = 5\nsystem = {{ id = "mapek/Gridworld-v0", options = {{ {options} }} }}\n'
    )
    assert main(["run", "large.toml", "--trials", "2", "--out", "out", "--no-figures"]) == 0
    printed = capsys.readouterr()
    assert max(map(len, (printed.out + printed.err).split())) < 70
