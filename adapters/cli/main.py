"""The command line: the command that was typed is run, and what becomes of errors.

Exit codes: 0 done; 1 failure; 2 usage, a config among it; 130 after Ctrl-C, 143 after SIGTERM, with what is finished
kept.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import os
import sys
from collections.abc import Sequence

from adapters.cli.limits import exhausted, obstacle
from adapters.cli.options import parser
from adapters.cli.terminal import clean_streams

# Nothing else is imported here: `mapek --help` must answer at once.


class OutputError(Exception):
    """What was said to the user could not be written; `reason` is the OSError.

    It is none itself: while trials run, those are of the files of results.
    """

    def __init__(self, reason: OSError) -> None:
        super().__init__(str(reason))
        self.reason = reason


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    _open_streams()
    with clean_streams():
        return _main(arguments)


def _open_streams() -> None:
    """Put nothing in the place of standard streams that are closed: the next file would take their numbers."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        if getattr(sys, name) is None:
            with contextlib.suppress(OSError):
                os.fstat(number)
                continue  # it is open, and only Python has none
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free, which is this one
            setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115 - to the end


def _main(arguments: Sequence[str] | None) -> int:
    # Before NumPy is imported: a matrix product on several threads ends in other last bits on other numbers of cores.
    # Trials and roles are processes, and have the cores without it.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    top = parser()
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        chosen = top.parse_args(arguments)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 2
    chosen.arguments = arguments  # which the folder of a run keeps, for `mapek resume`
    if chosen.command is None and not chosen.version:
        top.print_help()
        return 2
    try:
        code = _version() if chosen.version else dispatch(chosen)
        sys.stdout.flush()  # here, where what goes wrong can still be said
        return code
    except KeyboardInterrupt as stop:
        print(f"mapek: stopped.{_notes(stop)}", file=sys.stderr)
        return 130
    except Exception as error:
        return _failed(error)


def _version() -> int:
    from adapters.versions import versions

    print(", ".join(f"{name} {version}" for name, version in versions().items()))
    return 0


def _notes(error: BaseException) -> str:
    """Return what was noted of a run on the way, a blank before each sentence."""
    return "".join(f" {note}" for note in getattr(error, "__notes__", ()))


def dispatch(chosen: argparse.Namespace) -> int:
    """Run the command that was chosen; return its exit code."""
    import importlib

    if (said := obstacle(chosen.command)) is not None:
        print(f"mapek: {said}", file=sys.stderr)
        return 1
    module = importlib.import_module(f"adapters.cli.{chosen.command}")
    code: int = module.execute(chosen)
    return code


def _failed(error: Exception) -> int:
    from mape.errors import ConfigError, MapekError

    if (reason := _of_output(error)) is not None:
        # What is still in the buffer would be tried once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        notes = _notes(error)
        if not isinstance(reason, BrokenPipeError):
            said = f"standard output cannot be written: {reason.strerror}. Lead it to another place.{notes}"
            print(f"mapek: {said}", file=sys.stderr)
        elif notes:  # else the reader has seen enough, as of `mapek list | head`
            print(f"mapek: nobody reads standard output any more.{notes}", file=sys.stderr)
        return 1
    limit = exhausted(error)
    if not isinstance(error, MapekError):
        if limit is None:
            raise error
        print(f"mapek: {limit}{_notes(error)}", file=sys.stderr)
        return 1
    print(f"mapek: {error}", file=sys.stderr)
    if limit is not None:
        print(f"mapek: {limit}", file=sys.stderr)
    if type(error).__name__ == "Stopped":
        return 130
    return 2 if isinstance(error, ConfigError) else 1


def _of_output(error: Exception) -> OSError | None:
    """Return what standard output raised, or None where the error is another one."""
    if isinstance(error, OutputError):
        return error.reason
    # Files of ours are written elsewhere, and named; what is left is standard output.
    full = (errno.ENOSPC, errno.EFBIG, errno.EIO)
    if isinstance(error, BrokenPipeError) or (
        isinstance(error, OSError) and not error.filename and error.errno in full
    ):
        return error
    return None
