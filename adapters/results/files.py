"""Files that are whole or not there."""

from __future__ import annotations

import contextlib
import json
import os
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from mape.errors import ResultsError

DAMAGE = (OSError, EOFError, KeyError, ValueError, NotImplementedError, zipfile.BadZipFile, zlib.error)
"""What reading an ``.npz`` may raise where its bytes are not those that were written.

NotImplementedError is zipfile's word for a damaged entry that seems to ask for an unknown compression.
"""


GO_ON = (
    "What was finished before is kept; make room or choose another place, and give the same command with the same "
    "--out to go on."
)


@contextlib.contextmanager
def whole(path: Path, way_out: str = GO_ON) -> Iterator[IO[bytes]]:
    """Open a file that takes its name only when all of it is written.

    Raises
    ------
    ResultsError
        The disk is full, or the folder cannot be written; nothing of the file stays. An OSError of what is done
        meanwhile counts as the file's: who does something else, such as printing, raises another error.
    """
    part = _part(path)
    try:
        with open(part, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise cannot_write(path, error, way_out) from error
        raise


def try_whole(path: Path, way_out: str) -> None:
    """Try whether `whole` could write a file, and leave nothing behind.

    Raises
    ------
    ResultsError
        It could not.
    """
    part = _part(path)
    try:
        with open(part, "wb"):
            part.unlink()
    except OSError as error:
        raise cannot_write(path, error, way_out) from error


def _part(path: Path) -> Path:
    return path.with_name(f"{path.name}.{os.getpid()}.part")


def cannot_write(path: Path, error: OSError, way_out: str = GO_ON) -> ResultsError:
    """Say that a file could not be written, and the way out."""
    return ResultsError(f"{path} cannot be written: {error.strerror or error}. {way_out}")


def write_json(path: Path, data: Any, way_out: str = GO_ON) -> None:
    """Write data as indented JSON; a number that is not finite is a ValueError."""
    text = json.dumps(data, indent=2, sort_keys=False, allow_nan=False) + "\n"
    with whole(path, way_out) as file:
        file.write(text.encode())


def read_json(path: Path) -> Any:
    """Read a JSON file of ours.

    Raises
    ------
    ResultsError
        It cannot be read, or is cut short.
    """
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise ResultsError(f"{path} cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise ResultsError(f"{path} is damaged ({error}); delete it to have it made again") from error


def made_again(path: Path) -> str:
    """Say how a table of a run's folder is made again, or nothing where `path` stands in no such folder."""
    folder = path.parent
    if not (folder / "manifest.json").is_file():
        return ""
    return f"Delete {folder / 'result.json'}, if it is there; then `mapek resume {folder}` makes the tables again."


def read_npz(path: Path, way_out: str, names: Iterable[str] | None = None) -> dict[str, npt.NDArray[Any]]:
    """Read arrays of an ``.npz``, all of them if no `names` are given.

    Raises
    ------
    ResultsError
        It is missing, cut short, or changed.
    """
    try:
        # Opened here: `np.load` leaves a file that it cannot read open.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in (archive.files if names is None else names)}
    except DAMAGE as error:
        raise ResultsError(f"{path} is damaged ({error}). {way_out}".rstrip()) from error
