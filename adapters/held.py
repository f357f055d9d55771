"""Who holds the lock of a file."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import IO, Any


def held_by(file: IO[Any]) -> str:
    """Say in brackets, a blank before, which process holds a lock (`flock`) of an open file; else, nothing.

    Linux tells in ``/proc/locks``: number, kind, mode, access, process, MAJOR:MINOR:INODE, and the range.
    """
    found = os.fstat(file.fileno())
    wanted = f"{os.major(found.st_dev):02x}:{os.minor(found.st_dev):02x}:{found.st_ino}"
    with contextlib.suppress(OSError):
        for line in Path("/proc/locks").read_text(encoding="utf-8").splitlines():
            words = line.split()
            if len(words) > 5 and words[1] == "FLOCK" and words[5] == wanted:
                return f" (process {words[4]})"
    return ""
