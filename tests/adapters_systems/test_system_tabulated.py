"""An environment that is played from its transition table: the same draws, the same bits, and what is refused."""

from collections.abc import Iterator
from itertools import accumulate

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import WrapperSpec
from gymnasium.envs.toy_text.utils import categorical_sample
from gymnasium.spaces import Discrete, MultiBinary
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import TimeLimit, TransformReward
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mape_runs import hashes, loop_of

from adapters.systems import Tabulated, make_system
from adapters.systems.checking import check_environment
from adapters.systems.tabulated import WITH_TABLE
from mape.config import SystemConfig, from_table
from mape.errors import ConfigError
from mape.testing import check_system


class Table(gymnasium.Env):
    """Plays ``table[state][action]`` as Gymnasium's toy texts do."""

    def __init__(self, table, starts, mask=None):
        self.P, self.initial_state_distrib = table, starts
        self.observation_space, self.action_space = Discrete(len(table)), Discrete(len(table[0]))
        if mask is not None:
            self.action_mask = lambda state: np.array(mask[state], np.int8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = int(categorical_sample(self.initial_state_distrib, self.np_random))
        return self.s, {}

    def step(self, action):
        row = self.P[self.s][action]
        _, self.s, reward, terminated = row[categorical_sample([outcome[0] for outcome in row], self.np_random)]
        return self.s, reward, terminated, False, {}


class Drifting(Table):
    drifts = (5,)


STAYS = [[[[1.0, 0, 1.0, False]]]]  # one state, one action


@pytest.fixture(autouse=True, scope="module")
def registered() -> Iterator[None]:
    before = dict(gymnasium.registry)
    gymnasium.register("Table-v0", Table)
    gymnasium.register("Drifting-v0", Drifting)
    halved = WrapperSpec("Halved", "gymnasium.wrappers:TransformReward", {"func": lambda reward: reward / 2})
    gymnasium.register("Halved-v0", "gymnasium.envs.toy_text.frozen_lake:FrozenLakeEnv", additional_wrappers=(halved,))
    gymnasium.register(
        "Lake-v0",
        lambda render_mode=None: Tabulated(gymnasium.make("FrozenLake-v1"), render_mode=render_mode),
    )
    yield
    gymnasium.registry.clear()
    gymnasium.registry.update(before)


def tabulated(name, max_steps=None, **options):
    return make_system(SystemConfig(id=name, tabulated=True, max_steps=max_steps, options=options))


LEFT_OVER = [0.1] * 10 + [0.0, 0.0]  # in sum 0.9999999999999999
# Sums that are 1, that rounding leaves below or above it, and outcomes that never happen, last ones among them.
probabilities = st.sampled_from(
    [
        [1.0],
        [0.0, 1.0],
        [0.25, 0.0, 0.75],
        [0.5, 0.5, 0.0],
        [0.1] * 10,
        LEFT_OVER,
        [1 / 3] * 3,
        [1 / 49] * 49,
    ]
) | st.lists(st.integers(0, 5), min_size=1, max_size=6).filter(sum).map(lambda found: [k / sum(found) for k in found])


@st.composite
def tables(draw):
    """Draw a small table as the system of a config."""
    n_states, n_actions = draw(st.integers(1, 5)), draw(st.integers(1, 3))
    outcome = st.tuples(
        st.integers(0, n_states - 1), st.integers(-3, 3) | st.floats(-50, 50), st.sampled_from([False, False, True])
    )
    table = [[[[p, *draw(outcome)] for p in draw(probabilities)] for _ in range(n_actions)] for _ in range(n_states)]
    weights = draw(st.lists(st.integers(0, 3), min_size=n_states, max_size=n_states).filter(any))
    options = {"table": table, "starts": [weight / sum(weights) for weight in weights]}
    if draw(st.booleans()):
        marks = st.lists(st.integers(0, 1), min_size=n_actions, max_size=n_actions)
        options["mask"] = draw(st.lists(marks, min_size=n_states, max_size=n_states))
    return {"id": "Table-v0", "tabulated": True, "max_steps": draw(st.integers(1, 20)), "options": options}


unit = st.sampled_from([0.0, 0.5, 1.0]) | st.floats(0, 1)


# One detector, planner and schedule throughout: each other one would have to be compiled too.
@settings(max_examples=40)
@given(tables(), unit, unit, st.booleans(), st.integers(0, 2**63 - 1))
def test_compiled_and_called_episodes_of_any_table_are_the_same_bit_for_bit(system, discount, eps_min, mask, seed):
    found = []
    for engine in ("python", "compiled"):
        chosen = from_table({
            "episodes": 8,
            "seed": seed,
            "system": system,
            "learner": {"name": "q_learning", "discount": discount},
            "monitor": {"detectors": [{"name": "page_hinkley", "threshold": 10.0}]},
            "plan": {"name": "morphin", "schedule": {"name": "exponential", "eps_min": eps_min, "decay": 0.3}},
            "execute": {"engine": engine, "mask_greedy": mask},
        })  # fmt: skip
        loop = loop_of(chosen)
        assert loop.execute.compiled == (engine == "compiled")
        loop.run(8)
        found.append((loop.log.passes, hashes(loop)))
    assert found[0] == found[1]


class Fed:
    """Gives uniforms in turn, where a generator is asked for them."""

    def __init__(self, uniforms):
        self.random = iter(np.asarray(uniforms).tolist()).__next__


@example(LEFT_OVER, 0.5)
@given(probabilities, st.floats(0, 1, exclude_max=True))
def test_a_uniform_draws_what_gymnasium_draws_and_what_rounding_leaves_is_the_last_outcomes(chances, somewhere):
    going = [[[[chance, k, 0.0, False] for k, chance in enumerate(chances)]]] * len(chances)
    env = Tabulated(Table(going, chances), max_steps=1)
    sums = list(accumulate(chances))
    edges = [edge for total in sums for edge in (np.nextafter(total, 0.0), total, np.nextafter(total, 1.0))]
    for u in (0.0, somewhere, *(float(edge) for edge in edges if edge < 1.0), float(np.nextafter(1.0, 0.0))):
        drawn = categorical_sample(chances, Fed([u]))
        expected = drawn if u < sums[-1] else max(k for k, chance in enumerate(chances) if chance > 0.0)
        assert env.reset(options={"uniforms": [u, u]})[0] == expected
        assert env.step(0)[0] == expected


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("FrozenLake-v1", {}),
        ("FrozenLake8x8-v1", {"success_rate": 0.8, "reward_schedule": (10, -10, -1)}),
        ("FrozenLake-v1", {"desc": ["SFS", "FHF", "SFG"], "is_slippery": False}),
        ("CliffWalkingSlippery-v1", {}),
        ("Taxi-v4", {}),
        ("Taxi-v4", {"is_rainy": True}),
        ("Table-v0", {"table": [[[[0.1, 0, k, False] for k in range(10)]]], "starts": [1.0]}),
    ],
)
def test_the_same_uniforms_give_the_episodes_of_the_unmodified_environment(name, options):
    env = gymnasium.make(name, disable_env_checker=True, **options)
    table, base = Tabulated(env, max_steps=60), env.unwrapped
    everything = [1] * base.action_space.n
    assert table.rules.max_steps == 60
    generator = np.random.default_rng(7)
    for _ in range(30):
        uniforms = generator.random(table.rules.episode_draws)
        base.np_random = Fed(uniforms)
        state, info = table.reset(options={"uniforms": uniforms})
        seen, said = base.reset()
        ended = False
        while not ended:
            assert state == seen
            assert info["action_mask"].tolist() == list(said.get("action_mask", everything))
            action = int(generator.integers(base.action_space.n))
            *moved, truncated, info = table.step(action)
            *expected, _, said = base.step(action)
            assert moved == expected
            (state, _, terminated), seen = moved, expected[0]
            ended = terminated or truncated


@pytest.mark.parametrize("engine", ["python", "compiled"])
def test_exploration_keeps_to_the_mask_of_the_taxi(engine):
    chosen = from_table({
        "episodes": 5,
        "system": {"id": "Taxi-v4", "tabulated": True},
        "plan": {"name": "q_learning", "schedule": {"name": "constant", "epsilon": 1.0}},
        "execute": {"engine": engine},
    })  # fmt: skip
    loop, steps = loop_of(chosen), []
    loop.execute.record_trace(1, 5, lambda number, trace: steps.extend(trace[:, :2].astype(int).tolist()))
    loop.run(5)
    taxi = gymnasium.make("Taxi-v4").unwrapped
    assert len({action for _, action in steps}) == 6
    assert all(taxi.action_mask(state)[action] for state, action in steps)


@pytest.mark.parametrize("name", WITH_TABLE)
def test_every_id_that_is_said_to_have_a_table_keeps_every_clause(name):
    config = SystemConfig(id=name, tabulated=True, max_steps=50)
    findings = [check_environment(config), *check_system(lambda: make_system(config))]
    remarks = [f for f in findings if f.verdict != "ok"]
    assert ["its mask is soft" in f.detail for f in remarks] == [True] * name.startswith("Taxi")


def test_gymnasiums_own_check_passes_without_a_warning_and_draws():
    check_env(gymnasium.make("Lake-v0").unwrapped)
    check_env(Tabulated(gymnasium.make("Taxi-v4")), skip_render_check=True)


def test_a_state_is_drawn_as_one_of_all():
    env = gymnasium.make("Lake-v0", render_mode="ansi")
    env.reset(seed=1)
    assert env.render() == "state 0 of 0..15, 4 actions"
    images = []
    for uniform in (0.0, 0.5, 0.9):  # up, from the start: right, or against one border or the other
        env = gymnasium.make("Lake-v0", render_mode="rgb_array").unwrapped
        env.reset(options={"uniforms": np.full(101, uniform)})
        env.step(3)
        images.append(env.render())
    moved, stayed, stayed_too = images
    assert np.array_equal(stayed, stayed_too)
    assert not np.array_equal(stayed, moved)


def test_the_least_step_cap_holds_and_there_must_be_one():
    assert tabulated("FrozenLake-v1").max_steps == tabulated("FrozenLake-v1").rules.max_steps == 100
    assert tabulated("FrozenLake-v1", max_steps=7).rules.max_steps == 7
    with pytest.raises(ConfigError, match=r"system\.max_steps = 300, .* FrozenLake-v1 end after 100 .* at most 100"):
        tabulated("FrozenLake-v1", max_steps=300)
    assert tabulated("FrozenLake-v1", max_steps=300, max_episode_steps=300).rules.max_steps == 300
    assert Tabulated(TimeLimit(gymnasium.make("FrozenLake-v1"), 9)).rules.max_steps == 9
    with pytest.raises(ConfigError, match=r"CliffWalking-v1 has no step cap of its own.*set system\.max_steps"):
        tabulated("CliffWalking-v1")


def test_without_the_switch_an_environment_is_stepped_unmodified():
    system = make_system(SystemConfig(id="FrozenLake-v1"))
    assert (system.rules, system.draws) == (None, (0, 0))
    assert type(system.env.unwrapped).__name__ == "FrozenLakeEnv"


@pytest.mark.parametrize(
    ("name", "options", "sentence"),
    [
        ("CartPole-v1", {}, r"CartPole-v1 has none\. .* CliffWalking-v1, .*FrozenLake-v1, .*Taxi-v4\. Leave it out"),
        ("mapek/Gridworld-v0", {}, r"mapek/Gridworld-v0 has none"),
        ("Table-v0", {"table": STAYS, "starts": None}, r"Table-v0 has none"),
        ("Halved-v0", {}, r"Halved-v0 is wrapped in TransformReward, which may change"),
        ("Taxi-v4", {"fickle_passenger": True}, r"Taxi-v4 does more than its table says: it has fickle_passenger"),
        ("Drifting-v0", {"table": STAYS, "starts": [1.0]}, r"it has drifts\. Leave system\.tabulated out, or that"),
        ("Table-v0", {"table": [[[]]], "starts": [1.0]}, r"P\[0\]\[0\] of Table-v0 is no list of outcomes"),
        ("Table-v0", {"table": [[[[1.0, 0, 0.0]]]], "starts": [1.0]}, r"P\[0\]\[0\] .* \(probability, next state,"),
        ("Table-v0", {"table": [[[[1.0, 0.5, 0.0, False]]]], "starts": [1.0]}, r"P\[0\]\[0\] .* no list of outcomes"),
        (
            "Table-v0",
            {"table": [[STAYS[0][0]] * 2, STAYS[0]], "starts": [1.0, 0.0]},
            r"P\[1\]\[1\] of Table-v0 .* each of 2 states has one for each of 2 actions",
        ),
        (
            "Table-v0",
            {"table": [[[[0.5, 0, 0.0, False], [0.4, 0, 0.0, False]]]], "starts": [1.0]},
            r"probabilities in P\[0\]\[0\] of Table-v0 are \[0\.5, 0\.4\], in sum 0\.9; each is at least 0, and",
        ),
        ("Table-v0", {"table": [[[[1.5, 0, 0.0, False], [-0.5, 0, 0.0, True]]]], "starts": [1.0]}, r"in sum 1\.0; e"),
        ("Table-v0", {"table": [[[[float("nan"), 0, 0.0, False]]]], "starts": [1.0]}, r"in sum nan"),
        ("Table-v0", {"table": [[[[1.0, 1, 0.0, False]]]], "starts": [1.0]}, r"leads to state 1; states are 0\.\.0"),
        ("Table-v0", {"table": [[[[1.0, -1, 0.0, False]]]], "starts": [1.0]}, r"leads to state -1; states are"),
        ("Table-v0", {"table": [[[[1.0, 0, float("inf"), False]]]], "starts": [1.0]}, r"has reward inf; rewards are"),
        ("Table-v0", {"table": STAYS, "starts": [0.5, 0.5]}, r"shape \(2,\); give a probability for each of 1 states"),
        ("Table-v0", {"table": STAYS, "starts": [0.5]}, r"initial_state_distrib of Table-v0 are \[0\.5\], in sum 0\.5"),
        ("Table-v0", {"table": STAYS, "starts": ["often"]}, r"initial_state_distrib .* is no array of probabilities: "),
        ("Table-v0", {"table": STAYS, "starts": [1.0], "mask": []}, r"action_mask\(state\) of Table-v0 gives no marks"),
        ("Table-v0", {"table": STAYS, "starts": [1.0], "mask": [[1, 0]]}, r"gives \(2,\) marks .* each of 1 actions"),
    ],
)  # fmt: skip
def test_what_has_no_sound_table_is_refused_and_says_why(name, options, sentence):
    with pytest.raises(ConfigError, match=sentence):
        tabulated(name, max_steps=5, **options)


@pytest.mark.parametrize(
    ("member", "space", "sentence"),
    [
        ("observation_space", MultiBinary(2), r"needs Discrete observations that begin at 0.* MultiBinary\(2\)"),
        ("observation_space", Discrete(1, start=1), r"Table has Discrete\(1, start=1\)"),
        ("action_space", Discrete(1, start=3), r"needs Discrete actions that begin at 0"),
    ],
)  # fmt: skip
def test_spaces_that_are_no_indices_of_the_table_are_refused(member, space, sentence):
    env = Table(STAYS, [1.0])
    setattr(env, member, space)
    with pytest.raises(ConfigError, match=sentence):
        Tabulated(env, max_steps=5)


def test_a_wrapper_of_ones_own_around_it_is_refused_too():
    with pytest.raises(ConfigError, match="wrapped in TransformReward"):
        Tabulated(TransformReward(Table(STAYS, [1.0]), abs), max_steps=5)


def test_a_table_is_not_made_of_bins():
    bins = {"low": [0.0], "high": [1.0], "bins": [3]}
    system = {"id": "CartPole-v1", "tabulated": True, "discretise": bins}
    with pytest.raises(ConfigError, match=r"system: tabulated = true plays a table of states, .* leave one out"):
        from_table({"episodes": 1, "system": system})
