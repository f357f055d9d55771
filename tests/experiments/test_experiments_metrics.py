"""The measures of a run, on arrays small enough to be counted by hand."""

import numpy as np
import pytest

from adapters.experiments.metrics import (
    Detection,
    convergence,
    detection,
    greedy_length,
    recovery,
    shortest_path,
    stages,
    trailing_mean,
)
from adapters.systems import GymnasiumSystem, make_system
from mape.config import SystemConfig

MOVING, STILL = 1.0, 0.001


@pytest.mark.parametrize(
    ("episodes", "drifts", "expected"),
    [
        (10, (), [(1, 10)]),
        (10, (4, 8), [(1, 3), (4, 7), (8, 10)]),
        (10, (10,), [(1, 9), (10, 10)]),
        (10, (11, 20), [(1, 10)]),
        (1, (2,), [(1, 1)]),
    ],
)
def test_stages_cover_every_episode_once_and_leave_out_drifts_that_never_came(
    episodes: int, drifts: tuple[int, ...], expected: list[tuple[int, int]]
) -> None:
    assert stages(episodes, drifts) == expected


def test_convergence_is_the_first_episode_of_the_stage_at_whose_end_q_is_at_rest() -> None:
    first, second = convergence(np.array([[MOVING, MOVING, STILL, MOVING, STILL, STILL]]), [4])

    assert (first.converged.tolist(), first.length, first.share) == ([3], 3, 1.0)
    assert (second.converged.tolist(), second.length, second.share) == ([2], 3, 1.0)


def test_one_episode_at_rest_is_enough_even_if_q_moves_again() -> None:
    (stage,) = convergence(np.array([[MOVING, STILL, MOVING, MOVING]]), [])

    assert stage.converged.tolist() == [2]


def test_a_change_of_exactly_the_threshold_is_not_at_rest() -> None:
    (stage,) = convergence(np.array([[0.01, np.nextafter(0.01, 0)]]), [])

    assert stage.converged.tolist() == [2]


def test_a_trial_that_never_rests_is_censored_and_counts_with_the_whole_stage_in_the_restricted_mean() -> None:
    (stage,) = convergence(
        np.array([[MOVING, STILL, MOVING, MOVING], [MOVING] * 4, [MOVING, MOVING, MOVING, STILL]]), []
    )

    assert stage.converged.tolist() == [2, 4]
    assert stage.share == pytest.approx(2 / 3)
    assert stage.restricted_mean() == pytest.approx((2 + 4 + 4) / 3)


def test_a_stage_counts_only_where_the_one_before_it_converged() -> None:
    found = convergence(
        np.array(
            [
                [MOVING, MOVING, STILL, STILL, MOVING, STILL],  # not in stage 1, so in none after it
                [MOVING, STILL, MOVING, MOVING, STILL, STILL],  # not in stage 2, so not in stage 3
                [STILL, MOVING, MOVING, STILL, MOVING, STILL],
            ]
        ),
        [3, 5],
    )

    assert [stage.converged.tolist() for stage in found] == [[2, 1], [2], [2]]
    assert [stage.share for stage in found] == pytest.approx([2 / 3, 1 / 3, 1 / 3])
    assert [stage.restricted_mean() for stage in found] == pytest.approx([5 / 3, 2.0, 2.0])


def test_a_stage_in_which_nobody_converges_has_share_0_and_no_mean() -> None:
    first, second = convergence(np.full((4, 6), MOVING), [3])

    assert (first.share, second.share) == (0, 0)
    assert len(first.converged) == len(second.converged) == 0
    assert (first.restricted_mean(), second.restricted_mean()) == (2, 4)


def test_performance_is_back_at_the_first_of_ten_episodes_in_a_row_with_at_most_18_steps() -> None:
    (stage,) = recovery(np.array([[37, 37, *[18] * 10, 37], [8, *[37] * 2, *[8] * 9, 19], [*[18] * 13]]), [])

    assert stage.converged.tolist() == [3, 1]
    assert (stage.share, stage.length) == (pytest.approx(2 / 3), 13)


def test_a_row_of_episodes_does_not_reach_over_a_drift_and_a_stage_counts_whatever_came_before() -> None:
    steps = np.array([[37, 8, 8, 8, 8, 37], [8, 8, 37, 37, 8, 8]])

    first, second = recovery(steps, [4], run=3)
    assert (first.converged.tolist(), second.converged.tolist()) == ([], [])
    first, second = recovery(steps, [4], run=2)
    assert (first.converged.tolist(), second.converged.tolist()) == ([2, 1], [1, 2])


def test_a_stage_that_is_shorter_than_the_row_shows_no_recovery() -> None:
    first, second = recovery(np.full((2, 13), 8), [11])

    assert (first.share, second.share) == (1, 0)


def test_a_delay_counts_the_episodes_of_the_new_regime_so_an_alarm_at_once_has_delay_1() -> None:
    (found,), initial = detection([[11], [13]], [11], 20, window=5)

    assert found == Detection(recall=1.0, delay_mean=2.0, delay_median=2.0, false_alarms=0.0)
    assert initial == 0


def test_an_alarm_in_the_last_episode_of_the_window_is_a_detection_and_one_after_it_a_false_alarm() -> None:
    (found,), _ = detection([[15], [16]], [11], 30, window=5)

    assert found == Detection(recall=0.5, delay_mean=5.0, delay_median=5.0, false_alarms=0.5)


def test_only_the_first_alarm_of_a_stage_is_the_detection_and_the_others_are_false() -> None:
    (found,), _ = detection([[12, 14, 20], [11]], [11], 20, window=10)

    assert found == Detection(recall=1.0, delay_mean=1.5, delay_median=1.5, false_alarms=1.0)


def test_an_alarm_after_the_next_drift_belongs_to_that_drift() -> None:
    found, initial = detection([[14]], [11, 13], 20, window=10)

    assert found == [
        Detection(recall=0.0, delay_mean=None, delay_median=None, false_alarms=0.0),
        Detection(recall=1.0, delay_mean=2.0, delay_median=2.0, false_alarms=0.0),
    ]
    assert initial == 0


def test_alarms_before_the_first_drift_are_counted_per_trial() -> None:
    (found,), initial = detection([[2, 5, 10], [], [11]], [11], 20, window=10)

    assert initial == 1.0
    assert found.recall == pytest.approx(1 / 3)


def test_a_drift_that_nobody_saw_has_recall_0_and_no_delay() -> None:
    (found,), _ = detection([[], []], [5], 10, window=5)

    assert found == Detection(recall=0.0, delay_mean=None, delay_median=None, false_alarms=0.0)


def test_a_run_without_drifts_has_no_detection_and_every_alarm_is_initial() -> None:
    assert detection([[3, 9], [4]], [], 10, window=5) == ([], 1.5)


def test_a_trailing_mean_covers_the_window_up_to_the_episode_and_no_more_than_there_is() -> None:
    values = np.array([[1.0, 2.0, 3.0, 4.0, 5.0], [0.0, 0.0, 0.0, 0.0, 10.0]])

    assert trailing_mean(values, 2, 5).tolist() == [4.5, 5.0]
    assert trailing_mean(values, 2, 3).tolist() == [2.5, 0.0]
    assert trailing_mean(values, 10, 4).tolist() == [2.5, 0.0]
    assert trailing_mean(values, 1, 1).tolist() == [1.0, 0.0]


UP, DOWN, LEFT, RIGHT = range(4)


@pytest.fixture
def corridor() -> GymnasiumSystem:
    """A corridor of five cells; start on the left, the goal on the right."""
    options = {"size": [1, 5], "start": [0, 0], "goals": [[0, 4]], "jump_from": 3}
    return make_system(SystemConfig(id="mapek/Gridworld-v0", options=options))


def table(*preferred: int, actions: int = 4) -> np.ndarray:
    """Return a Q-table whose greedy action in each state is the one named."""
    values = np.zeros((actions, len(preferred)))
    values[list(preferred), range(len(preferred))] = 1.0
    return values


def test_the_greedy_path_is_followed_to_the_goal(corridor: GymnasiumSystem) -> None:
    q = table(RIGHT, RIGHT, RIGHT, RIGHT, UP)

    assert greedy_length(q, (0, 1, 2, 3), corridor.rules, 1, (0, 1, 2, 3)) == 4


def test_a_greedy_path_that_runs_in_a_circle_has_no_length(corridor: GymnasiumSystem) -> None:
    assert greedy_length(table(RIGHT, RIGHT, LEFT, RIGHT, UP), (0, 1, 2, 3), corridor.rules, 1, (0, 1, 2, 3)) is None
    assert greedy_length(table(UP, RIGHT, RIGHT, RIGHT, UP), (0, 1, 2, 3), corridor.rules, 1, (0, 1, 2, 3)) is None


def test_rows_may_stand_in_any_order_and_actions_that_are_not_available_are_left_out(corridor: GymnasiumSystem) -> None:
    ids = (7, 3, 0, 1, 2)  # 7 jumps two cells to the right
    q = np.zeros((5, 5))
    q[0], q[1] = 2.0, 1.0

    assert greedy_length(q, ids, corridor.rules, 3, range(8)) == 2
    assert greedy_length(q, ids, corridor.rules, 1, range(4)) == 4


def test_the_shortest_path_is_that_of_the_actions_that_are_there(corridor: GymnasiumSystem) -> None:
    assert shortest_path(corridor, 1) == 4
    assert shortest_path(corridor, 3) == 2


def test_the_shortest_path_of_the_jump_experiment_falls_from_16_to_5() -> None:
    from mape.config import load
    from mape.config_files import shipped

    system = make_system(load(shipped()["jump"]).system)

    assert (shortest_path(system, 300), shortest_path(system, 301)) == (16, 5)
