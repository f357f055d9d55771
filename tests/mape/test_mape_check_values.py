"""The numbers by which the method is known: arXiv 2601.20714, and what follows from its definitions."""

import numpy as np
import pytest
from mape_runs import config, loop_of

from mape.execute.rules import alpha_star
from mape.monitor.page_hinkley import PageHinkley, PageHinkleyConfig
from mape.plan.exponential import exponential

RATE = (0.1, 0.99, 5.0)


@pytest.mark.parametrize(("td_error", "alpha"), [(100.0, 0.99), (-1.0, 0.116007726866), (0.0, 0.105957)])
def test_the_step_size_is_driven_by_the_absolute_td_error(td_error, alpha):
    assert alpha_star(td_error, RATE) == pytest.approx(alpha, abs=5e-7 if td_error == 0.0 else 5e-13)
    assert alpha_star(-td_error, RATE) == alpha_star(td_error, RATE)


@pytest.mark.parametrize(("td_error", "value"), [(100.0, 99.0), (-1.0, -0.116007726866)])
def test_one_update_from_zero_has_the_value_of_the_paper(td_error, value):
    assert alpha_star(td_error, RATE) * td_error == pytest.approx(value, abs=5e-13)


def test_an_episode_applies_that_update():
    # One step beside the goal: to enter it has TD error 100 at first, to go the other way -1.
    options = {"size": [1, 3], "start": [0, 1], "goals": [[0, 2]], "switch_at": [], "max_steps": 1}
    loop = loop_of(config(system={"options": options}, monitor={"detectors": []}))
    rows = []
    loop.execute.record_trace(1, 40, lambda number, trace: rows.extend(trace.tolist()))
    loop.run(40)
    first = {}
    for _, action, _, q, td_error, alpha in rows:
        first.setdefault(action, (q, td_error, alpha))
    assert first == {
        2.0: pytest.approx((-0.116007726866, -1.0, 0.116007726866), abs=5e-13),
        3.0: pytest.approx((99.0, 100.0, 0.99), abs=5e-12),
    }


@pytest.mark.parametrize(
    ("episodes", "epsilon"),
    [(0, 1.0), (1, 0.956106), (10, 0.645878), (15, 0.525130), (60, 0.144808), (100, 0.106064)],
)
def test_exploration_decays_exponentially_since_the_last_response(episodes, epsilon):
    assert exponential(episodes, 0.1, 0.05) == pytest.approx(epsilon, abs=5e-7)


def test_the_optimal_values_by_distance_from_the_goal_are_learnt():
    options = {"size": [9, 9], "start": [4, 4], "goals": [[0, 0]], "switch_at": [], "max_steps": 400}
    chosen = config(
        system={"options": options},
        monitor={"detectors": []},
        plan={"name": "q_learning", "alpha": 1.0, "schedule": {"name": "constant", "epsilon": 1.0}},
    )
    loop = loop_of(chosen)
    loop.run(400)
    best = loop.execute.q_table.values.max(axis=0).reshape(9, 9)
    expected = {1: 100.0, 2: 89.0, 4: 70.19, 8: 42.612659}
    for row, column in np.ndindex(9, 9):
        if row + column in expected:
            assert best[row, column] == pytest.approx(expected[row + column], abs=5e-7), (row, column)


def test_page_hinkley_gives_the_statistics_of_the_hand_example():
    test = PageHinkley(PageHinkleyConfig(delta=0.5, threshold=12.0))
    readings = [(test.update(x), test.statistic) for x in (10.0, 10.0, 10.0, 0.0, 0.0, 0.0)]
    assert [statistic for _, statistic in readings] == pytest.approx([0.0, 0.0, 0.0, 7.0, 12.5, 17.0], abs=1e-12)
    assert [alarm for alarm, _ in readings] == [False, False, False, False, True, True]
