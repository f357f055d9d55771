"""What holds for every managed system: Gymnasium's contract, the options of reset, and one source of rules."""

import copy
import pickle
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

import managed_systems
from managed_systems import Gridworld, TrafficJunction, UnavailableAction

MAKERS = [
    lambda: Gridworld(),
    lambda: Gridworld(slip=0.3, switch_at=(2, 3)),
    lambda: Gridworld(jump_from=1, remove={"0": 2}),
    lambda: TrafficJunction(switch_at=(2, 3)),
    lambda: TrafficJunction(reserve_from=2),
]
IDS = ["grid", "slippery grid", "jumping grid", "junction", "junction with its reserve"]


@pytest.fixture(params=MAKERS, ids=IDS)
def env(request):
    return request.param()


@pytest.mark.parametrize(
    ("name", "config"),
    [
        ("mapek/Gridworld-v0", {}),
        ("mapek/Gridworld-v0", {"slip": 0.25}),
        ("mapek/Gridworld-v0", {"jump_from": 1}),
        ("mapek/Gridworld-v0", {"jump_from": 301, "remove": {"0": 400, "5": 500}, "switch_at": [301, 601]}),
        ("mapek/Gridworld-v0", {"remove": {"0": 2, "1": 2}}),
        ("mapek/TrafficJunction-v0", {}),
        ("mapek/TrafficJunction-v0", {"reserve_from": 1}),
        ("mapek/TrafficJunction-v0", {"reserve": [], "rates": [[4, 2]], "switch_at": []}),
    ],
)
def test_gymnasiums_own_check_passes_without_a_warning(name, config):
    check_env(gymnasium.make(name, **config).unwrapped)


def test_the_check_passes_with_part_of_the_reserve_enabled():
    env = gymnasium.make("mapek/TrafficJunction-v0").unwrapped
    env.enable_actions([4])
    check_env(env)


@pytest.mark.parametrize("mode", ["ansi", "rgb_array"])
@pytest.mark.parametrize("name", ["mapek/Gridworld-v0", "mapek/TrafficJunction-v0"])
def test_gymnasium_makes_and_draws_each_system_by_its_id(name, mode):
    env = gymnasium.make(name, render_mode=mode)
    env.reset(seed=1)
    assert env.spec.id == name
    assert isinstance(env.render(), str if mode == "ansi" else np.ndarray)
    env.close()


def test_registering_again_gives_no_warning():
    managed_systems.register_envs()
    assert "mapek/Gridworld-v0" in gymnasium.registry


def said_by(code):
    """Return what a fresh interpreter prints."""
    run = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(run, capture_output=True, text=True, check=True).stdout.strip()


@pytest.mark.parametrize("name", ["mapek/Gridworld-v0", "mapek/TrafficJunction-v0"])
def test_the_name_of_the_package_before_the_id_needs_no_import(name):
    assert said_by(f"import gymnasium; print(gymnasium.make('managed_systems:{name}').spec.id)") == name


def test_registration_agrees_with_a_namespace_that_gymnasium_sets():
    code = (
        "from gymnasium.envs.registration import namespace, registry\n"
        "with namespace('mapek'): import managed_systems\n"
        "print(*sorted(name for name in registry if name.startswith('mapek')))"
    )
    assert said_by(code) == "mapek/Gridworld-v0 mapek/TrafficJunction-v0"


def test_importing_the_package_loads_no_system():
    code = "import sys, managed_systems; print([m for m in sys.modules if m.startswith('managed_systems.')])"
    assert said_by(code) == "[]"


def test_every_exported_name_is_there_and_no_other():
    assert managed_systems.__all__ == sorted(
        managed_systems.__all__, key=lambda n: (not n.isupper(), n[0].islower(), n)
    )
    assert dir(managed_systems) == sorted(managed_systems.__all__)
    for name in managed_systems.__all__:
        assert getattr(managed_systems, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'Gridwold'; it has ALWAYS"):
        managed_systems.Gridwold  # noqa: B018 (the access is what is tested)


def play(env, actions_from, options):
    """Play an episode with actions that `actions_from` draws; return everything that the environment said."""
    observation, info = env.reset(options=options)
    said = [(np.array(observation).tolist(), info["available_actions"], info["action_mask"].tolist())]
    while True:
        action = int(actions_from.choice(info["available_actions"]))
        observation, reward, terminated, truncated, info = env.step(action)
        seen = (np.array(observation).tolist(), reward, terminated, truncated)
        said.append((action, *seen, info["available_actions"], info["action_mask"].tolist(), info.get("signals")))
        if terminated or truncated:
            return said


@pytest.mark.parametrize("maker", MAKERS, ids=IDS)
@given(seed=st.integers(0, 2**32 - 1), episode=st.integers(1, 5))
@settings(max_examples=15, deadline=None)
def test_an_episode_is_what_the_rules_make_of_the_uniforms_step_by_step(maker, seed, episode):
    env = maker()
    rules = env.rules
    generator = np.random.default_rng(seed)
    draws = generator.random(rules.episode_draws + 3)
    said = play(env, generator, {"episode": episode, "uniforms": draws})

    phase = rules.phase(rules.params, episode)
    state = rules.reset(rules.params, phase, draws, 0)
    offered = managed_systems.available(rules.windows, episode)
    for number, (action, observation, reward, terminated, truncated, available, mask, signals) in enumerate(said[1:]):
        context = np.zeros(len(rules.signal_names))
        at = rules.reset_draws + number * rules.step_draws
        state, expected_reward, end = rules.step(rules.params, phase, state, action, draws, at, context)
        index = observation
        if isinstance(observation, list):
            index = int(np.ravel_multi_index(observation, env.observation_space.nvec))
        assert (index, reward, terminated) == (state, expected_reward, end), f"step {number}"
        assert truncated == (not end and number + 1 == rules.max_steps), f"step {number}"
        assert available == offered
        assert mask == [
            int(a in offered and rules.explorable(rules.params, phase, state, a)) for a in range(rules.n_actions)
        ]
        assert signals == (dict(zip(rules.signal_names, context, strict=True)) or None)


def test_the_same_seed_gives_the_same_episodes(env):
    twin = copy.deepcopy(env)
    for each in (env, twin):
        each.reset(seed=7, options={"episode": 4})
    for episode in range(5, 8):
        expected = play(env, np.random.default_rng(episode), None)
        assert play(twin, np.random.default_rng(episode), None) == expected


def test_a_pickled_environment_goes_on_as_the_original(env):
    env.reset(seed=3)
    twin = pickle.loads(pickle.dumps(env))  # as vectorised environments do to their copies
    assert play(twin, np.random.default_rng(0), None) == play(env, np.random.default_rng(0), None)


def test_uniforms_leave_the_environments_own_generator_untouched(env):
    env.reset(seed=3)
    before = env.np_random.bit_generator.state
    play(env, np.random.default_rng(1), {"uniforms": np.full(env.rules.episode_draws, 0.5)})
    assert env.np_random.bit_generator.state == before


def test_uniforms_are_copied_so_that_the_caller_may_fill_the_buffer_anew():
    env = TrafficJunction()
    draws = np.full(env.rules.episode_draws, 0.5)
    env.reset(options={"uniforms": draws})
    draws[:] = 0.99
    assert env.step(0)[4]["signals"] == {"arrivals_1": 4.0, "arrivals_2": 2.0}


@pytest.mark.parametrize(
    ("uniforms", "message"),
    [
        (np.full(61, 0.5), r"shape \(61,\); give one dimension of at least 62 numbers: 2 for the reset and 2 for each"),
        (np.full((62, 1), 0.5), r"shape \(62, 1\); give one dimension"),
        (np.full(62, 1.0), r"goes from 1.0 to 1.0; give numbers in \[0, 1\)"),
        (np.full(62, -0.1), r"give numbers in \[0, 1\)"),
        (np.full(62, np.nan), r"goes from nan to nan; give numbers in \[0, 1\)"),
    ],
)
def test_uniforms_that_will_not_do_are_refused_and_change_nothing(uniforms, message):
    env = TrafficJunction()
    env.reset(seed=1)
    before = env.np_random.bit_generator.state
    with pytest.raises(ValueError, match=message):
        env.reset(seed=2, options={"episode": 9, "uniforms": uniforms})
    assert env.np_random.bit_generator.state == before
    env.step(0)


@pytest.mark.parametrize("episode", [0, -1, 1.5, "2", True, None])
def test_an_episode_that_is_no_positive_integer_is_refused(env, episode):
    with pytest.raises(ValueError, match=r"options\['episode'\] is .*; give an integer of at least 1"):
        env.reset(options={"episode": episode})


def test_an_unavailable_action_is_refused_by_name_and_the_episode_goes_on():
    env = TrafficJunction()
    env.reset(seed=1)
    for action in (3, 5, -1, 1.5, "up", None):
        with pytest.raises(
            UnavailableAction, match=r"is not available in episode 1; available are \(0, 1, 2\)"
        ) as caught:
            env.step(action)
        assert isinstance(caught.value, ValueError)
        assert isinstance(caught.value, InvalidAction)
    env.step(2)


@pytest.mark.parametrize("action", [1, 1.0, np.int64(1), np.int32(1), np.float64(1.0), np.array(1)])
def test_an_action_may_be_any_number_that_is_an_available_id(env, action):
    env.reset(seed=1)
    env.step(action)


def test_the_action_space_samples_every_available_action_and_no_other():
    env = TrafficJunction()
    env.enable_actions([4])
    env.action_space.seed(0)
    assert {int(env.action_space.sample()) for _ in range(200)} == {0, 1, 2, 4}
    assert env.action_space.n == 5
    assert env.action_space.sample(mask=np.array([0, 0, 0, 1, 0], np.int8)) == 3
    assert env.action_space.sample(probability=np.array([0, 1.0, 0, 0, 0])) == 1


def test_a_step_before_the_first_reset_and_after_the_end_needs_a_reset(env):
    with pytest.raises(ResetNeeded, match=r"call reset\(\)"):
        env.step(0)
    play(env, np.random.default_rng(0), None)
    with pytest.raises(ResetNeeded, match=r"call reset\(\)"):
        env.step(1)


def test_drawing_needs_a_reset_and_a_mode():
    env = Gridworld(render_mode="ansi")
    with pytest.raises(ResetNeeded, match="nothing to draw yet"):
        env.render()
    env = Gridworld()
    env.reset()
    with pytest.warns(UserWarning, match="give render_mode='ansi' or 'rgb_array'"):
        assert env.render() is None


@pytest.mark.parametrize("system", [Gridworld, TrafficJunction])
def test_an_unknown_render_mode_is_refused(system):
    with pytest.raises(ValueError, match=r"render_mode is 'human'; give one of None, 'ansi', 'rgb_array'"):
        system(render_mode="human")


@pytest.mark.parametrize("maker", MAKERS, ids=IDS)
def test_a_system_can_be_built_again_from_the_parameters_it_keeps(maker):
    env = maker()
    code = type(env).__init__.__code__
    names = code.co_varnames[1 : code.co_argcount]
    twin = type(env)(**{name: getattr(env, name) for name in names})
    for mine, other in zip(env.rules.params, twin.rules.params, strict=True):
        assert np.array_equal(mine, other)
    assert np.array_equal(env.rules.windows, twin.rules.windows)
