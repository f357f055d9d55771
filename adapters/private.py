"""Files that their owner alone may read, and that are never reached through a link.

What a run writes may hold what a plant has told, and what a run reads may come from a folder that somebody else has
packed. So each file of a run is made with mode 600 and each folder with mode 700, whatever the process's umask, and a
symbolic link in the place of one is refused: it would lead a write, or a read, out of the folder.
"""

from __future__ import annotations

import contextlib
import os
import stat
from pathlib import Path

from mape.errors import ResultsError

FILE, FOLDER = 0o600, 0o700
"""Modes of what is made."""


def opener(path: str, flags: int) -> int:
    """Open a file as `open` asks its `opener` to: what is made is private, and no link is followed.

    Raises
    ------
    OSError
        It cannot be opened, or is a link.
    """
    there = os.path.lexists(path)
    descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, FILE)
    if flags & os.O_CREAT and not there:
        try:
            os.fchmod(descriptor, FILE)
        except OSError:
            os.close(descriptor)
            raise
    return descriptor


def make_folder(path: Path) -> None:
    """Make a folder, and those around it that are missing, for the owner alone; one that is there stays as it is.

    Raises
    ------
    OSError
        It cannot be made.
    """
    missing = []
    while not path.is_dir():
        missing.append(path)
        if path == path.parent:
            break
        path = path.parent
    for folder in reversed(missing):
        try:
            folder.mkdir(mode=FOLDER)
            folder.chmod(FOLDER)
        except FileExistsError:
            if not folder.is_dir():  # else another process was quicker
                raise


def refuse_links(folder: Path) -> None:
    """Look whether a run's folder holds anything but files and folders.

    Raises
    ------
    ResultsError
        A link, a pipe, a socket or a device is in it.
    """
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = os.path.join(place, name)
            with contextlib.suppress(FileNotFoundError):  # of a run that goes on
                mode = os.lstat(path).st_mode
                if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                    kind = "a symbolic link" if stat.S_ISLNK(mode) else "neither a file nor a folder"
                    raise ResultsError(
                        f"{path} is {kind}, which mapek never makes in the folder of a run; nothing was read or "
                        "written there. Put what it stands for in its place, or take another folder"
                    )
