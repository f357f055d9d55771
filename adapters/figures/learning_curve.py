"""Returns over a run, per agent: the mean over trials, how sure it is, and when detectors alarmed."""

from __future__ import annotations

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

POINTS = 1500
"""Points drawn per curve: three for each pixel of a page at 72 dpi."""

TICKS = 400
"""Ticks that have room side by side in the strip of alarms."""


class Curve(NamedTuple):
    """A mean over trials and its 95 % interval at some episodes; `low` and `high` equal `mean` for a single trial."""

    episodes: Ints
    mean: Floats
    low: Floats
    high: Floats


def learning_curve(
    curves: Mapping[str, npt.ArrayLike],
    *,
    drifts: Sequence[int] | Mapping[str, Sequence[int]],
    detections: Mapping[str, Sequence[int]],
    window: int,
    ylabel: str,
    unit: str = "trial",
) -> Figure:
    """Draw the trailing mean of each agent's returns, averaged over trials, with a 95 % band and its alarms.

    The value at episode e is the mean over episodes e - window + 1 to e, of the same regime. The band is Student's t
    interval of the mean over trials. An alarm is a tick in the strip below, the darker the more trials have one there.
    A drift that all agents meet is a band behind all; another is one behind the alarms of the agent that meets it.

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
    window
        Number of episodes, at least 1.
    ylabel
        Name and unit of what is drawn.
    unit
        What a row of returns is of, a trial or a loop of one.

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
    window = arrays.count("window", window)
    data = {name: arrays.floats(f"curves[{name!r}]", values, 2, gaps=True) for name, values in curves.items()}
    last = max(values.shape[1] for values in data.values())
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
    style.dress(axes, ylabel=ylabel)
    style.dress(below, xlabel="episode", **({"grid": "none"} if alarms else {"ylabel": ylabel}))
    shown = [float(drift) for drift in sorted(shared) if drift <= last]
    style.mark_drifts(axes, shown)
    axes.set_xlim(*((1.0, last) if last > 1 else (0.5, 1.5)))
    axes.yaxis.set_major_formatter(style.PlainTicks())
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    episodes_at = MaxNLocator(10, integer=True, steps=[1, 2, 5, 10]) if last > 1 else FixedLocator([1.0])
    axes.xaxis.set_major_locator(episodes_at)

    names = style.short_names(data)
    entries: list[tuple[Any, str]] = []
    for i, (name, values) in enumerate(data.items()):
        curve = summarise(values, window, drift_at[name])
        shade = style.colour(i)
        axes.fill_between(curve.episodes, curve.low, curve.high, color=shade, alpha=0.22, linewidth=0.0, zorder=2.0)
        at = curve.episodes.astype(np.float64)
        if len(at) == 1:  # neither a band nor a line: a bar with a dot at the mean, the agents' side by side
            at = at + 0.6 * ((i + 0.5) / len(data) - 0.5)
            axes.vlines(at, curve.low, curve.high, colors=shade, alpha=0.22, linewidths=6.0, zorder=2.0)
        (line,) = axes.plot(at, curve.mean, color=shade, linewidth=1.2, linestyle=style.dashes(i), zorder=2.5)
        if len(at) == 1:
            line.set(marker="o", markersize=5.0)
        line.set_gid(name)
        entries.append((line, names[name]))
    if max(values.shape[0] for values in data.values()) > 1:
        entries.append((Patch(color=style.INK, alpha=0.22, linewidth=0.0), "95 % interval of the mean"))
    own = {name: [float(d) for d in drift_at[name].tolist() if d not in shared and d <= last] for name in alarms}
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


def summarise(values: Floats, window: int, keep: Sequence[int] | Ints = ()) -> Curve:
    """Take trailing means, and their mean and 95 % interval over trials, at no more episodes than can be seen.

    Parameters
    ----------
    values
        Shape (trials, episodes); NaN, of which no mean takes notice, for what was not recorded. Where a trial has
        nothing else in a window there is no interval, and where all have nothing, no mean.
    window
        Number of episodes.
    keep
        Episodes at which the curve breaks: these and the ones before are among the episodes returned, and no window
        reaches back over them; else a fall would look like a slope as long as the window.

    Examples
    --------
    >>> summarise(np.array([[0.0, 2.0, 4.0]]), window=2).mean.tolist()
    [0.0, 1.0, 3.0]
    """
    # Imported here: it takes longer than all the rest of this package, and only this needs it.
    from scipy.special import stdtrit

    trials, length = values.shape
    spaced = np.linspace(1, length, min(length, POINTS)).round().astype(np.int64)
    breaks = [e for k in keep for e in (int(k) - 1, int(k)) if 1 <= e <= length]
    episodes = np.union1d(spaced, np.array(breaks, dtype=np.int64))
    recorded = ~np.isnan(values)
    sums, counts = np.zeros((trials, length + 1)), np.zeros((trials, length + 1), np.int64)
    np.cumsum(np.where(recorded, values, 0.0), axis=1, out=sums[:, 1:])
    np.cumsum(recorded, axis=1, out=counts[:, 1:])
    firsts = np.unique([1, *(k for k in (int(k) for k in keep) if 1 <= k <= length)])
    begins = np.maximum(episodes - window, firsts[np.searchsorted(firsts, episodes, side="right") - 1] - 1)
    with np.errstate(invalid="ignore"):  # nothing by nothing is NaN
        means = (sums[:, episodes] - sums[:, begins]) / (counts[:, episodes] - counts[:, begins])
        mean = np.nansum(means, axis=0) / (~np.isnan(means)).sum(axis=0)
    if trials == 1:
        return Curve(episodes, mean, mean, mean)
    half = float(stdtrit(trials - 1, 0.975)) * means.std(axis=0, ddof=1) / np.sqrt(trials)
    # No mean lies outside of what was seen, however wide Student's interval of few trials is.
    return Curve(episodes, mean, np.maximum(mean - half, np.nanmin(values)), np.minimum(mean + half, np.nanmax(values)))


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
