"""The way of a figure to the disk."""

from __future__ import annotations

import contextlib
import io
import os
import secrets
import threading
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from adapters import private
from adapters.figures.style import PNG_DPI
from mape import __version__

RASTER_DPI = 400
"""Resolution of what is rasterised in a PDF."""

_saving = threading.Lock()


def save(figure: Figure, folder: Path, name: str, *, title: str = "", about: str = "") -> list[Path]:
    """Write a figure as ``NAME.png`` (200 dpi) and ``NAME.pdf`` (vector, text as TrueType) into a folder.

    Both are drawn and written beside their places before the first takes its name, so a full disk leaves what was
    there before. The files hold no date: equal figures have equal bytes, for equal versions of mapek and matplotlib.
    The first save fixes the layout; what is added to a figure later gets no room of its own.

    Parameters
    ----------
    figure
        What to write.
    folder
        Where to; made if missing.
    name
        Name of the files, without an ending.
    title, about
        What the figure shows, and of which run, such as its hashes: the files' metadata, which are not seen in the
        picture. In a PNG ``Title`` and ``Description``, in a PDF ``Title`` and ``Subject``; both name the version.

    Returns
    -------
    The two paths, PNG first.

    Raises
    ------
    ValueError
        The name is empty, begins with a dot or holds a path separator.
    OSError
        A file cannot be written; nothing half-written stays.
    """
    if not name or name.startswith(".") or any(sign in name for sign in "/\\\0"):
        raise ValueError(f"name is {name!r}; give a file name without folder and ending, such as 'learning_curve'")
    folder = Path(folder)
    private.make_folder(folder)
    paths = [folder / f"{name}.png", folder / f"{name}.pdf"]
    parts = [path.with_name(f".{path.name}.{secrets.token_hex(4)}.part") for path in paths]
    try:
        for part, data in zip(parts, _drawn(figure, title, about), strict=True):
            with open(part, "xb", opener=private.opener) as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        for part, path in zip(parts, paths, strict=True):
            os.replace(part, path)
    finally:
        for part in parts:
            with contextlib.suppress(OSError):
                part.unlink()
    return paths


def _drawn(figure: Figure, title: str, about: str) -> tuple[bytes, bytes]:
    """Draw a figure as PNG and as PDF."""
    software = f"mapek {__version__}, matplotlib {matplotlib.__version__}"
    named = {"Title": title} if title else {}
    seen: dict[str, str | None] = {**named, **({"Description": about} if about else {}), "Software": software}
    read = {**named, **({"Subject": about} if about else {}), "Creator": software, "CreationDate": None}
    png, pdf = io.BytesIO(), io.BytesIO()
    # The type of a PDF's fonts can be set for the process only; so one figure is drawn at a time, and it is set back.
    with _saving:
        before = matplotlib.rcParams["pdf.fonttype"]
        matplotlib.rcParams["pdf.fonttype"] = 42
        try:
            if figure.get_layout_engine() is not None:
                # Each layout starts from the last one and moves things by a hair; so it is made once, for both files.
                figure.draw_without_rendering()
                figure.set_layout_engine("none")
            figure.savefig(png, format="png", dpi=PNG_DPI, metadata=seen)
            figure.savefig(pdf, format="pdf", dpi=RASTER_DPI, metadata=read)
        finally:
            matplotlib.rcParams["pdf.fonttype"] = before
    return png.getvalue(), pdf.getvalue()
