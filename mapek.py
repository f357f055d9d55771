"""The front door: whether mapek can run here is looked at before any of it is imported.

The command ``mapek`` and ``python -m mapek`` begin in `main`. Another project's package may stand in the place of one
of ours, or files be missing; the system may lack what mapek is built on. Each of these is said in a sentence, which no
import of ours could say any more. So this file imports nothing but Python's own, and can be read by Pythons on which
the rest cannot.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from binascii import b2a_base64
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

PACKAGES = ("adapters", "knowledge", "managed_systems", "mape")
"""Names under which mapek is imported."""

PYTHON = (3, 11)
"""Oldest Python that will do; `requires-python` of the distribution says it to installers."""

_OF_ITS_OWN = "Install mapek into a virtual environment of its own (`python -m venv DIR`, `DIR/bin/pip install ...`)"
_IN_RECORD = str.maketrans("+/", "-_", "=")
_ASKED_ONLY = frozenset({"-h", "--help", "--version"})


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, where that is possible; return the exit code.

    Parameters
    ----------
    arguments
        What was typed after ``mapek``; by default, of this process.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    obstacle = _python() or _packages() or _platform(arguments)
    if obstacle is None:
        try:
            from adapters.cli.main import main as command

            return command(arguments)
        except ImportError as error:
            obstacle = _lacking(error)
    sys.stderr.write("mapek: " + obstacle + "\n")
    return 1


def _python() -> str | None:
    if sys.version_info >= PYTHON:
        return None
    found = sys.version.split()[0]
    needed = ".".join(map(str, PYTHON))
    return f"Python {needed} or newer is needed, and {sys.executable} is {found}. Install mapek for another one."


def _platform(arguments: Sequence[str]) -> str | None:
    """Say that this system lacks what runs are made with, unless only help or versions are asked for."""
    if not arguments or _ASKED_ONLY.intersection(arguments):
        return None
    import signal

    lacks = [
        name
        for name, there in (
            ("file locks (fcntl)", importlib.util.find_spec("fcntl") is not None),
            ("owners of files (os.getuid)", hasattr(os, "getuid")),
            ("masks of signals (signal.pthread_sigmask)", hasattr(signal, "pthread_sigmask")),
        )
        if not there
    ]
    if not lacks:
        return None
    where = "Windows" if sys.platform == "win32" else f"This system, {sys.platform},"
    return (
        f"{where} does not have what mapek is built on: {', '.join(lacks)}. Use it on Linux, on macOS, or within the "
        "Windows Subsystem for Linux (WSL); here it answers --help and --version alone."
    )


def _packages() -> str | None:
    """Say which of our packages is not ours, or not whole, if any is."""
    home = os.path.dirname(os.path.realpath(__file__))
    for path, size, digest in _installed(home):
        if (wrong := _unlike(os.path.join(home, path), size, digest)) is not None:
            return f"the file {path} in {home} {wrong}{_claimed(home, path)}. {_OF_ITS_OWN}, or install it here again."
    for name in PACKAGES:
        spec = importlib.util.find_spec(name)
        if spec is None:
            found = "nowhere"
        elif not spec.origin:
            found = f"as a folder without __init__.py, {', '.join(spec.submodule_search_locations or ())}"
        elif os.path.dirname(os.path.dirname(os.path.realpath(spec.origin))) != home:
            found = f"at {spec.origin}"
        else:
            continue
        return (
            f"the package {name!r} is found {found}, not beside the others of mapek in {home}: a package of "
            f"another project, or a folder, stands in its way. {_OF_ITS_OWN}, and look at PYTHONPATH and at the folder "
            "you stand in."
        )
    return None


def _installed(home: str) -> Iterator[tuple[str, int, str]]:
    """Yield what was installed as ours: path, bytes, and the SHA-256 as it stands in RECORD. Of a checkout, nothing."""
    records = [
        os.path.join(entry.path, "RECORD")
        for entry in os.scandir(home)
        if entry.name.startswith("mapek-") and entry.name.endswith(".dist-info")
    ]
    records = [path for path in records if os.path.exists(path)]
    if not records:
        return
    # An installation over another one may leave two; the last is what holds.
    with open(max(records, key=os.path.getmtime), encoding="utf-8") as lines:
        for line in lines:
            path, digest, size = line.rstrip("\n").rsplit(",", 2)
            # What Python compiles has no size there; examples have to be there, and may be changed by who tries them.
            if size and path.partition("/")[0] in PACKAGES:
                yield path, -1 if path.startswith("mape/examples/") else int(size), digest.partition("=")[2]


def _unlike(path: str, size: int, digest: str) -> str | None:
    """Say in what a file is not the one that was installed: by its size, a package's own by its content."""
    try:
        found = os.stat(path).st_size
    except OSError:
        return "is gone"
    if 0 <= size != found:
        return f"is not the one that was installed ({found:,} bytes in place of {size:,})"
    if path.endswith("__init__.py"):
        import hashlib

        with open(path, "rb") as file:
            content = b2a_base64(hashlib.sha256(file.read()).digest(), newline=False).decode()
        if content.translate(_IN_RECORD) != digest:
            return "is not the one that was installed (another SHA-256)"
    return None


def _claimed(home: str, path: str) -> str:
    """Name the distributions that have installed a file of the same name."""
    others = []
    for entry in os.scandir(home):
        name, _, kind = entry.name.rpartition(".")
        if kind != "dist-info" or name.startswith("mapek-"):
            continue
        try:
            with open(os.path.join(entry.path, "RECORD"), encoding="utf-8") as lines:
                if any(line.startswith(path + ",") for line in lines):
                    others.append(" ".join(name.split("-", 1)))
        except OSError:
            continue
    return f"; {' and '.join(sorted(others))} has one of that name" if others else ""


def _lacking(error: ImportError) -> str:
    """Say what could not be imported; a part of the user's own that cannot is told elsewhere."""
    notes = "".join(f" {note}" for note in getattr(error, "__notes__", ()))
    again = "`python -m pip check` names what is missing or too old"
    if isinstance(error, ModuleNotFoundError) and error.name is not None:
        if error.name.partition(".")[0] in PACKAGES:
            return f"mapek's own module {error.name!r} is gone. {_OF_ITS_OWN}, or install it here again.{notes}"
        return (
            f"the package {error.name!r} is needed, and is not installed for {sys.executable}. Install mapek again, "
            f"with what it needs (without --no-deps); {again}.{notes}"
        )
    return f"a package that is needed cannot be imported: {error}. Install mapek again; {again}.{notes}"


if __name__ == "__main__":
    sys.exit(main())
