"""When learning came to rest in each stage of a run, and in how many of the trials it did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from adapters.figures import arrays, style
from adapters.figures.arrays import Ints

BOX_FROM = 5
"""A box needs at least as many trials; fewer are drawn as dots alone."""


class ConvergedStage(Protocol):
    """One stage of one agent; `adapters.experiments.metrics.Stage` is one."""

    @property
    def converged(self) -> npt.NDArray[np.int64]:
        """Episode within the stage, from 1, of each trial that converged; shape (converged trials,)."""
        ...

    @property
    def trials(self) -> int:
        """Number of all trials, converged or not."""
        ...


def convergence(stages: Mapping[str, Sequence[ConvergedStage]]) -> Figure:
    """Draw per stage and agent the episodes in which trials converged, and the share that did.

    Above: a dot per converged trial, a box from the first to the third quartile with the median, and whiskers from the
    5th to the 95th percentile; "none" where no trial converged. Below: the share of all trials.

    Parameters
    ----------
    stages
        Agent's name -> its stages, in order; the same number of them for every agent.

    Returns
    -------
    A figure of the width of a column, or of a page where more than eight distributions are shown.

    Raises
    ------
    ValueError
        There is no agent or no stage, agents have different numbers of stages, or more trials converged than there are.
    """
    arrays.some("stages", stages)
    data = {name: _checked(name, list(found)) for name, found in stages.items()}
    n_stages = len(next(iter(data.values())))
    for name, found in data.items():
        if len(found) != n_stages:
            raise ValueError(
                f"stages[{name!r}] has {len(found)} stages and the first agent has {n_stages}; give as many"
            )

    figure = style.new_figure(style.PAGE if n_stages * len(data) > 8 else style.COLUMN, 3.3)
    above, below = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [3.0, 1.15], "hspace": 0.0})
    style.dress(above, ylabel="converged in episode\nof the stage")
    style.dress(below, xlabel="stage", ylabel="trials\nconverged")
    figure.align_ylabels([above, below])

    pitch = 0.82 / len(data)
    slot = (figure.get_figwidth() - 0.9) / n_stages * pitch  # inches
    empty: list[tuple[float, str]] = []
    for i, (name, found) in enumerate(data.items()):
        shade = style.colour(i)
        for stage, (converged, trials) in enumerate(found):
            x = stage + (i - (len(data) - 1) / 2) * pitch
            _share(below, x, pitch, len(converged) / trials, shade, name, slot)
            if len(converged):
                _distribution(above, x, pitch, converged, shade)
            else:
                empty.append((x, shade))
    above.set_ylim(0.0, 1.06 * max((float(c.max()) for f in data.values() for c, _ in f if len(c)), default=1.0))
    for x, shade in empty:
        style.write(
            above,
            x,
            0.03,
            "none",
            transform=above.get_xaxis_transform(),
            ha="center",
            va="bottom",
            rotation=90.0,
            color=shade,
            fontsize=7.0,
            gid="none converged",
        )
    above.yaxis.set_major_formatter(style.PlainTicks())
    above.yaxis.set_major_locator(MaxNLocator(6, integer=True, steps=[1, 2, 5, 10]))
    above.tick_params(axis="x", length=0.0)
    below.set_xlim(-0.5, n_stages - 0.5)
    below.set_xticks(range(n_stages), [str(stage + 1) for stage in range(n_stages)])
    below.set_ylim(0.0, 1.32)
    below.set_yticks([0.0, 1.0], ["0 %", "100 %"])
    entries: list[tuple[Any, str]] = [
        (Patch(facecolor=style.colour(i), edgecolor="none"), name)
        for i, name in enumerate(style.short_names(data).values())
    ]
    style.legend(
        figure,
        entries,
        loc="outside upper center",
        ncols=min(len(entries), 5 if n_stages * len(data) > 8 else 2),
        handlelength=0.9,
        handleheight=0.9,
    )
    return figure


def _checked(name: str, found: list[ConvergedStage]) -> list[tuple[Ints, int]]:
    arrays.some(f"stages[{name!r}]", found)
    checked = []
    for i, stage in enumerate(found):
        trials = arrays.count(f"stages[{name!r}][{i}].trials", stage.trials)
        converged = arrays.integers(f"stages[{name!r}][{i}].converged", stage.converged, empty=True)
        if len(converged) > trials:
            raise ValueError(
                f"stages[{name!r}][{i}] has {len(converged)} converged trials of {trials}; give the number of all"
            )
        checked.append((converged, trials))
    return checked


def _distribution(axes: Axes, x: float, pitch: float, converged: Ints, shade: str) -> None:
    boxed = len(converged) >= BOX_FROM
    middle, width = (x + 0.22 * pitch, 0.3 * pitch) if boxed else (x, 0.3 * pitch)
    axes.plot(
        middle + width * style.spread(len(converged)),  # beside the box
        np.sort(converged),
        linestyle="none",
        marker="o",
        markersize=2.2,
        markeredgewidth=0.0,
        color=shade,
        alpha=max(0.12, min(0.7, 25.0 / len(converged))),
        rasterized=len(converged) > 100,
        zorder=2.0,
        gid="trials",
    )
    if boxed:
        axes.boxplot(
            [converged],
            positions=[x - 0.16 * pitch],
            widths=[0.34 * pitch],
            whis=(5.0, 95.0),
            showfliers=False,
            showcaps=False,
            manage_ticks=False,
            patch_artist=True,
            boxprops={"facecolor": "white", "edgecolor": shade, "linewidth": 1.0},
            whiskerprops={"color": shade, "linewidth": 1.0},
            medianprops={"color": shade, "linewidth": 2.0, "solid_capstyle": "butt"},
            zorder=2.5,
        )


def _share(axes: Axes, x: float, pitch: float, share: float, shade: str, name: str, slot: float) -> None:
    axes.bar([x], [share], width=0.72 * pitch, color=shade, linewidth=0.0, zorder=2.0, gid=f"share of {name}")
    # Never 0 % for some, nor 100 % for all but a few.
    percent = 100.0 * share
    if 0.0 < percent < 1.0:
        text = "<1"
    elif 99.0 < percent < 100.0:
        text = ">99"
    else:
        text = f"{percent:.0f}"
    style.write(
        axes,
        x,
        share + 0.05,
        f"{text} %" if slot > 0.33 else text,
        ha="center",
        va="bottom",
        fontsize=7.0 if slot > 0.24 else 6.0,
    )
