"""The high-water mark beside a log: how far the log was, in a file of its own.

A log that was deleted, cut short or put back from an older copy is whole in itself, and would be gone on with as if it
were the run. So each commit is counted in the log and, once it is written there, in the mark. A log that is behind its
mark is refused; one that is ahead, by what was committed and never acknowledged, is not.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from adapters import private
from mape.errors import ResultsError

TRIES = 100
"""How often a mark is read that another process may just be writing."""


class Mark(NamedTuple):
    """What the file says.

    Attributes
    ----------
    run : the log's name for itself, 32 hexadecimal digits.
    commits : those that were acknowledged.
    flushed : those of them that a loss of power cannot have taken.
    boot : of the machine, when this was written; empty where it tells none.
    """

    run: str
    commits: int
    flushed: int
    boot: str


def mark_path(log: Path) -> Path:
    """Return where the mark of a log stands."""
    return log.with_name(f"{log.stem}.mark")


def read_mark(log: Path) -> Mark | None:
    """Return what a log's mark says, or None where it has none.

    Raises
    ------
    ResultsError
        It is damaged.
    """
    path = mark_path(log)
    for _ in range(TRIES):
        try:
            with open(path, "rb", opener=private.opener) as file:
                found = _parsed(file.read(1000))
        except FileNotFoundError:
            return None
        except OSError as error:
            raise ResultsError(f"{path} cannot be read: {error.strerror or error}") from error
        if found is not None:
            return found
    raise ResultsError(
        f"{path} is damaged, so nobody can tell whether {log.name} is as it was left; only a copy of the whole folder "
        "from before mends it, or a new run in another folder"
    )


class MarkFile:
    """The mark of a log, for the log's one writer.

    Parameters
    ----------
    log
        The log; its mark is made, or put in the place of one that counts nothing.
    mark
        What it says from then on.

    Raises
    ------
    OSError
        It cannot be written.
    """

    def __init__(self, log: Path, mark: Mark) -> None:
        path = mark_path(log)
        self.mark = mark
        part = path.with_name(f"{path.name}.{os.getpid()}.part")
        with suppress(FileNotFoundError):
            part.unlink()
        self._file = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, private.FILE)
        try:
            os.fchmod(self._file, private.FILE)
            self.write(mark)
            os.fsync(self._file)
            os.replace(part, path)
            folder = os.open(path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)  # the file's name, and that of the log
            finally:
                os.close(folder)
        except BaseException:
            os.close(self._file)
            with suppress(OSError):
                part.unlink()
            raise

    def write(self, mark: Mark) -> None:
        """Say something else; what is written has one length, and is written over what was there."""
        os.pwrite(self._file, _text(mark), 0)
        self.mark = mark

    def close(self) -> None:
        """Leave the file."""
        os.close(self._file)


def boot_id() -> str:
    """Return what names the machine's present boot, or an empty text where it tells none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()[:36]
    except (OSError, ValueError):
        return ""


def _text(mark: Mark) -> bytes:
    said = f"mapek-mark {mark.run} {mark.commits:020d} {mark.flushed:020d} {mark.boot or '-':36}"
    return f"{said} {hashlib.sha256(said.encode()).hexdigest()}\n".encode()


def _parsed(data: bytes) -> Mark | None:
    said, _, digest = data.rstrip(b"\n").rpartition(b" ")
    if hashlib.sha256(said).hexdigest().encode() != digest:
        return None
    _, run, commits, flushed, boot = said.decode().split()
    return Mark(run, int(commits), int(flushed), "" if boot == "-" else boot)
