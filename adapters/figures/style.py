"""One look for all figures.

Nothing here goes through `matplotlib.pyplot`: a figure belongs to whoever asked for it, so figures can be drawn in
several threads. Text is plain Unicode, not mathtext, whose parser is shared between threads.
"""

from __future__ import annotations

import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import ScalarFormatter
from matplotlib.transforms import Transform

from adapters.experiments import decimals

COLUMN, PAGE = 3.5, 7.2
"""Width of a column and of a page, in inches."""

SMALL, NORMAL = 8.0, 9.0
"""Sizes of text in points: ticks and legends, labels and titles."""

FAMILY = "DejaVu Sans"  # comes with matplotlib, so a figure has the same bytes on every machine
MINUS = "\N{MINUS SIGN}"
INK, MUTED, GRID, BAND = "#222222", "#666666", "#e4e4e4", "#c4c4c4"

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#7800D8", "#603000")
"""Okabe and Ito's palette without yellow, too pale for a line, and two more; told apart with any colour vision."""

DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1.5, 1)), (0, (5, 1.5, 1, 1.5)))
"""Line styles, so that neighbours differ in greyscale too; as many as have no divisor with the colours in common."""

HATCHES = ("/", ".", "x", "-", "o", "|", "+")
"""Of areas, which have no line style: none at first, and then the next one with each round through the colours."""

ROWS = 3
"""Rows of a legend for which a figure has room."""

PNG_DPI = 200


def colour(index: int) -> str:
    """Return the colour of the agent at `index` of its figure."""
    return COLOURS[index % len(COLOURS)]


def spread(count: int) -> npt.NDArray[np.float64]:
    """Return places in [-0.5, 0.5), shape (count,), over which dots of equal value are spread beside one another.

    Multiples of the golden ratio: they fill the width evenly however many they are, and are the same each time.
    """
    return np.asarray((np.arange(count) * 0.6180339887498949) % 1.0 - 0.5, dtype=np.float64)


def dashes(index: int) -> Any:
    """Return the line style of the agent at `index` of its figure."""
    return DASHES[index % len(DASHES)]


def marker(index: int) -> tuple[int, int, int] | None:
    """Return the marker of the agent at `index`: none before colour and line style come again, then a polygon.

    >>> marker(35), marker(36), marker(72)
    (None, (3, 0, 0), (4, 0, 0))
    """
    rounds = index // (len(COLOURS) * len(DASHES))
    return (2 + rounds, 0, 0) if rounds else None


def hatch(index: int) -> str:
    """Return the hatch of the agent at `index`: another one, or a denser one, each time that its colour comes again.

    >>> hatch(0), hatch(9), hatch(72)
    ('', '///', '//////')
    """
    rounds = index // len(COLOURS) - 1
    return "" if rounds < 0 else HATCHES[rounds % len(HATCHES)] * 3 * (1 + rounds // len(HATCHES))


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure with an Agg canvas; sizes in inches."""
    figure = Figure(figsize=(width, height), dpi=PNG_DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def dress(axes: Axes, *, xlabel: str = "", ylabel: str = "", grid: str = "y") -> None:
    """Give axes the shared look: two thin spines, a light grid behind the data along `grid` (x, y, both or none)."""
    axes.set_facecolor("white")
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_linewidth(0.6)
        spine.set_edgecolor(MUTED)
    axes.tick_params(
        labelsize=SMALL, labelfontfamily=FAMILY, width=0.6, length=2.5, color=MUTED, labelcolor=INK, direction="out"
    )
    axes.set_axisbelow(True)
    axes.grid(False)
    if grid in ("x", "both"):
        axes.xaxis.grid(True, color=GRID, linewidth=0.5, linestyle="-")
    if grid in ("y", "both"):
        axes.yaxis.grid(True, color=GRID, linewidth=0.5, linestyle="-")
    if xlabel:
        axes.set_xlabel(xlabel, fontsize=NORMAL, family=FAMILY, color=INK, parse_math=False)
    if ylabel:
        axes.set_ylabel(ylabel, fontsize=NORMAL, family=FAMILY, color=INK, parse_math=False)


def headline(axes: Axes, text: str) -> None:
    """Set the title of axes, left-aligned with them."""
    if text:
        axes.set_title(text, fontsize=NORMAL, family=FAMILY, color=INK, loc="left", pad=5.0, parse_math=False)


def write(axes: Axes, x: float, y: float, text: str, **options: Any) -> Text:
    """Write small text into axes; `options` are those of `Axes.text`."""
    settings: dict[str, Any] = {"fontsize": SMALL, "family": FAMILY, "color": INK, "parse_math": False}
    return axes.text(x, y, text, **(settings | options))


class PlainTicks(ScalarFormatter):
    """Numbers at ticks, each whole: the power of ten that matplotlib sets apart would lie on what stands there."""

    def __init__(self) -> None:
        super().__init__(useOffset=False)

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Return the text of a tick."""
        if not super().get_offset():
            return str(super().__call__(x, pos))
        return re.sub(r"e\+?(-?)0*", r"e\1", f"{x:.6g}").replace("-", MINUS)

    def get_offset(self) -> str:
        """Return nothing."""
        return ""


def renderer(figure: Figure) -> RendererAgg:
    """Return what can tell how large an artist of `figure` will be."""
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    found: RendererAgg = canvas.get_renderer()  # type: ignore[no-untyped-call]
    return found


def width(text: Text) -> float:
    """Return the width of a text in inches."""
    figure = text.get_figure(root=True)
    assert isinstance(figure, Figure)
    return float(text.get_window_extent(renderer(figure)).width / figure.dpi)


def legend(figure: Figure, entries: Sequence[tuple[Any, str]], *, ncols: int, **options: Any) -> Legend:
    """Add a frameless legend of at most `ncols` columns, of fewer where they would be wider than the figure.

    Unlike matplotlib's own, it takes any text as a name, also one with an underscore. Where it has more than `ROWS`
    rows, the figure becomes higher by the others.
    """
    while True:
        made = _legend(figure, entries, ncols=ncols, **options)
        extent = made.get_window_extent(renderer(figure))
        if ncols == 1 or extent.width <= figure.bbox.width:
            break
        made.remove()
        ncols -= 1
    rows = -(-len(entries) // ncols)
    if rows > ROWS:
        figure.set_figheight(figure.get_figheight() + extent.height / figure.dpi * (rows - ROWS) / rows)
    return made


def _legend(owner: Figure, entries: Sequence[tuple[Any, str]], **options: Any) -> Legend:
    settings: dict[str, Any] = {
        "prop": {"family": FAMILY, "size": SMALL},
        "frameon": False,
        "handlelength": 1.8,
        "handletextpad": 0.5,
        "columnspacing": 1.4,
        "borderaxespad": 0.3,
        "labelcolor": INK,
    }
    made = owner.legend([artist for artist, _ in entries], ["-"] * len(entries), **(settings | options))
    for text, (_, name) in zip(made.get_texts(), entries, strict=True):
        text.set_parse_math(False)
        text.set_text(name)
    return made


def shorten(name: str, length: int = 26) -> str:
    """Cut a name that would not fit.

    >>> shorten("tuned_q_learning", 10)
    'tuned_q_l…'
    """
    return name if len(name) <= length else name[: length - 1] + "…"


def short_names(names: Iterable[str], length: int = 26) -> dict[str, str]:
    """Return names, cut where they would not fit, by the whole ones; different names stay different.

    Names of one beginning lose their middle, and those that differ only there are not cut.

    >>> short_names(["a_long_name", "a_long_name_too", "another_long_name"], 10)
    {'a_long_name': 'a_lo…_name', 'a_long_name_too': 'a_lo…e_too', 'another_long_name': 'another_l…'}
    """
    found = {name: shorten(name, length) for name in names}
    head, tail = length // 2 - 1, length - length // 2
    for cut in (lambda name: f"{name[:head]}…{name[-tail:]}", lambda name: name):
        times = Counter(found.values())
        found = {name: cut(name) if times[short] > 1 and len(name) > length else short for name, short in found.items()}
    return found


def two_lines(name: str, length: int) -> str:
    r"""Break a name into two lines of at most `length` letters, and cut what does not fit into them.

    >>> two_lines("MORPHIN, success rule", 12)
    'MORPHIN,\nsuccess rule'
    """
    lines = textwrap.wrap(name, length, break_on_hyphens=False)
    return "\n".join([*lines[:1], *([shorten(" ".join(lines[1:]), length)] if lines[1:] else [])])


def mark_drifts(axes: Axes, at: Sequence[float] | npt.NDArray[np.float64]) -> LineCollection:
    """Mark true drifts: broad light bands behind the data, one per x in `at`."""
    return _verticals(axes, at, "drift", axes.get_xaxis_transform(), colors=BAND, linewidths=2.6, zorder=0.8)


def mark_drifts_of_row(axes: Axes, at: Sequence[float], row: int, name: str) -> LineCollection:
    """Mark true drifts that only one agent meets, within its row of a strip."""
    ends, gid = (row - 0.5, row + 0.5), f"drift of {name}"
    return _verticals(axes, at, gid, axes.transData, ends, colors=BAND, linewidths=2.6, zorder=0.8)


def mark_alarms(axes: Axes, at: Sequence[float] | npt.NDArray[np.float64]) -> LineCollection:
    """Mark alarms: thin dashed dark lines over the data, one per x in `at`."""
    across = axes.get_xaxis_transform()
    return _verticals(axes, at, "alarm", across, colors=INK, linewidths=0.7, linestyles=[(0, (3.0, 1.6))], zorder=3.0)


def drift_handle() -> Line2D:
    """Return a legend's sample of a drift."""
    return Line2D([], [], color=BAND, linewidth=2.6)


def alarm_handle() -> Line2D:
    """Return a legend's sample of an alarm."""
    return Line2D([], [], color=INK, linewidth=0.7, linestyle=(0, (3.0, 1.6)))


def _verticals(
    axes: Axes,
    at: Sequence[float] | npt.NDArray[np.float64],
    gid: str,
    transform: Transform,
    ends: tuple[float, float] = (0.0, 1.0),
    **options: Any,
) -> LineCollection:
    lines = LineCollection([[(x, ends[0]), (x, ends[1])] for x in at], transform=transform, **options)
    lines.set_gid(gid)
    lines.set_capstyle("butt")
    axes.add_collection(lines, autolim=False)
    return lines


def number(value: float, resolution: float, sign: str = "-") -> str:
    """Write a number as `adapters.experiments.decimals.number` does, with the minus sign of figures.

    >>> number(23348.123, 90.0), number(-340.26, 0.8)
    ('23,348', '−340.3')
    """
    return decimals.number(value, resolution, sign).replace("-", MINUS)
