"""The gridworld."""

from collections import deque

import numpy as np
import pytest

from managed_systems import ALWAYS, Gridworld

UP, DOWN, LEFT, RIGHT, JUMP_UP, JUMP_DOWN, JUMP_LEFT, JUMP_RIGHT = range(8)
WALL = [(2, column) for column in range(8)]


def shortest(env, goal, actions):
    """Length of the shortest path from the start to a goal with some of the actions."""
    moves = env.rules.params.moves
    distance = {env.rules.params.start: 0}
    queue = deque(distance)
    while queue:
        state = queue.popleft()
        for action in actions:
            landed = int(moves[action, state])
            if landed not in distance:
                distance[landed] = distance[state] + 1
                queue.append(landed)
    return distance[goal[0] * env.size[1] + goal[1]]


def walk(env, actions, **options):
    """Start an episode, take the actions, and return (state, return, terminated, truncated)."""
    env.reset(seed=0, options=options or None)
    total = 0.0
    for action in actions:
        state, reward, terminated, truncated, _ = env.step(action)
        total += reward
    return state, total, terminated, truncated


def test_the_papers_grid_has_a_best_return_of_93_on_eight_steps():
    env = Gridworld()
    assert [shortest(env, goal, range(4)) for goal in env.goals] == [8, 8]
    assert walk(env, [UP] * 4 + [LEFT] * 4) == (0, 93.0, True, False)


def test_an_episode_that_never_finds_the_goal_is_cut_at_37_steps_with_a_return_of_minus_37():
    assert walk(Gridworld(), [UP, DOWN] * 18 + [UP]) == (3 * 9 + 4, -37.0, False, True)


def test_reaching_the_goal_at_the_last_step_terminates_and_does_not_truncate():
    assert walk(Gridworld(max_steps=8), [UP] * 4 + [LEFT] * 4)[2:] == (True, False)


def test_the_inactive_goal_is_a_cell_like_any_other():
    assert walk(Gridworld(), [DOWN] * 4 + [RIGHT] * 4) == (80, -8.0, False, False)


def test_the_four_moves_are_up_down_left_right():
    landed = [walk(Gridworld(), [action])[0] for action in (UP, DOWN, LEFT, RIGHT)]
    assert landed == [3 * 9 + 4, 5 * 9 + 4, 4 * 9 + 3, 4 * 9 + 5]


def test_borders_and_walls_hold_the_agent_and_cost_a_step():
    env = Gridworld(size=(2, 3), start=(0, 0), goals=[(0, 2)], walls=[(0, 1)])
    assert walk(env, [UP, LEFT, RIGHT]) == (0, -3.0, False, False)


def test_the_mask_shows_the_actions_that_change_the_state():
    env = Gridworld(size=(3, 3), start=(0, 0), goals=[(2, 2)], walls=[(0, 1)])
    assert env.reset()[1]["action_mask"].tolist() == [0, 1, 0, 0]


@pytest.mark.parametrize("counted", [True, False])
def test_goals_take_turns_from_the_episodes_given(counted):
    env = Gridworld(switch_at=(3, 5, 6))
    given = [{} if counted else {"episode": episode} for episode in range(1, 8)]
    ends = [walk(env, [UP] * 4 + [LEFT] * 4, **options)[2] for options in given]
    assert ends == [True, True, False, False, True, False, False]
    assert env.rules.drifts == (3, 5, 6)


def test_resets_are_counted_from_one_and_go_on_from_a_given_episode():
    env = Gridworld(jump_from=3)
    offered = [len(env.reset()[1]["available_actions"]) for _ in range(3)]
    assert offered == [4, 4, 8]
    assert len(env.reset(options={"episode": 1})[1]["available_actions"]) == 4
    assert [len(env.reset()[1]["available_actions"]) for _ in range(2)] == [4, 8]


def test_jumps_shorten_the_walled_path_from_16_to_5():
    env = Gridworld(goals=[(0, 0)], walls=WALL, max_steps=200, jump_from=301)
    assert shortest(env, (0, 0), range(4)) == 16
    assert shortest(env, (0, 0), range(8)) == 5
    assert walk(env, [UP, JUMP_UP, JUMP_LEFT, JUMP_LEFT, UP], episode=301) == (0, 96.0, True, False)


def test_jumps_shorten_the_open_path_from_8_to_4():
    env = Gridworld(goals=[(0, 0)], jump_from=301)
    assert [shortest(env, (0, 0), range(n)) for n in (4, 8)] == [8, 4]


def test_the_four_jumps_go_two_cells_up_down_left_right():
    env = Gridworld(jump_from=1)
    landed = [walk(env, [action], episode=1)[0] for action in (JUMP_UP, JUMP_DOWN, JUMP_LEFT, JUMP_RIGHT)]
    assert landed == [2 * 9 + 4, 6 * 9 + 4, 4 * 9 + 2, 4 * 9 + 6]


def test_a_jump_that_would_end_on_a_wall_or_outside_stays_put():
    env = Gridworld(size=(3, 4), start=(1, 1), goals=[(0, 0)], walls=[(1, 3)], jump_from=1)
    assert walk(env, [JUMP_UP, JUMP_DOWN, JUMP_LEFT, JUMP_RIGHT]) == (5, -4.0, False, False)


def test_jumps_are_offered_from_their_episode_on():
    env = Gridworld(jump_from=301)
    assert env.rules.n_actions == env.action_space.n == 8
    assert env.reset(options={"episode": 300})[1]["available_actions"] == (0, 1, 2, 3)
    assert env.reset(options={"episode": 301})[1]["available_actions"] == tuple(range(8))
    assert env.rules.windows.tolist() == [[1, ALWAYS]] * 4 + [[301, ALWAYS]] * 4


def test_a_removed_action_goes_in_its_episode_whether_its_id_is_a_number_or_text():
    for remove in ({3: 10, 0: 20}, {"3": 10, "0": 20}):
        env = Gridworld(remove=remove)
        offered = [env.reset(options={"episode": e})[1]["available_actions"] for e in (9, 10, 19, 20)]
        assert offered == [(0, 1, 2, 3), (0, 1, 2), (0, 1, 2), (1, 2)]
        assert env.remove == {3: 10, 0: 20}
        info = env.reset(options={"episode": 20})[1]
        assert info["action_mask"].tolist() == [0, 1, 1, 0]
        with pytest.raises(ValueError, match=r"action 3 is not available in episode 20; available are \(1, 2\)"):
            env.step(3)


def test_a_slip_replaces_the_action_by_one_of_four_in_its_share_of_the_steps():
    env = Gridworld(slip=0.4)
    assert env.rules.step_draws == 2
    draws = np.random.default_rng(11).random((20_000, 2))
    params, context = env.rules.params, np.zeros(0)
    landed = [env.rules.step(params, 0, params.start, UP, pair, 0, context)[0] for pair in draws]
    share = np.array([landed.count(int(params.moves[action, params.start])) for action in range(4)]) / len(draws)
    # 0.6 stay with the choice and 0.1 go each way by a slip; five standard errors are below 0.017.
    assert np.abs(share - [0.7, 0.1, 0.1, 0.1]).max() < 0.017


def test_a_floor_that_is_not_slippery_uses_no_draws():
    assert Gridworld().rules.episode_draws == 0


def test_text_shows_agent_goals_and_walls():
    env = Gridworld(size=(2, 3), start=(0, 1), goals=[(0, 0), (1, 2)], walls=[(1, 0)], render_mode="ansi")
    env.reset()
    assert env.render() == "G A .\n# . g"


def test_an_image_shows_agent_goals_and_walls_in_their_colours():
    env = Gridworld(size=(2, 3), start=(0, 1), goals=[(0, 0), (1, 2)], walls=[(1, 0)], render_mode="rgb_array")
    env.reset()
    image = env.render()
    assert image.shape == (2 * 40 + 22, 3 * 40 + 22, 3)
    assert image.dtype == np.uint8
    middle = {(r, c): tuple(image[12 + r * 40 + 19, 12 + c * 40 + 19].tolist()) for r in range(2) for c in range(3)}
    assert middle[0, 1] == (46, 110, 196)
    assert middle[0, 0] == (52, 160, 104)
    assert middle[1, 0] == (72, 82, 96)
    assert middle[1, 2] == middle[0, 2] == middle[1, 1] == (255, 255, 255)
    env.step(1)
    assert not np.array_equal(env.render(), image)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"size": (9,)}, r"size is \(9,\); give two integers"),
        ({"size": "99"}, r"size is '99'; give two integers"),
        ({"size": (0, 9)}, r"size\[0\] is 0; give an integer of at least 1"),
        ({"size": (9, 2.5)}, r"size\[1\] is 2.5; give an integer of at least 1"),
        (
            {"start": (9, 0)},
            r"start is \(9, 0\), outside the grid; give a row in 0..8 and a column in 0..8, or a larger",
        ),
        ({"start": (-1, 0)}, r"start\[0\] is -1; give an integer of at least 0"),
        ({"start": (0, 0)}, r"goal \(0, 0\) is the start"),
        ({"goals": []}, r"goals is \(\); give at least one cell"),
        ({"goals": 3}, r"goals is 3; give a sequence of cells"),
        ({"goals": [(0, 0), (0, 9)]}, r"goals\[1\] is \(0, 9\), outside the grid"),
        ({"goals": [(0, 0), (1, 1), (0, 0)]}, r"goals\[2\] is \(0, 0\), which goals holds already"),
        ({"walls": [(9, 9)]}, r"walls\[0\] is \(9, 9\), outside the grid"),
        ({"walls": [(1, 1), (1, 1)]}, r"walls\[1\] is \(1, 1\), which walls holds already"),
        ({"walls": [(4, 4)]}, r"start \(4, 4\) is a wall"),
        ({"walls": [(0, 0)]}, r"goal \(0, 0\) is a wall"),
        ({"walls": [(0, 1), (1, 0)]}, r"goal \(0, 0\) cannot be reached .* up, down, left, right; .*or give jump_from"),
        (
            {"walls": [(0, 1), (1, 0), (0, 2), (2, 0)], "jump_from": 2},
            r"goal \(0, 0\) cannot be reached .*jump right; open the walls around it$",
        ),
        ({"switch_at": (1,)}, r"switch_at\[0\] is 1; give an integer of at least 2"),
        ({"switch_at": (5, 5)}, r"switch_at is \(5, 5\); give strictly increasing episodes"),
        ({"switch_at": 5}, r"switch_at is 5; give strictly increasing episodes"),
        ({"switch_at": (5,), "goals": [(0, 0)]}, r"goals holds only \(0, 0\), so nothing would change"),
        ({"max_steps": 0}, r"max_steps is 0; give an integer of at least 1"),
        ({"max_steps": True}, r"max_steps is True; give an integer"),
        ({"step_reward": float("nan")}, r"step_reward is nan; give a finite number"),
        ({"goal_reward": float("inf")}, r"goal_reward is inf; give a finite number"),
        ({"goal_reward": "100"}, r"goal_reward is '100'; give a finite number"),
        ({"slip": 1.0}, r"slip is 1.0, which leaves no choice; give a number of at least 0 and below 1"),
        ({"slip": -0.1}, r"slip is -0.1; give a finite number in 0..1"),
        ({"jump_from": 0}, r"jump_from is 0; give an integer of at least 1"),
        ({"remove": [3]}, r"remove is \[3\]; give a mapping of action id -> episode"),
        ({"remove": {4: 5}}, r"remove names action 4; the actions are 0 \(up\).*3 \(right\); jumps need jump_from"),
        ({"remove": {"left": 5}}, r"remove names action 'left'; the actions are"),
        ({"remove": {2: 5, "2": 6}}, r"remove names action 2 twice"),
        ({"remove": {2: 1}}, r"remove\[2\] is 1; give an integer of at least 2"),
        ({"remove": {5: 7}, "jump_from": 7}, r"remove\[5\] is 7; give an integer of at least 8"),
        ({"remove": dict.fromkeys(range(4), 9)}, r"leaves no action in episode 9; keep at least one"),
    ],
)
def test_a_bad_value_is_refused_with_its_name_what_is_legal_and_the_way_out(config, message):
    with pytest.raises(ValueError, match=message):
        Gridworld(**config)


def test_a_goal_walled_off_for_moves_is_accepted_where_jumps_reach_it():
    env = Gridworld(walls=[(0, 1), (1, 0)], jump_from=2)
    assert shortest(env, (0, 0), range(8)) == 4
