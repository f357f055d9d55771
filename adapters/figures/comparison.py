"""Agents compared on one number per trial."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from adapters.figures import arrays, style


class Compared(NamedTuple):
    """One agent's numbers.

    Attributes
    ----------
    values : one number per trial, such as its total of steps, shape (trials,).
    interval : 95 % bootstrap interval of their mean, (low, high); None where there is none, as for a single trial.
    """

    values: npt.ArrayLike
    interval: tuple[float, float] | None


def comparison(table: Mapping[str, Compared], *, xlabel: str) -> Figure:
    """Draw each agent's mean with its 95 % interval, over a pale dot per trial, and write both beside it.

    Parameters
    ----------
    table
        Agent's name -> its numbers; drawn from top to bottom.
    xlabel
        Name and unit of the numbers.

    Returns
    -------
    A figure of the width of a page, higher with each agent.

    Raises
    ------
    ValueError
        There is no agent, an agent has no trials, a number is not finite, or an interval's ends are swapped.
    """
    arrays.some("table", table)
    figure = style.new_figure(style.PAGE, 0.65 + 0.3 * len(table))
    axes = figure.subplots()
    style.dress(axes, xlabel=xlabel, grid="x")
    data = {name: _checked(name, compared) for name, compared in table.items()}
    widths = [high - low for _, interval in data.values() if interval is not None for low, high in [interval]]
    resolution = min((width / 2.0 for width in widths if width > 0.0), default=0.0)
    lowest, highest = np.inf, -np.inf
    for row, (values, interval) in enumerate(data.values()):
        mean = float(values.mean())
        shade = style.colour(row)
        spread = (np.arange(len(values)) * 0.6180339887498949) % 1.0 - 0.5
        axes.plot(
            np.sort(values),
            row + 0.56 * spread,
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
        text = style.number(mean, resolution)
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
            text += f"  [{style.number(low, resolution)}, {style.number(high, resolution)}]"
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
        style.write(axes, 1.02, row, text, transform=axes.get_yaxis_transform(), va="center")
        lowest, highest = min(lowest, float(values.min())), max(highest, float(values.max()))
    margin = 0.04 * (highest - lowest) or 0.05 * abs(highest) or 0.5
    axes.set_xlim(lowest - margin, highest + margin)
    axes.set_ylim(len(table) - 0.5, -0.5)
    axes.set_yticks(range(len(table)), [style.shorten(name) for name in table])
    for label in axes.get_yticklabels():
        label.set_parse_math(False)
    axes.tick_params(axis="y", length=0.0)
    axes.spines["left"].set_visible(False)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
    if highest - lowest + 2.0 * margin > 20.0:
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    return figure


def _checked(name: str, compared: Compared) -> tuple[arrays.Floats, tuple[float, float] | None]:
    values = arrays.floats(f"table[{name!r}].values", compared.values, 1)
    if compared.interval is None:
        return values, None
    ends = arrays.floats(f"table[{name!r}].interval", compared.interval, 1).tolist()
    if len(ends) != 2 or ends[0] > ends[1]:
        raise ValueError(f"table[{name!r}].interval is {tuple(ends)}; give (low, high), low not above high")
    return values, (ends[0], ends[1])
