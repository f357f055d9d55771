"""Agents compared on one number per trial."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from adapters.experiments import decimals
from adapters.figures import arrays, style

_Sample = tuple[arrays.Floats, tuple[float, float] | None]


class Compared(NamedTuple):
    """One agent's numbers.

    Attributes
    ----------
    values : one number per trial, such as its total of steps, shape (trials,).
    interval : 95 % bootstrap interval of their mean, (low, high); None where there is none, as for a single trial.
    """

    values: npt.ArrayLike
    interval: tuple[float, float] | None


def comparison(
    table: Mapping[str, Compared],
    *,
    xlabel: str,
    differences: Mapping[str, tuple[float, float] | None] | None = None,
) -> Figure:
    """Draw each agent's mean with its 95 % interval, over a pale dot per trial, and write both beside it.

    Trials that go together are compared by their differences, which vary less than the trials do: with `differences`
    a second panel shows, in the same way, each agent's difference to the first, trial by trial.

    Parameters
    ----------
    table
        Agent's name -> its numbers; drawn from top to bottom.
    xlabel
        Name and unit of the numbers.
    differences
        Agent's name -> 95 % interval of its mean difference to the first agent, None where there is none; of each
        agent but the first. None where trials of the same number have nothing in common.

    Returns
    -------
    A figure of the width of a page, higher with each agent.

    Raises
    ------
    ValueError
        There is no agent, an agent has no trials, a number is not finite, an interval's ends are swapped, or
        `differences` are of other agents, or of agents with different numbers of trials.
    """
    arrays.some("table", table)
    data = {name: _checked(f"table[{name!r}]", *compared) for name, compared in table.items()}
    paired = {} if differences is None else _differences(data, differences)
    heights = [0.65 + 0.3 * len(rows) for rows in (data, paired) if rows]
    figure = style.new_figure(style.PAGE, sum(heights))
    above, *below = figure.subplots(len(heights), 1, squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    names = style.short_names(data)
    _panel(above, data, names, 0, xlabel)
    for axes in below:
        _panel(axes, paired, names, 1, f"difference to {next(iter(names.values()))}, {xlabel}")
        axes.axvline(0.0, color=style.MUTED, linewidth=0.8, zorder=1.0, gid="no difference")
    return figure


def _differences(
    data: Mapping[str, _Sample], differences: Mapping[str, tuple[float, float] | None]
) -> dict[str, _Sample]:
    first, *others = data
    if set(differences) != set(others):
        raise ValueError(f"differences are of {', '.join(differences) or 'nobody'}; give those of {', '.join(others)}")
    found = {}
    for name in others:
        if len(data[name][0]) != len(data[first][0]):
            raise ValueError(
                f"{name} has {len(data[name][0])} trials and {first} has {len(data[first][0])}; differences are those "
                "of pairs"
            )
        found[name] = _checked(f"differences[{name!r}]", data[name][0] - data[first][0], differences[name])
    return found


def _panel(axes: Axes, data: Mapping[str, _Sample], names: Mapping[str, str], first: int, xlabel: str) -> None:
    """Draw a row for each of `data`, the agents from number `first` on."""
    style.dress(axes, xlabel=xlabel, grid="x")
    resolution = decimals.resolution(interval for _, interval in data.values())
    # Differences are held against none.
    lowest, highest, sign = (0.0, 0.0, "+") if first else (np.inf, -np.inf, "-")
    texts = []
    for row, (values, interval) in enumerate(data.values()):
        mean = float(values.mean())
        shade = style.colour(first + row)
        axes.plot(
            np.sort(values),
            row + 0.56 * style.spread(len(values)),
            linestyle="none",
            marker="o",
            markersize=2.2,
            markeredgewidth=0.0,
            color=shade,
            alpha=max(0.1, min(0.45, 25.0 / len(values))),
            rasterized=len(values) > 100,
            zorder=2.0,
            gid="trials",
        )
        text = style.number(mean, resolution, sign)
        if interval is not None:
            low, high = interval
            axes.plot(
                [low, high],
                [row, row],
                color=style.INK,
                linewidth=1.6,
                solid_capstyle="butt",
                zorder=3.0,
                gid="interval",
            )
            axes.vlines([low, high], row - 0.2, row + 0.2, colors=style.INK, linewidths=1.0, zorder=3.0)
            text += f"  [{style.number(low, resolution, sign)}, {style.number(high, resolution, sign)}]"
            lowest, highest = min(lowest, low), max(highest, high)
        axes.plot(
            [mean],
            [row],
            linestyle="none",
            marker="o",
            markersize=5.0,
            color=shade,
            markeredgecolor=style.INK,
            markeredgewidth=0.8,
            zorder=4.0,
            gid="mean",
        )
        texts.append(style.write(axes, 1.02, row, text, transform=axes.get_yaxis_transform(), va="center"))
        lowest, highest = min(lowest, float(values.min())), max(highest, float(values.max()))
    margin = 0.04 * (highest - lowest) or 0.05 * abs(highest) or 0.5
    axes.set_xlim(lowest - margin, highest + margin)
    axes.set_ylim(len(data) - 0.5, -0.5)
    axes.set_yticks(range(len(data)), [names[name] for name in data])
    labels = axes.get_yticklabels()
    for label in labels:
        label.set_parse_math(False)
    axes.tick_params(axis="y", length=0.0)
    axes.spines["left"].set_visible(False)
    few_digits = highest - lowest + 2.0 * margin > 20.0 and max(abs(lowest), abs(highest)) < 1e9
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}") if few_digits else style.PlainTicks())
    beside = max(map(style.width, labels)) + max(map(style.width, texts))
    _ticks(axes, style.PAGE - beside - 0.3)


def _ticks(axes: Axes, width: float) -> None:
    """Set at most six ticks, and as many as have room for their labels on an axis of that width, in inches."""
    low, high = axes.get_xlim()
    probe = style.write(axes, low, 0.0, "")
    for most in range(6, 0, -1):
        locator = MaxNLocator(most, steps=[1, 2, 2.5, 5, 10])
        axes.xaxis.set_major_locator(locator)
        ticks = [tick for tick in locator.tick_values(low, high) if low <= tick <= high]
        needed = 0.0
        for label in axes.xaxis.get_major_formatter().format_ticks(ticks):
            probe.set_text(label)
            needed = max(needed, style.width(probe) + 0.12)
        if len(ticks) < 2 or needed <= (ticks[1] - ticks[0]) / (high - low) * width:
            break
    probe.remove()


def _checked(name: str, given: npt.ArrayLike, interval: tuple[float, float] | None) -> _Sample:
    values = arrays.floats(f"{name}.values", given, 1)
    if interval is None:
        return values, None
    ends = arrays.floats(f"{name}.interval", interval, 1).tolist()
    if len(ends) != 2 or ends[0] > ends[1]:
        raise ValueError(f"{name}.interval is {tuple(ends)}; give (low, high), low not above high")
    return values, (ends[0], ends[1])
