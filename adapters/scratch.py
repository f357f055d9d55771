"""Temporary folders of a process, which do not outlive it for long, however it ends.

Who is killed removes nothing. So each folder holds a file that its process keeps locked; the kernel lets go of the lock
with the process, and whoever finds it free removes the folder: the processes that were started, and the next one that
makes such a folder.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

PREFIX = "mapek-"
LOCK = ".mapek-lives"

LOOK_EVERY = 0.01
"""Seconds between two looks whether an owner is gone."""


@contextlib.contextmanager
def scratch(place: str | None = None) -> Iterator[Path]:
    """Make a folder that only this user can enter, and remove it at the end; before, those whose owners were killed.

    Parameters
    ----------
    place
        Where; by default where temporary files belong.
    """
    for others in {tempfile.gettempdir(), place or tempfile.gettempdir()}:
        with contextlib.suppress(OSError):
            for entry in os.listdir(others):
                if entry.startswith(PREFIX):
                    remove_orphan(Path(others, entry))
    # What it says on the way out of a folder that somebody has removed meanwhile is nobody's business.
    with tempfile.TemporaryDirectory(prefix=PREFIX, dir=place, ignore_cleanup_errors=True) as made, _lives(Path(made)):
        yield Path(made)


def remove_orphan(folder: Path, within: float = 0.0) -> None:
    """Remove a folder of `scratch` whose owner is gone; any other one stays.

    Parameters
    ----------
    folder
        Which.
    within
        Seconds that an owner who is just being killed has: the kernel closes its files one after the other.
    """
    until = time.monotonic() + within
    while not _removed(folder) and time.monotonic() < until:
        time.sleep(LOOK_EVERY)  # to wait in `flock` itself would have no end where the owner lives on


def _removed(folder: Path) -> bool:
    """Remove a folder whose owner is gone; say whether there is nothing left to wait for."""
    try:
        found = os.lstat(folder)
        if not folder.name.startswith(PREFIX) or not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
            return True
        lock = os.open(folder / LOCK, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises where the owner lives
            shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(lock)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


@contextlib.contextmanager
def _lives(folder: Path) -> Iterator[None]:
    # Locked before it has its name: at no time does it look like one that is left over.
    unnamed = folder / f"{LOCK}.new"
    lock = os.open(unnamed, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        os.rename(unnamed, folder / LOCK)
        yield
    finally:
        os.close(lock)
