"""What agents have learnt of a grid: values and greedy policy, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.path import Path as MarkerPath
from matplotlib.ticker import MaxNLocator

from adapters.figures import arrays, style
from adapters.figures.arrays import Floats, Ints

Cell = tuple[int, int]

DIRECTIONS = ((-1, 0), (1, 0), (0, -1), (0, 1))
"""Rows and columns by which actions 0 to 3 move: up, down, left, right; 4 to 7 are jumps the same ways."""

PER_ROW = 4
HIGHEST, LOWEST = 6.0, 0.9
"""Heights of a heatmap in inches: none is higher, and beside a lower one a scale has no room."""
GOAL, UNKNOWN, WALL = "#D55E00", "#ececec", "#fafafa"

# Outlines of an arrow to the right, its middle at (0, 0); only the half above the axis, from tail to tip.
_ARROW = ((-0.32, 0.035), (0.06, 0.035), (0.06, 0.19), (0.34, 0.0))
_JUMP = ((-0.36, 0.035), (-0.12, 0.035), (-0.12, 0.19), (0.11, 0.035), (0.11, 0.19), (0.37, 0.0))


class Panel(NamedTuple):
    """What one agent has learnt.

    Attributes
    ----------
    title : text above the heatmap, such as the agent's name.
    values : Q-table, shape (actions, states), in units of return; a state is ``row * columns + column``.
    actions : ids of the table's rows, shape (actions,), each in 0..7.
    active_goal : which of the goals is the active one.
    """

    title: str
    values: npt.ArrayLike
    actions: Sequence[int]
    active_goal: int


def q_heatmaps(
    panels: Sequence[Panel],
    *,
    rows: int,
    columns: int,
    walls: Sequence[Sequence[int]],
    goals: Sequence[Sequence[int]],
    start: Sequence[int] | None = None,
    of: str = "",
) -> Figure:
    """Draw max_a Q(s, a) and the greedy action of every state, one heatmap per agent on one scale of colour.

    The scale spans the states that were updated, without goals: a goal's own values, which no episode starts from, can
    be far above the others. An arrow stands for the first of the best actions; a jump's has two heads. A state whose
    values are all zero was never updated: it is grey and has no arrow. Neither has the active goal, where episodes end.

    Parameters
    ----------
    panels
        What is shown, from left to right, at most four in a row; fewer of grids that are broad.
    rows, columns
        Size of the grid.
    walls, goals
        Cells (row, column) that cannot be entered, and cells of the goals in the order in which they take turns.
    start
        Cell in which episodes start; None marks none.
    of
        What the tables are of, such as ``"trial 0"``; it stands beside the scale.

    Returns
    -------
    A figure of the width of a column (one panel) or a page.

    Raises
    ------
    ValueError
        There is no panel, a table does not fit the grid or its action ids, or a cell is outside.
    """
    arrays.some("panels", panels)
    rows, columns = arrays.count("rows", rows), arrays.count("columns", columns)
    wall_cells = arrays.cells("walls", walls, rows, columns)
    goal_cells = arrays.cells("goals", goals, rows, columns)
    start_cell = None if start is None else arrays.cells("start", [start], rows, columns)[0]
    tables = [_checked(i, panel, rows * columns, len(goal_cells)) for i, panel in enumerate(panels)]

    best = [values.max(axis=0) for values, _ in tables]
    known = [(values != 0.0).any(axis=0) for values, _ in tables]
    ordinary = np.ones(rows * columns, dtype=bool)
    ordinary[[row * columns + column for row, column in wall_cells + goal_cells]] = False
    norm = _norm(np.concatenate([b[k & ordinary] for b, k in zip(best, known, strict=True)]))

    per_row = max(1, min(PER_ROW, 2 * PER_ROW * rows // columns))
    down = -(-len(panels) // per_row)
    across = -(-len(panels) // down)
    broad = columns > 2 * rows
    width = style.PAGE if broad or len(panels) > 1 else style.COLUMN
    side = (width - 0.9) / across - 0.15
    # A high map is narrower than its place, as the layout knows what is beside a map only where there is room for it.
    most = side if broad else min(side, 3.0) - (0.4 if rows > 1.5 * columns else 0.0)
    high = min(most * rows / columns, HIGHEST)
    flat = high < LOWEST
    titles = [style.two_lines(panel.title, 30 if across < PER_ROW else 22) for panel in panels]
    above = sum(0.14 for i in range(down) if any("\n" in title for title in titles[i * across : (i + 1) * across]))
    figure = style.new_figure(width, down * (high + 0.42) + above + (1.1 if flat else 0.4))
    grid = figure.subplots(down, across, squeeze=False)
    everything: list[Axes] = list(grid.flat)
    jumping = False
    for i, axes in enumerate(everything):
        if i >= len(panels):
            axes.set_axis_off()
            continue
        panel = panels[i]
        image = np.ma.masked_array(best[i], ~known[i]).reshape(rows, columns)
        _cells(axes, image, norm, high / rows)
        if rows > 2 * columns:
            axes.set_anchor("W")  # a title may be broader than the map, and begins with it
        style.headline(axes, titles[i])
        _mark(axes, wall_cells, goal_cells, panel.active_goal, start_cell)
        at_goal = np.zeros(rows * columns, dtype=bool)
        if goal_cells:
            row, column = goal_cells[panel.active_goal]
            at_goal[row * columns + column] = True
        greedy = np.where(known[i] & ~at_goal, tables[i][1][tables[i][0].argmax(axis=0)], -1)
        _arrows(axes, greedy, best[i], columns, norm)
        jumping = jumping or bool((greedy >= 4).any())
    reached = norm(np.concatenate([b[k] for b, k in zip(best, known, strict=True)]))
    beyond = (bool((reached < 0.0).any()), bool((reached > 1.0).any()))
    extend = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[beyond]
    share = side / (high * columns / rows)
    bar = _scale(figure, everything, across, None if flat else share, extend, of)
    bar.long_axis.set_major_locator(MaxNLocator(5 if flat or high > 1.3 else 3))
    unseen = any((~k & ordinary).any() for k in known)
    _legend(figure, width > style.COLUMN, jumping, unseen, wall_cells, goal_cells, start_cell)
    return figure


def _checked(number: int, panel: Panel, states: int, goals: int) -> tuple[Floats, Ints]:
    values = arrays.floats(f"panels[{number}].values", panel.values, 2)
    actions = arrays.integers(f"panels[{number}].actions", panel.actions, low=0)
    if values.shape != (len(actions), states):
        raise ValueError(
            f"panels[{number}].values has shape {values.shape}; with {len(actions)} actions and {states} states give "
            f"({len(actions)}, {states})"
        )
    if actions.max() > 7 or len(set(actions.tolist())) != len(actions):
        raise ValueError(f"panels[{number}].actions is {tuple(actions.tolist())}; give distinct ids in 0..7")
    if goals and not 0 <= panel.active_goal < goals:
        raise ValueError(f"panels[{number}].active_goal is {panel.active_goal}; give an index in 0..{goals - 1}")
    return values, actions


def _norm(values: Floats) -> Normalize:
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    return Normalize(low, high) if low < high else Normalize(low - 0.5, high + 0.5)


def _cells(axes: Axes, image: Any, norm: Normalize, side: float) -> None:
    """Draw the values, in cells whose sides have about that many inches."""
    rows, columns = image.shape
    style.dress(axes, grid="none")
    axes.set_facecolor(UNKNOWN)
    axes.imshow(image, cmap=colormaps["cividis"], norm=norm, interpolation="nearest", zorder=0.5)
    axes.set_xlim(-0.5, columns - 0.5)
    axes.set_ylim(rows - 0.5, -0.5)
    for axis, length in ((axes.xaxis, columns), (axes.yaxis, rows)):
        step = max(1, -(-(length - 1) // 4), ceil(0.14 / side))
        axis.set_ticks(range(0, length, step))
    axes.tick_params(length=0.0)
    for spine in axes.spines.values():
        spine.set_visible(True)
    axes.vlines(np.arange(columns - 1) + 0.5, -0.5, rows - 0.5, colors="white", linewidths=0.4, zorder=0.6)
    axes.hlines(np.arange(rows - 1) + 0.5, -0.5, columns - 0.5, colors="white", linewidths=0.4, zorder=0.6)


def _mark(axes: Axes, walls: Sequence[Cell], goals: Sequence[Cell], active: int, start: Cell | None) -> None:
    for row, column in walls:
        axes.add_patch(
            Rectangle(
                (column - 0.5, row - 0.5),
                1.0,
                1.0,
                facecolor=WALL,
                edgecolor=style.MUTED,
                hatch="////",
                linewidth=0.0,
                zorder=1.0,
                gid="wall",
            )
        )
    for i, (row, column) in enumerate(goals):
        axes.add_patch(
            Rectangle(
                (column - 0.44, row - 0.44),
                0.88,
                0.88,
                facecolor="white" if i == active else "none",
                edgecolor=GOAL,
                linewidth=1.3,
                linestyle="-" if i == active else (0, (2.0, 1.2)),
                zorder=2.0,
                gid="active goal" if i == active else "other goal",
            )
        )
        if i == active:
            size = 0.66 * _points_per_cell(axes)
            axes.plot(
                [column],
                [row],
                linestyle="none",
                marker="*",
                color=GOAL,
                markersize=size,
                markeredgewidth=0.0,
                zorder=3.0,
            )
    if start is not None:
        row, column = start
        axes.add_patch(
            Rectangle(
                (column - 0.44, row - 0.44),
                0.88,
                0.88,
                facecolor="none",
                edgecolor="white",
                linewidth=1.6,
                zorder=2.0,
                gid="start",
            )
        )


def _points_per_cell(axes: Axes) -> float:
    # Before the layout is made an axes has about its final width.
    figure = axes.get_figure(root=True)
    assert figure is not None
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    broad = float(72.0 * figure.get_figwidth() * axes.get_position().width / (right - left))
    return min(broad, 72.0 * HIGHEST / (bottom - top))


def _scale(
    figure: Figure, everything: Sequence[Axes], across: int, share: float | None, extend: str, of: str
) -> Colorbar:
    """Draw the scale of colour beside the last heatmap of the first row, or below all where `share` is None.

    `share` is 1 where a heatmap is as broad as its place, and more where it is narrower.
    """
    image = everything[0].images[0]
    if share is None:
        bar = figure.colorbar(image, ax=list(everything), location="bottom", extend=extend, aspect=40.0, pad=0.06)
    else:
        # Inside the last panel's frame, the bar is exactly as high as the panels.
        place = everything[across - 1].inset_axes((1.0 + 0.04 * share, 0.0, 0.045 * share, 1.0))
        bar = figure.colorbar(image, cax=place, extend=extend)
    bar.ax.tick_params(labelsize=style.SMALL, labelfontfamily=style.FAMILY, width=0.6, length=2.5, color=style.MUTED)
    bar.long_axis.set_major_formatter(style.PlainTicks())
    bar.outline.set_linewidth(0.4)
    label = "maxₐ Q(s, a)" + (f", {of}" if of else "")
    bar.set_label(label, fontsize=style.NORMAL, family=style.FAMILY, color=style.INK)
    return bar


def _arrows(axes: Axes, greedy: Ints, best: Floats, columns: int, norm: Normalize) -> None:
    """Draw the greedy actions, -1 for none: one collection of moves and one of jumps."""
    for gid, outline, kinds in (("moves", _ARROW, range(4)), ("jumps", _JUMP, range(4, 8))):
        states = np.flatnonzero(np.isin(greedy, kinds))
        if not len(states):
            continue
        right = _whole(outline)
        shapes, shades = [], []
        for state in states.tolist():
            down, across = DIRECTIONS[int(greedy[state]) % 4]
            turned = right @ np.array([[across, down], [-down, across]])
            shapes.append(turned + np.array([state % columns, state // columns]))
            # Dark on the light half of the map, light on the dark one.
            shades.append("white" if float(norm(best[state])) < 0.55 else "black")
        axes.add_collection(
            PolyCollection(shapes, facecolors=shades, linewidths=0.0, zorder=3.0, gid=gid), autolim=False
        )


def _whole(outline: tuple[tuple[float, float], ...]) -> Floats:
    """Return an arrow's outline above the axis and below it, shape (corners, 2)."""
    return np.array(outline + tuple((x, -y) for x, y in reversed(outline[:-1])))


def _legend(
    figure: Figure,
    broad: bool,
    jumping: bool,
    unseen: bool,
    walls: Sequence[Cell],
    goals: Sequence[Cell],
    start: Cell | None,
) -> None:
    entries: list[tuple[Any, str]] = []
    if jumping:
        for outline, name in ((_ARROW, "greedy: move"), (_JUMP, "jump")):
            arrow: Any = MarkerPath(_whole(outline), closed=True)
            handle = Line2D([], [], linestyle="none", marker=arrow, color=style.INK, markersize=10.0)
            handle.set_markeredgewidth(0.0)
            entries.append((handle, name))
    if goals:
        entries.append((Line2D([], [], linestyle="none", marker="*", color=GOAL, markersize=7.0), "active goal"))
    if len(goals) > 1:
        entries.append(
            (Patch(facecolor="none", edgecolor=GOAL, linestyle=(0, (2.0, 1.2)), linewidth=1.3), "other goal")
        )
    if start is not None:
        cell = Line2D([], [], linestyle="none", marker="s", markersize=8.5, color="#31446b", markeredgewidth=0.0)
        frame = Line2D(
            [],
            [],
            linestyle="none",
            marker="s",
            markersize=6.0,
            markerfacecolor="none",
            markeredgecolor="white",
            markeredgewidth=1.3,
        )
        entries.append(((cell, frame), "start"))
    if walls:
        entries.append((Patch(facecolor=WALL, edgecolor=style.MUTED, hatch="//////", linewidth=0.0), "wall"))
    if unseen:
        entries.append((Patch(facecolor=UNKNOWN, edgecolor="none"), "never updated"))
    if entries:
        across = min(len(entries), 6) if broad else 2 if len(entries) == 4 else 3
        style.legend(figure, entries, loc="outside lower center", ncols=across, handleheight=1.1, handlelength=1.3)
