"""Processes of a run that who started them has left behind: who they are, and what is to be done about them."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path
from typing import NamedTuple

from adapters.processes.serve import LEFT_WITHIN
from mape.errors import ResultsError

LOOK_EVERY = 0.1
"""Seconds between two looks at processes that are just ending."""


class Orphan(NamedTuple):
    """A process of a run; `stopped` by a signal, it hears nothing before it is continued."""

    pid: int
    role: str
    stopped: bool

    def __str__(self) -> str:
        return f"{self.role} {self.pid}{' (stopped)' * self.stopped}"


def wait_for_orphans(folder: Path) -> None:
    """Wait until the processes of an earlier `mapek up` of a run's folder are gone, who end as their leash does.

    Only who holds the folder's lock may ask: what is found then has no supervisor any more.

    Raises
    ------
    ResultsError
        They are not, as one that is stopped cannot be; it names them, and says what ends them.
    """
    until = time.monotonic() + LEFT_WITHIN
    while (found := orphans(folder)) and not any(orphan.stopped for orphan in found) and time.monotonic() < until:
        time.sleep(LOOK_EVERY)  # they are no children of this process, and tell nobody of their end
    if not found:
        return
    pids = " ".join(str(orphan.pid) for orphan in found)
    stopped = [str(orphan.pid) for orphan in found if orphan.stopped]
    continued = f"Continued by `kill -CONT {' '.join(stopped)}` they end by themselves; o" if stopped else "O"
    raise ResultsError(
        f"{folder} still has processes of a `mapek up` that is gone itself: {', '.join(map(str, found))}. {continued}r "
        f"end them by `kill -9 {pids}`. All that was logged is kept; then give the same command again"
    )


def orphans(folder: Path) -> list[Orphan]:
    """Return the processes that were started as roles of the run in `folder`, where the system tells of processes."""
    found = []
    with contextlib.suppress(OSError):  # no /proc: nobody can be named
        for pid in (int(name) for name in os.listdir("/proc") if name.isdigit()):
            with contextlib.suppress(OSError, ValueError, IndexError):  # it is gone meanwhile, or another user's
                arguments = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
                if "--leash" not in arguments:
                    continue
                config = Path(os.readlink(f"/proc/{pid}/cwd"), arguments[arguments.index("serve") + 1])
                state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
                if config.parent.resolve() == folder.resolve() and state != "Z":
                    found.append(Orphan(pid, arguments[arguments.index("--role") + 1], state in "Tt"))
    return sorted(found)
