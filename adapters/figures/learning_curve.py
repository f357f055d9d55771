"""Returns over a run, per agent: the mean over trials, how sure it is, and when detectors alarmed."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, MaxNLocator, StrMethodFormatter

from adapters.figures import arrays, style
from adapters.figures.arrays import Floats, Ints

POINTS = 600
"""Blocks drawn per curve, at most but for those that drifts cut short: one for each pixel of a page at 72 dpi."""

FEW = 40
"""Blocks of a curve of few trials, at least: so its blocks are short beside a run."""

EPISODES = 100
"""Episodes of all trials together that make a mean steady enough to be read."""

TICKS = 400
"""Ticks that have room side by side in the strip of alarms."""


class Curve(NamedTuple):
    """Means of blocks of episodes over trials, with their 95 % intervals.

    Attributes
    ----------
    edges : first episode of each block, and the one after the last; shape (blocks + 1,).
    mean, low, high : shape (blocks,); all equal for a single trial, which has no interval.
    """

    edges: Ints
    mean: Floats
    low: Floats
    high: Floats


def learning_curve(
    curves: Mapping[str, npt.ArrayLike],
    *,
    drifts: Sequence[int] | Mapping[str, Sequence[int]],
    detections: Mapping[str, Sequence[int]],
    ylabel: str,
    unit: str = "trial",
    block: int | None = None,
) -> Figure:
    """Draw the mean of each agent's returns over trials, with a 95 % band and its alarms.

    Each number is drawn over the very episodes that it is the mean of: one where there are many trials, else a block
    of neighbours, none of which reaches over a drift. So nothing is late, and a fall is as steep as it was. Of a single
    trial of a single agent each episode is a dot beside. The band is Student's t interval of the mean over trials. An
    alarm is a tick in the strip below, the darker the more trials have one there. A drift that all agents meet is a
    band behind all; another is one behind the alarms of the agent that meets it.

    Parameters
    ----------
    curves
        Agent's name -> returns, shape (trials, episodes), in any unit; column 0 is episode 1. NaN stands for an
        episode of which there is no record.
    drifts
        Episodes from which a new regime held: for all agents, or agent's name -> its own, for each of them.
    detections
        Agent's name -> episodes of the alarms of all its trials, in any order; an agent without a detector is left
        out, and with no agent there is no strip.
    ylabel
        Name and unit of the returns; of blocks, the label says how long they are.
    unit
        What a row of returns is of, a trial or a loop of one.
    block
        Episodes of a block, at most; None for `block_of` the curves.

    Returns
    -------
    A figure of the width of a page, higher with many agents.

    Raises
    ------
    ValueError
        An array is empty, not finite or not two-dimensional, an alarm is outside the run, `detections` names an
        agent without a curve, or `drifts` leaves one out.
    """
    arrays.some("curves", curves)
    data = {name: arrays.floats(f"curves[{name!r}]", values, 2, gaps=True) for name, values in curves.items()}
    last = max(values.shape[1] for values in data.values())
    block = block_of(list(data.values())) if block is None else arrays.count("block", block)
    drift_at = _drifts(drifts, data)
    shared = set.intersection(*(set(at.tolist()) for at in drift_at.values()))
    alarms: dict[str, Ints] = {}
    for name, episodes in detections.items():
        if name not in data:
            raise ValueError(f"detections names {name!r}, which has no curve; the curves are {', '.join(data)}")
        alarms[name] = arrays.integers(f"detections[{name!r}]", episodes, empty=True)
        if len(alarms[name]) and alarms[name].max() > data[name].shape[1]:
            raise ValueError(
                f"detections[{name!r}] holds episode {alarms[name].max()}; the run has {data[name].shape[1]} episodes"
            )

    strip = 0.16 * len(alarms) + 0.12
    figure = style.new_figure(style.PAGE, 2.7 + (strip if alarms else 0.0))
    if alarms:
        axes, below = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [2.1, strip], "hspace": 0.0})
    else:
        axes = below = figure.subplots()
    if block > 1:
        ylabel += f"\n(means of up to {block:,} episodes)"
    style.dress(axes, ylabel=ylabel)
    style.dress(below, xlabel="episode", **({"grid": "none"} if alarms else {"ylabel": ylabel}))
    shown = [drift - 0.5 for drift in sorted(shared) if drift <= last]  # between two episodes
    style.mark_drifts(axes, shown)
    axes.set_xlim(0.5, last + 0.5)
    axes.yaxis.set_major_formatter(style.PlainTicks())
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    episodes_at = MaxNLocator(10, integer=True, steps=[1, 2, 5, 10]) if last > 1 else FixedLocator([1.0])
    axes.xaxis.set_major_locator(episodes_at)

    names = style.short_names(data)
    entries: list[tuple[Any, str]] = []
    for i, (name, values) in enumerate(data.items()):
        line = _curve(axes, summarise(values, block, drift_at[name]), i, len(data))
        line.set_gid(name)
        entries.append((line, names[name]))
    if block > 1 and len(data) == 1 and values.shape[0] == 1:
        entries.append((_episodes(axes, values[0]), "one episode"))
    if max(values.shape[0] for values in data.values()) > 1:
        entries.append((Patch(color=style.INK, alpha=0.22, linewidth=0.0), "95 % interval of the mean"))
    own = {name: [d - 0.5 for d in drift_at[name].tolist() if d not in shared and d <= last] for name in alarms}
    if shown or any(own.values()):
        entries.append((style.drift_handle(), "true drift"))
    if alarms:
        style.mark_drifts(below, shown)
        for row, (name, met) in enumerate(own.items()):
            style.mark_drifts_of_row(below, met, row, name)
        _strip(below, alarms, data, names, unit)
        entries.append((Line2D([], [], linestyle="none", marker="|", markersize=6.0, color=style.INK), "alarm"))
    style.legend(figure, entries, loc="outside upper center", ncols=min(len(entries), 5))
    return figure


def _drifts(drifts: Sequence[int] | Mapping[str, Sequence[int]], data: Mapping[str, Floats]) -> dict[str, Ints]:
    if not isinstance(drifts, Mapping):
        return dict.fromkeys(data, arrays.integers("drifts", drifts, empty=True))
    if set(drifts) != set(data):
        raise ValueError(f"drifts are of {', '.join(drifts) or 'nobody'}; give those of each curve, {', '.join(data)}")
    return {name: arrays.integers(f"drifts[{name!r}]", at, empty=True) for name, at in drifts.items()}


def block_of(values: Sequence[Floats]) -> int:
    """Return how many episodes share a mean, where curves of these shapes are drawn: as few as can be read.

    >>> [block_of([np.zeros(shape)]) for shape in ((200, 900), (30, 900), (1, 900), (200, 10_000), (1, 50))]
    [2, 4, 22, 17, 1]
    """
    trials, length = min(len(v) for v in values), int(max(v.shape[1] for v in values))
    return max(-(-length // POINTS), min(-(-EPISODES // trials), length // FEW), 1)


def summarise(values: Floats, block: int, breaks: Sequence[int] | Ints = ()) -> Curve:
    """Cut episodes into blocks of at most `block`, and take the mean and 95 % interval over trials of each.

    Parameters
    ----------
    values
        Shape (trials, episodes); NaN, of which no mean takes notice, for what was not recorded. Where a trial has
        nothing else in a block there is no interval, and where all have nothing, no mean.
    block
        Number of episodes; what lies between two breaks is cut into equal blocks, as far as that goes.
    breaks
        Episodes at which a block begins, whatever the one before it holds.

    Examples
    --------
    >>> summarise(np.array([[0.0, 2.0, 4.0, 9.0]]), block=2, breaks=[4])
    Curve(edges=array([1, 2, 4, 5]), mean=array([0., 3., 9.]), low=array([0., 3., 9.]), high=array([0., 3., 9.]))
    """
    # Imported here: it takes longer than all the rest of this package, and only this needs it.
    from scipy.special import stdtrit

    trials, length = values.shape
    firsts = [1, *sorted({int(k) for k in breaks if 1 < k <= length}), length + 1]
    cuts = [np.linspace(a, b, -(-(b - a) // block), endpoint=False) for a, b in itertools.pairwise(firsts)]
    edges = np.concatenate([*cuts, [length + 1]]).astype(np.int64)
    recorded = ~np.isnan(values)
    sums = np.add.reduceat(np.where(recorded, values, 0.0), edges[:-1] - 1, axis=1)
    with np.errstate(invalid="ignore"):  # nothing by nothing is NaN
        means = sums / np.add.reduceat(recorded, edges[:-1] - 1, axis=1, dtype=np.int64)
        mean = np.nansum(means, axis=0) / (~np.isnan(means)).sum(axis=0)
    if trials == 1:
        return Curve(edges, mean, mean, mean)
    half = float(stdtrit(trials - 1, 0.975)) * means.std(axis=0, ddof=1) / np.sqrt(trials)
    return Curve(edges, mean, mean - half, mean + half)


def _curve(axes: Axes, curve: Curve, index: int, agents: int) -> Line2D:
    """Draw the curve of the agent at `index`, each mean over its own episodes; return its line."""
    shade, marker = style.colour(index), style.marker(index)
    if len(curve.mean) == 1:  # neither a band nor a line: a bar with a dot at the mean, the agents' side by side
        at = 1.0 + 0.6 * ((index + 0.5) / agents - 0.5)
        axes.vlines([at], curve.low, curve.high, colors=shade, alpha=0.22, linewidths=6.0, zorder=2.0)
        (line,) = axes.plot([at], curve.mean, color=shade, marker=marker or "o", markersize=5.0, zorder=2.5)
        return line
    edges = curve.edges - 0.5
    marked: dict[str, Any] = {"marker": marker, "markersize": 4.0, "markevery": max(1, len(curve.mean) // 12)}
    low, high, mean = (np.append(one, one[-1]) for one in (curve.low, curve.high, curve.mean))
    axes.fill_between(edges, low, high, step="post", color=shade, alpha=0.22, linewidth=0.0, zorder=2.0)
    (line,) = axes.plot(
        edges,
        mean,
        drawstyle="steps-post",
        color=shade,
        linewidth=1.2,
        linestyle=style.dashes(index),
        zorder=2.5,
        **({} if marker is None else marked),
    )
    return line


def _episodes(axes: Axes, values: Floats) -> Line2D:
    """Draw each episode of one trial, palely, beside the means of its blocks."""
    (dots,) = axes.plot(
        np.arange(1, len(values) + 1),
        values,
        linestyle="none",
        marker="o",
        markersize=1.8,
        markeredgewidth=0.0,
        color=style.MUTED,
        alpha=0.45,
        rasterized=True,
        zorder=1.5,
        gid="episodes",
    )
    return dots


def _strip(
    axes: Axes, alarms: Mapping[str, Ints], data: Mapping[str, Floats], shown_as: Mapping[str, str], unit: str
) -> None:
    names = list(data)
    width = -(-max(values.shape[1] for values in data.values()) // TICKS)
    for row, (name, episodes) in enumerate(alarms.items()):
        trials = data[name].shape[0]
        shade = style.colour(names.index(name))
        # Alarms too close to be told apart share a tick, at their mean.
        bins, of_alarm, times = np.unique(episodes // width, return_inverse=True, return_counts=True)
        at = np.bincount(of_alarm, weights=episodes, minlength=len(bins)) / times
        # By the root, one alarm in a hundred trials can still be seen, and one in each is told from one in a few.
        opacity = 0.15 + 0.85 * np.sqrt(np.minimum(1.0, times / trials))
        ticks = LineCollection(
            [[(x, row - 0.36), (x, row + 0.36)] for x in at.tolist()],
            colors=[to_rgba(shade, float(o)) for o in opacity],
            linewidths=0.9,
            zorder=2.0,
        )
        ticks.set_gid(f"alarms of {name}")
        ticks.set_capstyle("butt")
        axes.add_collection(ticks, autolim=False)
        style.write(
            axes,
            1.008,
            row,
            f"{style.number(len(episodes) / trials, 0.1)} per {unit}",
            transform=axes.get_yaxis_transform(),
            va="center",
        )
    axes.set_ylim(len(alarms) - 0.4, -0.6)
    axes.set_yticks(range(len(alarms)), [shown_as[name] for name in alarms])
    for label in axes.get_yticklabels():
        label.set_parse_math(False)
    axes.tick_params(axis="y", length=0.0)
    axes.spines["left"].set_visible(False)
