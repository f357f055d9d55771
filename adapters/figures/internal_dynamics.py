"""What happens inside one learner over a run: Q, exploration rate and learning rate, step by step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from adapters.figures import arrays, style
from adapters.figures.arrays import Floats, Ints

GREEDY, EXPLORATORY = style.COLOURS[0], style.COLOURS[4]
THRESHOLD = style.COLOURS[1]
SLICES = 100
WATCH = 1.0
"""Height of a detector's panel, in inches."""
ALPHA = "\N{GREEK SMALL LETTER ALPHA}"


class Watch(NamedTuple):
    """What one detector read.

    Attributes
    ----------
    detector, signal : what it is called, and what it watches.
    statistic : what it saw at the end of each episode of the trace, shape (episodes,); NaN where it exposed nothing.
    threshold : what the statistic was held against, in the same shape; NaN where that is not known.
    """

    detector: str
    signal: str
    statistic: npt.ArrayLike
    threshold: npt.ArrayLike


def internal_dynamics(
    steps: Any,
    episodes: Any,
    *,
    alarms: Sequence[int],
    drifts: Sequence[int],
    watches: Sequence[Watch] = (),
    title: str = "",
) -> Figure:
    """Draw return, statistics of detectors, Q of the chosen pairs, epsilon and alpha* over one trial's learning steps.

    The axis counts learning steps, not episodes: the episodes in which an agent adapts are its longest, and an axis of
    episodes would squeeze just those. Episode numbers stand on top. A drift is marked before the first step of its
    episode, an alarm after the last of its own. What is one number of an episode, as its return and the statistic at
    its end, is drawn over its steps.

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
    watches
        What detectors read, a panel for each: its statistic, and dotted what that is held against.
    title
        Text above the figure.

    Returns
    -------
    A figure of the width of a page, higher with each detector; the dots are rasterised in its PDF.

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

    read = [_checked(i, watch, last - first + 1) for i, watch in enumerate(watches)]
    ylabels = ["return"]
    ylabels += [f"{style.shorten(watch.detector, 15)}\n{style.shorten(watch.signal, 15)}" for watch in watches]
    ylabels += ["Q(s, a)\nof the chosen pair", "ε", f"{ALPHA}*"]
    heights = [1.1, *(WATCH for _ in watches), 2.4, 0.8, 1.1]
    figure = style.new_figure(style.PAGE, 5.2 + WATCH * len(watches))
    panels: list[Axes] = list(
        figure.subplots(len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights, "hspace": 0.0})
    )
    returns, *watched, values, rates, alphas = panels
    figure.align_ylabels(panels)
    below = "learning step" if first == 1 else f"learning step since the start of episode {first}"
    for axes, ylabel in zip(panels, ylabels, strict=True):
        style.dress(axes, ylabel=ylabel, xlabel=below if axes is alphas else "")
        style.mark_drifts(axes, drift_x)
        style.mark_alarms(axes, alarm_x)
        axes.yaxis.set_major_formatter(style.PlainTicks())
        axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
    returns.set_xlim(begins[0], begins[-1])
    alphas.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))

    returns.stairs(table["return"][rows], begins, baseline=None, color=style.INK, linewidth=0.6)
    for axes, (statistic, threshold) in zip(watched, read, strict=True):
        axes.yaxis.label.set_fontsize(style.SMALL)
        _watch(axes, statistic, threshold, begins)
    exploratory = trace["exploratory"] != 0
    _dots(values, x, trace["q"], exploratory)
    rates.stairs(table["epsilon"][rows], begins, baseline=None, color=style.INK, linewidth=0.9)
    rates.set_ylim(-0.06, 1.06)
    rates.set_yticks([0.0, 0.5, 1.0])
    _dots(alphas, x, trace["alpha"], exploratory)

    _number_episodes(returns, shown[:-1], begins, drift_x)
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
    if any(not np.isnan(threshold).all() for _, threshold in read):
        entries.append((Line2D([], [], color=THRESHOLD, linewidth=1.0, linestyle=":"), "threshold"))
    style.legend(figure, entries, loc="outside lower center", ncols=len(entries))
    return figure


def _checked(number: int, watch: Watch, episodes: int) -> tuple[Floats, Floats]:
    found = []
    for name, given in (("statistic", watch.statistic), ("threshold", watch.threshold)):
        values = np.asarray(given, dtype=np.float64)
        if values.shape != (episodes,) or np.isinf(values).any():
            raise ValueError(
                f"watches[{number}].{name} has shape {values.shape}; give a finite number, or NaN, for each of the "
                f"trace's {episodes} episodes"
            )
        found.append(values)
    return found[0], found[1]


def _watch(axes: Axes, statistic: Floats, threshold: Floats, begins: Floats) -> None:
    if np.isnan(statistic).all():
        middle = {"transform": axes.transAxes, "ha": "center", "va": "center"}
        style.write(axes, 0.5, 0.5, "exposes no statistic", color=style.MUTED, **middle)
        axes.set_yticks([])
        return
    axes.stairs(statistic, begins, baseline=None, color=style.INK, linewidth=0.8, gid="statistic")
    axes.stairs(threshold, begins, baseline=None, color=THRESHOLD, linewidth=1.0, linestyle=":", gid="threshold")
    axes.margins(y=0.1)


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
