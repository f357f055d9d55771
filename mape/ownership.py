"""Whose a file or folder is: before what is in it is run, or trusted."""

from __future__ import annotations

import os
from pathlib import Path


def not_ones_own(path: Path, others_may: int = 0o755) -> str | None:
    """Say why others may have written what is at a path, or may; None where it is the user's own.

    Parameters
    ----------
    path
        A file or folder; a link is the user's own if what it leads to is so too.
    others_may
        The most that its mode may allow: by default others may read.

    Raises
    ------
    OSError
        It cannot be looked at.
    """
    user, about = os.getuid(), path.stat()
    for owner in (path.lstat().st_uid, about.st_uid):
        if owner != user:
            return f"{path} belongs to the user with the number {owner}, and you are {user}"
    if not_to_be := about.st_mode & 0o777 & ~others_may:
        return f"{path} is open to others (its mode is {about.st_mode & 0o777:o}, {not_to_be:o} too much)"
    return None
