"""What stands in a figure is what was given: the artists say so."""

import itertools
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from adapters.figures import (
    Compared,
    Panel,
    comparison,
    convergence,
    internal_dynamics,
    learning_curve,
    q_heatmaps,
    save,
)
from adapters.figures.learning_curve import block_of, summarise


class Stage(NamedTuple):
    converged: np.ndarray
    trials: int


def by_gid(owner, gid):
    return owner.findobj(lambda artist: artist.get_gid() == gid)


def xs(lines):
    return [float(segment[0][0]) for segment in lines.get_segments()]


def texts(figure):
    return [t.get_text() for t in figure.findobj(lambda a: hasattr(a, "get_text")) if t.get_text()]


def trace(lengths, first=1):
    """Episodes of these lengths, from number `first` on."""
    numbers = np.arange(first, first + len(lengths))
    count = sum(lengths)
    steps = {
        "episode": np.repeat(numbers, lengths),
        "state": np.zeros(count),
        "action": np.zeros(count),
        "exploratory": np.arange(count) % 2,
        "q": np.linspace(0.0, 1.0, count),
        "td_error": np.ones(count),
        "alpha": np.full(count, 0.1),
    }
    episodes = {
        "episode": numbers,
        "epsilon": np.full(len(lengths), 0.5),
        "return": np.arange(len(lengths), dtype=float),
    }
    return steps, episodes


# internal dynamics


def test_a_drift_stands_before_its_episode_and_an_alarm_after_it_in_every_panel():
    steps, episodes = trace([4, 3, 5, 2])
    figure = internal_dynamics(steps, episodes, alarms=[3], drifts=[3])
    drifts, alarms = by_gid(figure, "drift"), by_gid(figure, "alarm")
    assert [xs(d) for d in drifts] == [[7.0]] * 4
    assert [xs(a) for a in alarms] == [[12.0]] * 4
    # Told apart without colour: by width and by dashes.
    assert drifts[0].get_linewidths()[0] > 2 * alarms[0].get_linewidths()[0]
    assert drifts[0].get_linestyles()[0][1] is None
    assert alarms[0].get_linestyles()[0][1] is not None


def test_a_trace_of_some_episodes_shows_what_happened_in_them():
    steps, episodes = trace([3, 5], first=2)
    figure = internal_dynamics(steps, episodes, alarms=[1, 4], drifts=[2, 4])
    assert figure.axes[0].get_xlim() == (0.0, 8.0)
    assert xs(by_gid(figure, "drift")[0]) == [0.0]
    assert xs(by_gid(figure, "alarm")[0]) == []
    assert sum(len(line.get_xdata()) for line in figure.axes[1].lines) == 8


def test_greedy_and_exploratory_steps_have_two_colours_and_all_are_drawn():
    steps, episodes = trace([300, 300])
    figure = internal_dynamics(steps, episodes, alarms=[], drifts=[])
    drawn = {}
    for line in figure.axes[1].lines:
        drawn[line.get_color()] = drawn.get(line.get_color(), 0) + len(line.get_xdata())
        assert line.get_rasterized()
    assert sorted(drawn.values()) == [300, 300]


def test_a_structured_array_serves_as_well_as_a_mapping():
    steps, episodes = trace([2, 2])
    structured = np.zeros(4, dtype=[(name, float) for name in steps])
    for name, values in steps.items():
        structured[name] = values
    figure = internal_dynamics(structured, episodes, alarms=[], drifts=[], title="cost in $ and $")
    assert "cost in $ and $" in texts(figure)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": {}}, "steps has no column 'episode'; it has none"),
        ({"q": np.zeros(3)}, "columns of one length"),
        ({"q": np.array([0.0, np.nan, 0.0, 0.0])}, r"holds nan at \(1,\)"),
        ({"episode": np.array([1, 1, 3, 3])}, "leaves out an episode"),
        ({"drifts": [0]}, "drifts holds 0"),
        ({"episodes": {"episode": [1], "epsilon": [0.1], "return": [0.0]}}, "has no 2"),
    ],
)
def test_a_trace_that_cannot_be_drawn_is_refused(change, message):
    steps, episodes = trace([2, 2])
    options = {"steps": steps, "episodes": episodes, "alarms": [], "drifts": []}
    for name, value in change.items():
        if name in steps:
            options["steps"] = {**steps, name: value}
        else:
            options[name] = value
    with pytest.raises(ValueError, match=message):
        internal_dynamics(options.pop("steps"), options.pop("episodes"), **options)


# heatmaps


def table(actions=4, states=9):
    return np.zeros((actions, states))


def heatmap(*panels, **options):
    return q_heatmaps(panels, **({"rows": 3, "columns": 3, "walls": [], "goals": [(0, 0), (2, 2)]} | options))


def test_every_updated_state_has_one_arrow_save_the_active_goal():
    values = table()
    values[3, [0, 4, 8]] = 5.0  # the active goal, an ordinary cell, the other goal
    figure = heatmap(Panel("a", values, (0, 1, 2, 3), 0))
    (moves,) = by_gid(figure, "moves")
    assert len(moves.get_paths()) == 2
    assert by_gid(figure, "jumps") == []


def test_arrows_point_where_actions_lead_and_the_first_of_the_best_wins():
    values = table()
    for row, state in enumerate([1, 3, 5, 7]):
        values[row:, state] = 1.0
    (moves,) = by_gid(heatmap(Panel("a", values, (0, 1, 2, 3), 0)), "moves")
    pointed = []
    for path, state in zip(moves.get_paths(), [1, 3, 5, 7], strict=True):
        outline = path.vertices - (state % 3, state // 3)
        tip = outline[np.abs(outline).max(axis=1).argmax()]
        pointed.append(np.sign(np.round(tip, 3)).tolist())
    assert pointed == [[0, -1], [0, 1], [-1, 0], [1, 0]]


def test_a_jump_has_two_heads_and_a_move_one():
    values = table(8)
    values[7, 4] = values[3, 3] = 1.0
    figure = heatmap(Panel("a", values, tuple(range(8)), 0))

    def heads(gid, row, column):
        (path,) = by_gid(figure, gid)[0].get_paths()
        width = np.abs(path.vertices[:-1, 1] - row)
        upper = width[: len(width) // 2 + 1]
        return int((np.diff(upper) > 0.1).sum())  # the outline widens once at each head

    assert (heads("moves", 1, 0), heads("jumps", 1, 1)) == (1, 2)


def legend_of(figure):
    (legend,) = figure.legends
    return [text.get_text() for text in legend.get_texts()]


def test_the_legend_explains_jumps_where_there_are_some():
    values = table(8)
    values[3, 3] = 1.0
    walking = heatmap(Panel("a", values, tuple(range(8)), 0))
    values[7, 4] = 1.0
    jumping = heatmap(Panel("a", values, tuple(range(8)), 0))
    assert [name in legend_of(figure) for figure in (walking, jumping) for name in ("greedy: move", "jump")] == [
        False, False, True, True
    ]  # fmt: skip


def test_a_long_title_goes_on_in_a_second_line():
    values = table()
    titles = ["MORPHIN, success rule", "fixed alpha 0.1", "x" * 60, "y " * 40]
    figure = heatmap(*[Panel(title, values, (0, 1, 2, 3), 0) for title in titles], of="trial 0")
    shown = [axes.get_title(loc="left") for axes in figure.axes[:4]]
    assert shown[:2] == titles[:2]
    assert all(len(line) <= 22 for title in shown for line in title.split("\n"))
    assert all(title.count("\n") == 1 and title.endswith("…") for title in shown[2:])
    assert "trial 0" in figure.axes[3].child_axes[0].get_ylabel()


def test_goals_and_states_never_updated_do_not_set_the_scale():
    first, second = table(), table()
    first[0, [0, 4, 8]] = 500.0, 10.0, 900.0
    second[0, [0, 5]] = -500.0, 3.0
    figure = heatmap(Panel("a", first, (0, 1, 2, 3), 0), Panel("b", second, (0, 1, 2, 3), 1))
    images = [axes.images[0] for axes in figure.axes if axes.images]
    assert images[0].norm is images[1].norm
    # max_a of the second is 0 where only one action was tried, and then below zero.
    assert (images[0].norm.vmin, images[0].norm.vmax) == (3.0, 10.0)
    assert images[0].get_array().mask.sum() == 6


@pytest.mark.parametrize(("goal", "extend"), [(5.0, "neither"), (-90.0, "min"), (90.0, "max")])
def test_the_scale_says_that_something_lies_beyond_it(goal, extend):
    values = table()
    values[:, 0], values[0, 4], values[0, 5] = goal, 3.0, 7.0
    figure = heatmap(Panel("a", values, (0, 1, 2, 3), 1))
    assert figure.axes[0].images[0].colorbar.extend == extend


def test_walls_are_hatched_and_goals_and_start_marked():
    values = table()
    values[0, 4] = 1.0
    figure = heatmap(Panel("a", values, (0, 1, 2, 3), 1), walls=[(1, 0), (1, 2)], start=(1, 1))
    assert [(wall.get_hatch(), wall.get_xy()) for wall in by_gid(figure, "wall")] == [
        ("////", (-0.5, 0.5)),
        ("////", (1.5, 0.5)),
    ]
    (active,), (other,), (start,) = (by_gid(figure, gid) for gid in ("active goal", "other goal", "start"))
    assert [np.round(p.get_xy(), 2).tolist() for p in (active, other, start)] == [
        [1.56, 1.56],
        [-0.44, -0.44],
        [0.56, 0.56],
    ]
    assert active.get_linestyle() != other.get_linestyle()
    assert {"active goal", "other goal", "start", "wall", "never updated"} <= set(texts(figure))


@pytest.mark.parametrize("panels", [1, 3, 5])
def test_a_table_of_zeros_can_be_drawn(panels):
    figure = heatmap(*[Panel(f"_agent $ {i}", table(), (0, 1, 2, 3), 0) for i in range(panels)])
    figure.draw_without_rendering()
    assert by_gid(figure, "moves") == []


@pytest.mark.parametrize(
    ("panel", "options", "message"),
    [
        (None, {}, "panels is empty"),
        (Panel("a", np.zeros((4, 8)), (0, 1, 2, 3), 0), {}, r"shape \(4, 8\)"),
        (Panel("a", np.zeros((2, 9)), (0, 8), 0), {}, "distinct ids in 0..7"),
        (Panel("a", np.zeros((2, 9)), (1, 1), 0), {}, "distinct ids in 0..7"),
        (Panel("a", table(), (0, 1, 2, 3), 2), {}, "active_goal is 2"),
        (Panel("a", table(), (0, 1, 2, 3), 0), {"walls": [(3, 0)]}, r"walls\[0\] is \(3, 0\)"),
        (Panel("a", table(), (0, 1, 2, 3), 0), {"rows": 0}, "rows is 0"),
    ],
)
def test_a_table_that_does_not_fit_the_grid_is_refused(panel, options, message):
    with pytest.raises(ValueError, match=message):
        heatmap(*([] if panel is None else [panel]), **options)


# learning curve


@given(st.data())
def test_a_block_holds_the_mean_and_students_interval_of_its_own_episodes(data):
    trials, length = data.draw(st.integers(2, 5)), data.draw(st.integers(1, 60))
    block, breaks = data.draw(st.integers(1, 70)), data.draw(st.sets(st.integers(1, 80)))
    values = np.random.default_rng(data.draw(st.integers(0, 9))).normal(size=(trials, length))
    curve = summarise(values, block, sorted(breaks))
    assert (curve.edges[0], curve.edges[-1]) == (1, length + 1)
    assert {k for k in breaks if k <= length} <= set(curve.edges.tolist())
    for k, (first, end) in enumerate(itertools.pairwise(curve.edges.tolist())):
        assert 1 <= end - first <= block
        means = values[:, first - 1 : end - 1].mean(axis=1)
        half = stats.t.ppf(0.975, trials - 1) * means.std(ddof=1) / np.sqrt(trials)
        np.testing.assert_allclose(curve.mean[k], means.mean(), atol=1e-12)
        np.testing.assert_allclose([curve.low[k], curve.high[k]], means.mean() + np.array([-half, half]), atol=1e-12)


def test_the_interval_of_few_trials_is_not_cut_and_has_room():
    values = np.array([[1.0, 2.0, 1.0], [3.0, 2.0, 9.0]])
    curve = summarise(values, 1)
    assert curve.low.min() < values.min()
    assert curve.high.max() > values.max()
    figure = learning_curve({"a": values}, drifts=[], detections={}, ylabel="return", block=1)
    low, high = figure.axes[0].get_ylim()
    assert low < curve.low.min()
    assert high > curve.high.max()


def test_a_long_curve_has_no_more_points_than_can_be_seen_and_keeps_its_drift():
    values = np.zeros((200, 10_001))
    curve = summarise(values, block_of([values]), breaks=[3001])
    assert len(curve.mean) <= 602
    assert {1, 3001, 10_002} <= set(curve.edges.tolist())


def test_episodes_without_a_record_count_in_no_mean():
    nan = np.nan
    curve = summarise(np.array([[1.0, nan, 3.0, 5.0, nan, nan]]), 2)
    np.testing.assert_array_equal(curve.mean, [1.0, 4.0, nan])
    curve = summarise(np.array([[1.0, nan, nan, 4.0], [3.0, 5.0, nan, 6.0]]), 1)
    np.testing.assert_array_equal(curve.mean, [2.0, 5.0, nan, 5.0])
    np.testing.assert_array_equal(np.isnan(curve.low), [False, True, True, False])


def test_a_run_with_dropped_episodes_is_drawn_and_one_without_any_record_is_not(tmp_path):
    def drawn(values):
        return learning_curve({"a": values}, drifts=[], detections={}, ylabel="return")

    values = np.arange(40.0).reshape(2, 20)
    values[0, 3:9] = values[1, 5:12] = np.nan
    save(drawn(values), tmp_path, "curve")
    with pytest.raises(ValueError, match="holds nan at"):
        drawn(np.full((1, 3), np.nan))
    with pytest.raises(ValueError, match="holds inf at"):
        drawn([[1.0, np.inf]])


def test_drifts_and_alarms_stand_at_their_episodes():
    data = {"morphin": np.zeros((2, 50)), "plain": np.ones((2, 50))}
    figure = learning_curve(data, drifts=[21, 90], detections={"morphin": [23, 23, 40]}, ylabel="return")
    assert [xs(lines) for lines in by_gid(figure, "drift")] == [[20.5], [20.5]], "between two episodes"
    (ticks,) = by_gid(figure, "alarms of morphin")
    assert xs(ticks) == [23.0, 40.0]
    opacity = ticks.get_colors()[:, 3]
    assert opacity[0] == 1.0
    assert opacity[1] < 1.0
    assert {"morphin", "plain", "true drift", "1.5 per trial"} <= set(texts(figure))


def test_without_detectors_there_is_no_strip_and_without_alarms_an_empty_row():
    data = {"_a": np.zeros((1, 5))}
    assert len(learning_curve(data, drifts=[], detections={}, ylabel="return").axes) == 1
    quiet = learning_curve(data, drifts=[], detections={"_a": []}, ylabel="return")
    assert len(quiet.axes) == 2
    assert {"_a", "0.0 per trial"} <= set(texts(quiet))


@pytest.mark.parametrize(
    ("curves", "detections", "block", "message"),
    [
        ({}, {}, 5, "curves is empty"),
        ({"a": np.zeros((0, 5))}, {}, 5, "is empty, shape"),
        ({"a": np.zeros(5)}, {}, 5, "2 dimension"),
        ({"a": [[1.0, np.inf]]}, {}, 5, "holds inf"),
        ({"a": np.zeros((1, 5))}, {"b": []}, 5, "detections names 'b'"),
        ({"a": np.zeros((1, 5))}, {"a": [6]}, 5, "holds episode 6"),
        ({"a": np.zeros((1, 5))}, {}, 0, "block is 0"),
    ],
)
def test_curves_that_cannot_be_drawn_are_refused(curves, detections, block, message):
    with pytest.raises(ValueError, match=message):
        learning_curve(curves, drifts=[], detections=detections, block=block, ylabel="return")


# convergence


def test_a_stage_in_which_no_trial_converged_says_so():
    stages = {
        "morphin": [Stage(np.arange(100, 110), 10), Stage(np.array([150, 160]), 10)],
        "plain": [Stage(np.arange(200, 209), 10), Stage(np.array([], dtype=int), 10)],
    }
    figure = convergence(stages)
    assert [text.get_text() for text in by_gid(figure, "none converged")] == ["none"]
    assert {"100 %", "20 %", "90 %", "0 %"} <= set(texts(figure))
    heights = [bar.get_height() for bar in by_gid(figure, "share of plain")]
    assert heights == [0.9, 0.0]
    dots = sorted(len(line.get_xdata()) for line in by_gid(figure, "trials"))
    assert dots == [2, 9, 10]


def test_a_share_is_not_rounded_to_none_or_all():
    figure = convergence({"a": [Stage(np.arange(1, 1000), 1000), Stage(np.array([4]), 1000)]})
    assert {">99 %", "<1 %"} <= set(texts(figure))


def test_the_means_that_a_paper_prints_stand_beside_the_ones_found():
    found = {
        "a": [Stage(np.arange(10, 20), 10), Stage(np.array([], dtype=int), 10)],
        "b": [Stage(np.array([3]), 9)] * 2,
    }
    figure = convergence(found, {"a": [700.0, None], "b": [30.0, 40.0]})
    at = [(round(float(m.get_xdata()[0])), float(m.get_ydata()[0])) for m in by_gid(figure.axes[0], "printed mean")]
    assert at == [(0, 700.0), (0, 30.0), (1, 40.0)]
    assert [float(m.get_ydata()[0]) for m in by_gid(figure.axes[0], "mean")] == [14.5]
    assert figure.axes[0].get_ylim()[1] > 700.0
    assert {"mean", "mean in the paper"} <= set(texts(figure))
    for wrong in ({"c": [1.0, 1.0]}, {"a": [1.0]}, {"a": [np.nan, 1.0]}):
        with pytest.raises(ValueError, match="printed"):
            convergence(found, wrong)


def test_that_nothing_ever_converged_can_be_drawn():
    figure = convergence({"a": [Stage(np.array([], dtype=int), 3)]})
    figure.draw_without_rendering()
    assert "none" in texts(figure)


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ({}, "stages is empty"),
        ({"a": []}, r"stages\['a'\] is empty"),
        ({"a": [Stage(np.array([1, 2]), 1)]}, "2 converged trials of 1"),
        ({"a": [Stage(np.array([0]), 1)]}, "holds 0"),
        ({"a": [Stage(np.array([1]), 1)], "b": [Stage(np.array([1]), 1)] * 2}, "2 stages"),
    ],
)
def test_stages_that_cannot_be_are_refused(stages, message):
    with pytest.raises(ValueError, match=message):
        convergence(stages)


# comparison


def test_a_comparison_draws_means_intervals_and_trials_from_top_to_bottom():
    figure = comparison(
        {"a": Compared([1.0, 2.0, 3.0], (1.5, 2.5)), "b_$": Compared([7.0], None)}, xlabel="learning steps"
    )
    means = by_gid(figure, "mean")
    assert [(float(m.get_xdata()[0]), float(m.get_ydata()[0])) for m in means] == [(2.0, 0.0), (7.0, 1.0)]
    (interval,) = by_gid(figure, "interval")
    assert list(interval.get_xdata()) == [1.5, 2.5]
    assert [len(t.get_xdata()) for t in by_gid(figure, "trials")] == [3, 1]
    axes = figure.axes[0]
    assert axes.get_ylim() == (1.5, -0.5)
    assert {"2.0  [1.5, 2.5]", "7.0", "b_$", "learning steps"} <= set(texts(figure))


def test_differences_are_those_within_trials_and_held_against_none():
    table = {"a": Compared([1.0, 20.0], None), "b": Compared([2.0, 22.0], None), "c": Compared([0.0, 25.0], None)}
    figure = comparison(table, xlabel="return", differences={"b": (1.0, 2.0), "c": None})
    above, below = figure.axes
    assert [np.sort(t.get_xdata()).tolist() for t in by_gid(below, "trials")] == [[1.0, 2.0], [-1.0, 5.0]]
    assert [float(m.get_xdata()[0]) for m in by_gid(below, "mean")] == [1.5, 2.0]
    assert [m.get_color() for m in by_gid(below, "mean")] == [m.get_color() for m in by_gid(above, "mean")][1:]
    assert [list(i.get_xdata()) for i in by_gid(below, "interval")] == [[1.0, 2.0]]
    low, high = below.get_xlim()
    assert low < 0.0 < high
    assert {"+1.5  [+1.0, +2.0]", "difference to a, return"} <= set(texts(figure))
    for wrong, message in (({"b": None}, "give those of b, c"), ({"b": (2.0, 1.0), "c": None}, "low not above high")):
        with pytest.raises(ValueError, match=message):
            comparison(table, xlabel="return", differences=wrong)
    uneven = {"a": Compared([1.0, 2.0], None), "b": Compared([1.0], None)}
    with pytest.raises(ValueError, match="pairs"):
        comparison(uneven, xlabel="return", differences={"b": None})


def test_equal_numbers_can_be_compared():
    figure = comparison({"a": Compared([5.0, 5.0], (5.0, 5.0))}, xlabel="steps")
    low, high = figure.axes[0].get_xlim()
    assert low < 5.0 < high


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({}, "table is empty"),
        ({"a": Compared([], None)}, "is empty"),
        ({"a": Compared([1.0], (2.0, 1.0))}, "low not above high"),
        ({"a": Compared([1.0], (float("nan"), 1.0))}, "holds nan"),
    ],
)
def test_numbers_that_cannot_be_compared_are_refused(entries, message):
    with pytest.raises(ValueError, match=message):
        comparison(entries, xlabel="steps")
