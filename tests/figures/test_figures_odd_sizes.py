"""Figures of many agents, long names, one episode, large and small numbers, and grids of any shape can be read."""

import itertools

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from adapters.figures import Compared, Panel, comparison, convergence, internal_dynamics, learning_curve, q_heatmaps
from adapters.figures.style import COLOURS, PAGE, renderer, short_names

LONG = [f"the_detector_of_an_experiment_with_a_long_name_{k:02d}" for k in range(12)]


class Stage:
    converged = np.array([3, 5, 8])
    trials = 4


def boxes(figure, labels):
    """Where labels that can be seen are, in pixels."""
    shown = [label for label in labels if label.get_visible() and label.get_text()]
    return [(label.get_text(), label.get_window_extent(renderer(figure))) for label in shown]


def assert_apart(figure, labels):
    for (one, box), (other, beside) in itertools.combinations(boxes(figure, labels), 2):
        assert not box.overlaps(beside), (one, other)


def assert_inside(figure):
    """No text sticks out of the figure."""
    width, height = figure.bbox.width, figure.bbox.height
    texts = [*itertools.chain(*(legend.get_texts() for legend in figure.legends))]
    for axes in [*figure.axes, *itertools.chain(*(axes.child_axes for axes in figure.axes))]:
        titles = [axes.title, axes._left_title, axes.xaxis.label, axes.yaxis.label]
        texts += [*axes.texts, *titles, *seen(axes.xaxis), *seen(axes.yaxis)]
    for text, box in boxes(figure, texts):
        inside = box.x0 >= -1 and box.y0 >= -1 and box.x1 <= width + 1 and box.y1 <= height + 1
        assert inside, (text, box, width, height)


def seen(axis):
    """Tick labels within the limits of an axis."""
    low, high = sorted(axis.get_view_interval())
    ticks = [tick for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
    return [label for tick in ticks for label in (tick.label1, tick.label2) if label.get_visible()]


def legend_of(figure):
    (legend,) = figure.legends
    return [text.get_text() for text in legend.get_texts()]


def by_gid(owner, gid):
    return owner.findobj(lambda artist: artist.get_gid() == gid)


def xs(lines):
    return [float(segment[0][0]) for segment in lines.get_segments()]


def curves(names, episodes=40):
    draw = np.random.default_rng(0)
    return {name: draw.normal(size=(3, episodes)) for name in names}


def trace(episodes, length=5, scale=1.0, first=1):
    numbers, draw = np.arange(first, first + episodes), np.random.default_rng(0)
    count = episodes * length
    steps = {
        "episode": np.repeat(numbers, length),
        "exploratory": np.arange(count) % 2,
        "q": scale * draw.normal(size=count),
        "alpha": np.full(count, 0.1),
    }
    table = {"episode": numbers, "epsilon": np.full(episodes, 0.5), "return": scale * draw.normal(size=episodes)}
    return steps, table


# names


def test_short_names_differ_and_what_fits_is_whole():
    names = [*LONG, "morphin", "x" * 26, "x" * 30 + "a" + "y" * 30, "x" * 30 + "b" + "y" * 30]
    found = short_names(names)
    assert list(found) == names
    assert len(set(found.values())) == len(names)
    assert [found[name] for name in ("morphin", "x" * 26)] == ["morphin", "x" * 26]
    assert all(len(found[name]) == 26 for name in LONG)
    taken = "a" * 25 + "…"  # a name that looks like the cut of another
    assert list(short_names([taken, "a" * 40]).values()) == [taken, "a" * 12 + "…" + "a" * 13]


def test_agents_of_one_beginning_can_be_told_apart_in_each_figure():
    curve = learning_curve(curves(LONG), drifts=[], detections={n: [] for n in LONG}, ylabel="return")
    assert len(set(legend_of(curve)[:12])) == 12
    compared = comparison({name: Compared([1.0, 2.0], None) for name in LONG}, xlabel="return")
    for figure in (curve, compared):
        strip = figure.axes[-1].get_yticklabels()
        assert len({label.get_text() for label in strip}) == 12
    assert len(set(legend_of(convergence({name: [Stage()] for name in LONG})))) == 12


@pytest.mark.parametrize("agents", [2, 8, 30])
def test_the_legend_of_many_agents_is_within_the_figure_and_leaves_room_for_the_curves(agents):
    names = [f"agent_{k}_of_a_long_name" for k in range(agents)]
    figure = learning_curve(curves(names), drifts=[9], detections={}, ylabel="return")
    figure.draw_without_rendering()
    assert_inside(figure)
    (axes,) = figure.axes
    assert axes.get_window_extent().height / figure.dpi > 1.2
    assert_apart(figure, figure.legends[0].get_texts())


# colours

# H. Machado et al., A physiologically-based model for simulation of color vision deficiency, 2009, of full severity.
EYES = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}


def lab(colour, eye):
    """CIE L*a*b* of a colour, as an eye sees it."""
    shade = np.array(to_rgb(colour))
    linear = np.where(shade <= 0.04045, shade / 12.92, ((shade + 0.055) / 1.055) ** 2.4)
    to_xyz = [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
    xyz = np.array(to_xyz) @ np.clip(np.array(eye) @ linear, 0.0, 1.0) / [0.95047, 1.0, 1.08883]
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16.0 / 116.0)
    return np.array([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)])


@pytest.mark.parametrize("eye", EYES)
def test_colours_are_told_apart_with_any_colour_vision(eye):
    for one, other in itertools.combinations(COLOURS, 2):
        assert np.linalg.norm(lab(one, EYES[eye]) - lab(other, EYES[eye])) > 15.0, (one, other)  # 2.3 can just be seen


def test_eight_agents_have_eight_colours_and_any_number_can_be_told_apart():
    names = [f"agent {k}" for k in range(90)]
    figure = learning_curve(curves(names, 4), drifts=[], detections={}, ylabel="return")
    lines = [by_gid(figure, name)[0] for name in names]
    assert len({line.get_color() for line in lines[:8]}) == 8
    assert len({(line.get_color(), str(line._dash_pattern), str(line.get_marker())) for line in lines}) == 90
    figure = convergence({name: [Stage()] for name in names})
    bars = [by_gid(figure, f"share of {name}")[0] for name in names]
    assert len({(bar.get_facecolor(), bar.get_hatch()) for bar in bars}) == 90


# learning curves


def test_the_curve_of_one_episode_can_be_seen():
    data = {"a": [[1.0], [3.0]], "b": [[5.0]]}
    figure = learning_curve(data, drifts=[], detections={"a": [1]}, ylabel="return")
    for name, mean in (("a", 2.0), ("b", 5.0)):
        (line,) = by_gid(figure, name)
        assert (line.get_marker(), line.get_ydata().tolist()) == ("o", [mean])
    low, high = figure.axes[0].get_xlim()
    assert low < by_gid(figure, "a")[0].get_xdata()[0] < by_gid(figure, "b")[0].get_xdata()[0] < high, "side by side"
    figure.draw_without_rendering()
    assert [label.get_text() for label in seen(figure.axes[1].xaxis)] == ["1"]
    (line,) = by_gid(learning_curve(curves(["a"]), drifts=[], detections={}, ylabel="return"), "a")
    assert line.get_marker() == "None"


def test_the_blocks_of_each_agent_end_at_its_own_drifts():
    fall = np.concatenate([np.full((2, 20), 5.0), np.full((2, 20), -5.0)], axis=1)
    later = np.concatenate([np.full((2, 30), 5.0), np.full((2, 10), -5.0)], axis=1)
    options = {"block": 10, "ylabel": "return"}
    figure = learning_curve({"a": fall, "b": later}, drifts={"a": [21], "b": [31]}, detections={}, **options)
    for name in ("a", "b"):
        assert set(by_gid(figure, name)[0].get_ydata().tolist()) == {5.0, -5.0}
    assert by_gid(figure, "drift")[0].get_segments() == []
    assert "true drift" not in legend_of(figure)


def test_a_drift_of_all_agents_is_a_band_and_one_of_some_stands_in_their_rows():
    drifts = {"a": [11, 21], "b": [21, 31, 90], "c": [21]}
    detections = {"b": [32], "a": [12]}
    figure = learning_curve(curves("abc"), drifts=drifts, detections=detections, ylabel="return")
    assert [xs(lines) for lines in by_gid(figure, "drift")] == [[20.5], [20.5]]
    assert [xs(by_gid(figure, f"drift of {name}")[0]) for name in "ab"] == [[10.5], [30.5]]
    (_, (low, high)), *_ = [segment.T for segment in by_gid(figure, "drift of a")[0].get_segments()]
    assert (low, high) == (0.5, 1.5), "the row of a, which is the second"
    assert "true drift" in legend_of(figure)


@pytest.mark.parametrize("drifts", [{"a": [3]}, {}, {"a": [3], "b": [3], "d": [3]}])
def test_drifts_are_given_for_each_curve(drifts):
    with pytest.raises(ValueError, match="give those of each curve, a, b"):
        learning_curve(curves("ab"), drifts=drifts, detections={}, ylabel="return")


def test_alarms_are_counted_per_loop_where_loops_are_drawn():
    options = {"drifts": [], "detections": {"a": [3, 4, 5]}, "ylabel": "return"}
    for unit in ("loop", "trial"):
        figure = learning_curve(curves("a"), **options, unit=unit)
        assert [text.get_text() for text in figure.axes[1].texts] == [f"1.0 per {unit}"]


@pytest.mark.parametrize("scale", [1e12, 1.0, 1e-9])
def test_numbers_of_any_size_stand_whole_at_their_ticks(scale):
    steps, table = trace(20, scale=scale)
    values = {"a": scale * np.random.default_rng(0).normal(size=(3, 20))}
    q = scale * np.random.default_rng(0).normal(size=(4, 9))
    for figure in (
        internal_dynamics(steps, table, alarms=[], drifts=[3]),
        learning_curve(values, drifts=[], detections={}, ylabel="return"),
        comparison({"a": Compared(values["a"][0], None)}, xlabel="return"),
        q_heatmaps([Panel("a", q, range(4), 0)], rows=3, columns=3, walls=[], goals=[]),
    ):
        figure.draw_without_rendering()
        assert_inside(figure)
        for axes in [*figure.axes, *itertools.chain(*(axes.child_axes for axes in figure.axes))]:
            for axis in (axes.xaxis, axes.yaxis):
                assert not axis.get_offset_text().get_text()
                assert_apart(figure, seen(axis))


# internal dynamics


@pytest.mark.parametrize("first", [1, 1_000_000])
@pytest.mark.parametrize("every", [1, 3, 9])
def test_numbers_of_episodes_do_not_overlap_however_many_drifts_there_are(first, every):
    steps, table = trace(200, first=first)
    drifts = range(first + 9, first + 200, every)
    figure = internal_dynamics(steps, table, alarms=[], drifts=drifts)
    figure.draw_without_rendering()
    (top,) = figure.axes[0].child_axes
    labels = seen(top.xaxis)
    assert len(labels) > 4
    assert_apart(figure, labels)
    assert f"{first + 9:,}" in [label.get_text() for label in labels], "the first drift has its number"


# comparison


@pytest.mark.parametrize(
    ("center", "scale"),
    [(-4.5e6, 3e5), (-5e8, 1e8), (0.0, 1e12), (-3e14, 1e14), (1e17, 1e17), (0.0, 1e-9), (10.0, 0.01), (50.0, 30.0)],
)
@pytest.mark.parametrize("prefix", ["a", "the_detector_of_an_experiment_with_a_name"])
def test_ticks_of_a_comparison_do_not_touch(center, scale, prefix):
    draw, table = np.random.default_rng(0), {}
    for k in range(4):
        values = center + scale * draw.normal(size=20)
        table[f"{prefix}_{k}"] = Compared(values, (values.mean() - 0.2 * scale, values.mean() + 0.2 * scale))
    figure = comparison(table, xlabel="total return of a trial (units of reward)")
    figure.draw_without_rendering()
    assert_inside(figure)
    (axes,) = figure.axes
    assert len(seen(axes.xaxis)) >= 1
    for (_, box), (_, beside) in itertools.pairwise(boxes(figure, seen(axes.xaxis))):
        assert beside.x0 - box.x1 > 4.0 * figure.dpi / 72.0, "points between two labels"


@pytest.mark.parametrize("agents", [2, 11])
def test_a_comparison_of_pairs_fits_its_page(agents):
    draw = np.random.default_rng(0)
    table = {name: Compared(draw.normal(size=20), (-0.4, 0.4)) for name in LONG[:agents]}
    figure = comparison(table, xlabel="total return of a trial", differences=dict.fromkeys(LONG[1:agents], (-0.3, 0.3)))
    figure.draw_without_rendering()
    assert_inside(figure)
    for axes in figure.axes:
        assert_apart(figure, [*seen(axes.xaxis), *seen(axes.yaxis), axes.xaxis.label])


# convergence


@pytest.mark.parametrize(("agents", "stages"), [(1, 1), (2, 5), (12, 3)])
def test_shares_of_many_agents_do_not_touch(agents, stages):
    figure = convergence({name: [Stage()] * stages for name in LONG[:agents]})
    figure.draw_without_rendering()
    assert_inside(figure)
    assert_apart(figure, figure.axes[1].texts)


# heatmaps


@pytest.mark.parametrize("panels", [1, 4])
@pytest.mark.parametrize(
    ("rows", "columns"), [(2, 40), (40, 2), (2, 200), (200, 2), (1, 2), (12, 5), (5, 12), (6, 8), (9, 9)]
)
def test_a_grid_of_any_shape_fits_a_page_and_its_scale_can_be_read(rows, columns, panels):
    draw = np.random.default_rng(0)
    titles = ["MORPHIN, success rule", "Q-learning", "fixed alpha", "an agent of a long name, with a second line"]
    figure = q_heatmaps(
        [Panel(title, draw.normal(size=(4, rows * columns)), range(4), 0) for title in titles[:panels]],
        rows=rows,
        columns=columns,
        walls=[],
        goals=[(0, 0), (rows - 1, columns - 1)],
        start=(rows // 2, columns // 2),
        of="trial 0",
    )
    figure.draw_without_rendering()
    assert_inside(figure)
    assert figure.get_figwidth() <= PAGE
    assert figure.get_figheight() <= 8.0
    for axes in figure.axes[:panels]:
        assert_apart(figure, [*seen(axes.xaxis), *seen(axes.yaxis)])
    bar = figure.axes[0].images[0].colorbar
    labels = seen(bar.long_axis)
    assert len(labels) >= 2
    assert_apart(figure, labels)
