"""What happens inside one learner over a run: Q, exploration rate and learning rate, step by step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from adapters.figures import arrays, style
from adapters.figures.arrays import Floats, Ints

GREEDY, EXPLORATORY = style.COLOURS[0], style.COLOURS[4]
SLICES = 100
ALPHA = "\N{GREEK SMALL LETTER ALPHA}"


def internal_dynamics(
    steps: Any,
    episodes: Any,
    *,
    alarms: Sequence[int],
    drifts: Sequence[int],
    title: str = "",
) -> Figure:
    """Draw return, Q of the chosen pairs, epsilon and alpha* over the learning steps of one trial.

    The axis counts learning steps, not episodes: the episodes in which an agent adapts are its longest, and an axis of
    episodes would squeeze just those. Episode numbers stand on top. A drift is marked before the first step of its
    episode, an alarm after the last of its own.

    Parameters
    ----------
    steps
        The trace, one item per learning step in order, as a structured array or a mapping of arrays, shape (steps,):
        `episode` (from 1, without gaps), `exploratory` (0 or 1), `q` (value of the chosen pair after the update, in
        units of return), `alpha` (step size of the update, alpha*). Other columns are not used.
    episodes
        One item per episode, in the same form, shape (episodes,): `episode`, `epsilon`, `return`. It covers at least
        those of the trace.
    alarms
        Episodes at whose end a detector alarmed.
    drifts
        Episodes from which a new regime held.
    title
        Text above the figure.

    Returns
    -------
    A figure of the width of a page; the dots are rasterised in its PDF.

    Raises
    ------
    ValueError
        A column is missing, of another length, empty or not finite, or an episode has no steps.
    """
    trace = arrays.columns("steps", steps, ("episode", "exploratory", "q", "alpha"))
    table = arrays.columns("episodes", episodes, ("episode", "epsilon", "return"))
    of_step = arrays.integers("steps['episode']", trace["episode"])
    if not np.isin(np.diff(of_step), (0, 1)).all():
        raise ValueError("steps['episode'] goes back or leaves out an episode; give the steps of a run in their order")
    first, last = int(of_step[0]), int(of_step[-1])
    rows = _rows_of(arrays.integers("episodes['episode']", table["episode"]), first, last)

    shown = np.arange(first, last + 2)
    # Step n, from 1, lies between n - 1 and n; an episode begins where the one before it ends.
    begins = np.searchsorted(of_step, shown).astype(np.float64)
    x = np.arange(len(of_step), dtype=np.float64) + 0.5
    drift_x = begins[[d - first for d in arrays.integers("drifts", drifts, empty=True).tolist() if first <= d <= last]]
    alarm_x = begins[
        [a - first + 1 for a in arrays.integers("alarms", alarms, empty=True).tolist() if first <= a <= last]
    ]

    figure = style.new_figure(style.PAGE, 5.2)
    panels: list[Axes] = list(
        figure.subplots(4, 1, sharex=True, gridspec_kw={"height_ratios": [1.1, 2.4, 0.8, 1.1], "hspace": 0.0})
    )
    figure.align_ylabels(panels)
    below = "learning step" if first == 1 else f"learning step since the start of episode {first}"
    for axes, ylabel in zip(panels, ("return", "Q(s, a)\nof the chosen pair", "ε", f"{ALPHA}*"), strict=True):
        style.dress(axes, ylabel=ylabel, xlabel=below if axes is panels[-1] else "")
        style.mark_drifts(axes, drift_x)
        style.mark_alarms(axes, alarm_x)
        axes.yaxis.set_major_formatter(style.PlainTicks())
        axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
    panels[0].set_xlim(begins[0], begins[-1])
    panels[-1].xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))

    panels[0].stairs(table["return"][rows], begins, baseline=None, color=style.INK, linewidth=0.6)
    exploratory = trace["exploratory"] != 0
    _dots(panels[1], x, trace["q"], exploratory)
    panels[2].stairs(table["epsilon"][rows], begins, baseline=None, color=style.INK, linewidth=0.9)
    panels[2].set_ylim(-0.06, 1.06)
    panels[2].set_yticks([0.0, 0.5, 1.0])
    _dots(panels[3], x, trace["alpha"], exploratory)

    _number_episodes(panels[0], shown[:-1], begins, drift_x)
    if title:
        figure.suptitle(title, fontsize=style.NORMAL, family=style.FAMILY, color=style.INK, parse_math=False)
    entries: list[tuple[Any, str]] = [
        (Line2D([], [], linestyle="none", marker="o", markersize=3.5, color=GREEDY), "greedy step"),
        (Line2D([], [], linestyle="none", marker="o", markersize=3.5, color=EXPLORATORY), "exploratory step"),
    ]
    if len(drift_x):
        entries.append((style.drift_handle(), "true drift"))
    if len(alarm_x):
        entries.append((style.alarm_handle(), "alarm"))
    style.legend(figure, entries, loc="outside lower center", ncols=len(entries))
    return figure


def _rows_of(numbers: Ints, first: int, last: int) -> Ints:
    """Return where the episodes first..last stand in a column of episode numbers."""
    order = np.argsort(numbers, kind="stable")
    wanted = np.arange(first, last + 1)
    at = np.searchsorted(numbers[order], wanted)
    missing = at == len(numbers)
    missing[~missing] = numbers[order][at[~missing]] != wanted[~missing]
    if missing.any():
        raise ValueError(f"episodes['episode'] has no {wanted[missing][0]}; give all of the trace, {first}..{last}")
    return np.asarray(order[at], dtype=np.int64)


def _dots(axes: Axes, x: Floats, y: Floats, exploratory: npt.NDArray[np.bool_]) -> None:
    # Markers of a line are drawn ten times as fast as a scatter's dots. Drawn in slices of time, neither kind hides
    # the other for good.
    for piece in np.array_split(np.arange(len(x)), max(1, min(SLICES, len(x) // 200))):
        for kind, shade in ((exploratory[piece], EXPLORATORY), (~exploratory[piece], GREEDY)):
            if kind.any():
                axes.plot(
                    x[piece][kind],
                    y[piece][kind],
                    linestyle="none",
                    marker="o",
                    markersize=1.3,
                    markeredgewidth=0.0,
                    color=shade,
                    alpha=0.55,
                    rasterized=True,
                    zorder=2.0,
                )
    axes.margins(y=0.06)


def _number_episodes(axes: Axes, episodes: Ints, begins: Floats, drift_x: Floats) -> None:
    """Write episode numbers on top, those of drifts first, then round ones where there is room."""
    span = begins[-1] - begins[0]
    # From coarse to fine: where episodes are long, finer numbers find room.
    ends = float(episodes[0]), float(episodes[-1])
    round_ones = [
        tick for bins in (6, 20, 60) for tick in MaxNLocator(bins, integer=True, steps=[1, 2, 5, 10]).tick_values(*ends)
    ]
    others = [begins[int(e) - int(episodes[0])] for e in (episodes[0], *round_ones) if episodes[0] <= e <= episodes[-1]]
    apart = max(0.07, 0.012 * len(f"{episodes[-1]:,}")) * span
    places: list[float] = []
    for x in map(float, (*drift_x, *others)):
        if all(abs(x - other) > apart for other in places):
            places.append(x)
    places.sort()
    top = axes.secondary_xaxis("top")
    top.set_xticks(places, [f"{episodes[np.searchsorted(begins, x)]:,}" for x in places])
    top.tick_params(labelsize=style.SMALL, labelfontfamily=style.FAMILY, width=0.6, length=2.5, color=style.MUTED)
    top.set_xlabel("episode", fontsize=style.NORMAL, family=style.FAMILY, color=style.INK)
    top.spines["top"].set_visible(False)
