"""What the system allows this process, and what is said where that is not enough.

Native libraries end a process, or panic, where Python would raise: what they need at the least is looked at before they
are loaded. What runs out later is told of as far as it comes as an exception.
"""

from __future__ import annotations

import errno
import re

MIB = 1 << 20

FILES = {"up": 40, "serve": 40}
"""Open files that the processes of a run need at the least, by command; without them Zenoh panics."""

LEAST_FILES = 8
"""Open files without which Python itself cannot go on, to say what is missing."""

MEMORY = 420 * MIB
"""Address space below which NumPy's and Numba's libraries cannot even be loaded."""

COMPUTES = ("check", "compare", "replay", "reproduce", "resume", "run", "serve", "step", "up")
"""Commands that load them."""

_FILES = (errno.EMFILE, errno.ENFILE)
_TASKS = re.compile(r"can't start new thread|Resource temporarily unavailable")
_ROOM = re.compile(
    r"failed to map segment|[Cc]annot allocate memory|[Uu]nable to allocate|std::bad_alloc|LLVM ERROR: out of memory"
)


def obstacle(command: str) -> str | None:
    """Say which limit leaves a command no room to begin; a soft one is raised as far as needed and allowed."""
    try:
        import resource
    except ImportError:  # a system without such limits
        return None
    needed = FILES.get(command, LEAST_FILES)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < needed:
        if hard != resource.RLIM_INFINITY and hard < needed:
            return (
                f"the system allows a process {hard} open files, and `mapek {command}` needs {needed} at the least. "
                "Allow more: ulimit -n 1024"
            )
        resource.setrlimit(resource.RLIMIT_NOFILE, (needed, hard))
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    if command in COMPUTES and soft != resource.RLIM_INFINITY and soft < MEMORY:
        return (
            f"the system allows a process {soft // MIB} MiB of memory, and {MEMORY // MIB} MiB are needed for the "
            "libraries alone. Allow more: ulimit -v unlimited"
        )
    return None


def exhausted(error: BaseException) -> str | None:
    """Say which limit an error comes of, and the way out; None where it comes of none."""
    link: BaseException | None = error
    seen: set[int] = set()
    while link is not None and id(link) not in seen:  # code of the user's may raise an error from itself
        seen.add(id(link))
        if (said := _exhausted(link)) is not None:
            return said
        link = link.__cause__ or (None if link.__suppress_context__ else link.__context__)
    return None


def _exhausted(error: BaseException) -> str | None:
    number, text = getattr(error, "errno", None), str(error)
    if number in _FILES or "Too many open files" in text:
        return f"no further file can be opened{_limit('RLIMIT_NOFILE')}. Allow more, such as ulimit -n 1024."
    if isinstance(error, MemoryError) or number == errno.ENOMEM or _ROOM.search(text):
        return (
            f"there is no more memory{_limit('RLIMIT_AS', MIB, ' MiB')}. Allow more (ulimit -v unlimited), use fewer "
            "--workers, or a system with fewer states."
        )
    if number == errno.EAGAIN or _TASKS.search(text):
        return (
            f"no further process or thread can be started{_limit('RLIMIT_NPROC')}. Allow more (ulimit -u), end others, "
            "or use fewer --workers."
        )
    return None


def _limit(name: str, unit: int = 1, named: str = "") -> str:
    try:
        import resource
    except ImportError:
        return ""
    soft, _ = resource.getrlimit(getattr(resource, name))
    return "" if soft == resource.RLIM_INFINITY else f", the limit is {soft // unit:,}{named}"
