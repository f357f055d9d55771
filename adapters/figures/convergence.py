"""When learning came to rest in each stage of a run, and in how many of the trials it did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from adapters.figures import arrays, style
from adapters.figures.arrays import Ints

BOX_FROM = 5
"""A box needs at least as many trials; fewer are drawn as dots alone."""

UPRIGHT = 0.24
"""Inches of room from which on the texts of two neighbours do not touch."""

MEAN: dict[str, Any] = {
    "linestyle": "none",
    "marker": "o",
    "markersize": 3.6,
    "markerfacecolor": "white",
    "markeredgecolor": style.INK,
    "markeredgewidth": 0.8,
    "gid": "mean",
}
PRINTED: dict[str, Any] = MEAN | {"marker": "D", "markerfacecolor": "none", "markersize": 5.0, "gid": "printed mean"}


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


def convergence(
    stages: Mapping[str, Sequence[ConvergedStage]], printed: Mapping[str, Sequence[float | None]] | None = None
) -> Figure:
    """Draw per stage and agent the episodes in which trials converged, and the share that did.

    Above: a dot per converged trial, a box from the first to the third quartile with the median, whiskers from the 5th
    to the 95th percentile, and the mean; "none" where no trial converged. Below: the share of all trials.

    Parameters
    ----------
    stages
        Agent's name -> its stages, in order; the same number of them for every agent.
    printed
        Agent's name -> the mean of each stage that a paper prints, to be held against; None where it prints none.

    Returns
    -------
    A figure of the width of a column, or of a page where more than eight distributions are shown.

    Raises
    ------
    ValueError
        There is no agent or no stage, agents have different numbers of stages, more trials converged than there are, or
        `printed` is of other agents or stages.
    """
    arrays.some("stages", stages)
    data = {name: _checked(name, list(found)) for name, found in stages.items()}
    n_stages = len(next(iter(data.values())))
    for name, found in data.items():
        if len(found) != n_stages:
            raise ValueError(
                f"stages[{name!r}] has {len(found)} stages and the first agent has {n_stages}; give as many"
            )
    told = _printed(printed or {}, data, n_stages)

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
            _share(below, x, pitch, len(converged) / trials, i, name, slot)
            if len(converged):
                _distribution(above, x, pitch, converged, shade)
            else:
                empty.append((x, shade))
            if (mean := told[name][stage]) is not None:
                above.plot([x - 0.16 * pitch if len(converged) >= BOX_FROM else x], [mean], **PRINTED, zorder=3.5)
    highest = [float(c.max()) for f in data.values() for c, _ in f if len(c)]
    highest += [mean for means in told.values() for mean in means if mean is not None]
    above.set_ylim(0.0, 1.06 * max(highest, default=1.0))
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
    below.set_ylim(0.0, 1.32 if slot > UPRIGHT else 1.6)
    below.set_yticks([0.0, 1.0], ["0 %", "100 %"])
    entries: list[tuple[Any, str]] = [(_swatch(i), name) for i, name in enumerate(style.short_names(data).values())]
    if any(len(converged) >= BOX_FROM for found in data.values() for converged, _ in found):
        entries.append((Line2D([], [], **MEAN), "mean"))
    if any(mean is not None for means in told.values() for mean in means):
        entries.append((Line2D([], [], **PRINTED), "mean in the paper"))
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


def _printed(
    printed: Mapping[str, Sequence[float | None]], data: Mapping[str, object], n_stages: int
) -> dict[str, list[float | None]]:
    told: dict[str, list[float | None]] = {name: [None] * n_stages for name in data}
    for name, means in printed.items():
        if name not in data:
            raise ValueError(f"printed names {name!r}, which has no stages; the agents are {', '.join(data)}")
        if len(means) != n_stages:
            raise ValueError(f"printed[{name!r}] has {len(means)} stages and the run has {n_stages}; give as many")
        told[name] = [None if m is None else float(arrays.floats(f"printed[{name!r}]", [m], 1)[0]) for m in means]
    return told


def _swatch(index: int) -> Patch:
    return Patch(facecolor=style.colour(index), edgecolor="white", linewidth=0.0, hatch=style.hatch(index))


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
        axes.plot([x - 0.16 * pitch], [converged.mean()], **MEAN, zorder=3.0)


def _share(axes: Axes, x: float, pitch: float, share: float, index: int, name: str, slot: float) -> None:
    (bar,) = axes.bar(
        [x],
        [share],
        width=0.72 * pitch,
        color=style.colour(index),
        edgecolor="white",
        linewidth=0.0,
        zorder=2.0,
        gid=f"share of {name}",
    )
    bar.set_hatch(style.hatch(index))
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
        fontsize=7.0 if slot > UPRIGHT else 6.0,
        rotation=0.0 if slot > UPRIGHT else 90.0,
    )
