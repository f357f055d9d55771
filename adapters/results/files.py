"""Files that are whole or not there."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from adapters import private
from mape.errors import ResultsError

DAMAGE = (OSError, EOFError, KeyError, ValueError, NotImplementedError, zipfile.BadZipFile, zlib.error)
"""What reading an ``.npz`` may raise where its bytes are not those that were written.

NotImplementedError is zipfile's word for a damaged entry that seems to ask for an unknown compression.
"""


GO_ON = (
    "What was finished before is kept; make room or choose another place, and give the same command with the same "
    "--out to go on."
)


Opener = Callable[[str, int], int]
"""What `open` takes as its `opener`."""


@contextlib.contextmanager
def whole(path: Path, way_out: str = GO_ON, opener: Opener | None = private.opener) -> Iterator[IO[bytes]]:
    """Open a file that takes its name only when all of it is written; for its owner alone, unless `opener` is another.

    Raises
    ------
    ResultsError
        The disk is full, or the folder cannot be written; nothing of the file stays. An OSError of what is done
        meanwhile counts as the file's: who does something else, such as printing, raises another error.
    """
    part = _part(path)
    try:
        with open(part, "wb", opener=opener) as file:
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
        with open(part, "wb", opener=private.opener):
            part.unlink()
    except OSError as error:
        raise cannot_write(path, error, way_out) from error


def _part(path: Path) -> Path:
    return path.with_name(f"{path.name}.{os.getpid()}.part")


def cannot_write(path: Path, error: OSError, way_out: str = GO_ON) -> ResultsError:
    """Say that a file could not be written, and the way out."""
    return ResultsError(f"{path} cannot be written: {error.strerror or error}. {way_out}")


def write_json(path: Path, data: Any, way_out: str = GO_ON, opener: Opener | None = private.opener) -> None:
    """Write data as indented JSON; a number that is not finite is a ValueError. `opener` is as `whole` takes it."""
    text = json.dumps(data, indent=2, sort_keys=False, allow_nan=False) + "\n"
    with whole(path, way_out, opener) as file:
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


SUM = "sha256"
"""Entry of a JSON file of ours for the SHA-256 of its other entries."""


def write_sealed(path: Path, data: Mapping[str, Any], way_out: str = GO_ON) -> None:
    """Write JSON with a checksum of all that stands in it."""
    write_json(path, {**data, SUM: _sum_of(data)}, way_out)


def read_sealed(path: Path) -> Any:
    """Read what `write_sealed` wrote, without its checksum.

    Raises
    ------
    ResultsError
        It cannot be read, is cut short, or is not what was written.
    """
    found = read_json(path)
    if not isinstance(found, dict) or found.pop(SUM, None) != _sum_of(found):
        raise ResultsError(f"{path} was changed after it was written: its {SUM} is not that of its other entries")
    return found


def _sum_of(data: Mapping[str, Any]) -> str:
    # Parsed again it is the same: JSON has no tuples, and no names but texts.
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def file_sum(path: Path) -> str:
    """Return a file's SHA-256.

    Raises
    ------
    ResultsError
        It cannot be read.
    """
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise ResultsError(f"{path} cannot be read: {error.strerror or error}") from error


def hold(path: Path) -> None:
    """Hold a file in the folder of a finished run against its checksum in ``result.json``.

    Raises
    ------
    ResultsError
        It is not what was written, or the result is not.
    """
    result = path.parent / "result.json"
    if not (result.is_file() and (path.parent / "manifest.json").is_file()):
        return
    wanted = read_sealed(result).get("files", {}).get(path.name)
    if wanted is not None and file_sum(path) != wanted:
        raise changed(path)


def changed(path: Path) -> ResultsError:
    """Say that a file of a finished run is not the one that was written."""
    said = f"{path} was changed after it was written: its SHA-256 is not the one in result.json."
    return ResultsError(f"{said} {made_again(path)}".rstrip())


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
