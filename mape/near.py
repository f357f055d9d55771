"""What may have been meant by a name that does not exist."""

from __future__ import annotations

import difflib
import itertools
import os
from collections.abc import Callable, Iterable
from pathlib import Path

ENTRIES = 10_000
"""Most entries of a folder that are looked at."""


def nearest(name: str, legal: Iterable[str]) -> str | None:
    """Return the legal name that is most like `name`, or None where none is like it.

    >>> nearest("run", ["replay"]), nearest("comapre", ["compare", "replay"])
    (None, 'compare')
    """
    close = difflib.get_close_matches(name, list(legal), n=1)
    return close[0] if close else None


def did_you_mean(near: object | None) -> str:
    """Return the end of a sentence about a name that does not exist: a question, or a full stop.

    >>> did_you_mean("compare"), did_you_mean(None)
    ("; did you mean 'compare'?", '.')
    """
    return "." if near is None else f"; did you mean {str(near)!r}?"


def nearest_path(path: Path, will_do: Callable[[Path], bool] = os.path.isdir) -> Path | None:
    """Return what exists at a path like `path`, the folders on the way there among what may be misspelt.

    Parameters
    ----------
    path
        Of which there is nothing.
    will_do
        Whether what exists is of the kind that is wanted; folders by default.
    """
    folder: Path | None = path.parent
    if folder is not None and not os.path.isdir(folder):
        folder = None if folder == path else nearest_path(folder)
    if folder is None:
        return None
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in itertools.islice(entries, ENTRIES) if will_do(folder / entry.name)]
    except OSError:  # nothing is known of a folder that may not be read
        return None
    name = nearest(path.name, names)
    return None if name is None else folder / name
