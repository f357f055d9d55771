"""The command line: what can be said, and what becomes of errors.

Exit codes: 0 done; 1 failure; 2 usage, a config among it; 130 after Ctrl-C, with what is finished kept.
"""

from __future__ import annotations

import argparse
import errno
import os
import sys
from collections.abc import Sequence

# Nothing else is imported here: `mapek --help` must answer at once.

DESCRIPTION = "Self-adaptive systems as an explicit Monitor - Analyze - Plan - Execute loop over shared Knowledge."
EPILOG = """\
examples:
  mapek reproduce table1                                    the paper's Table 1, 1,000 trials, both agents
  mapek run examples/frozen_lake.toml --seed 7              one run of any Gymnasium environment
  mapek run examples/gridworld_goals.toml --show 298:305    what each part says, pass by pass
  mapek compare examples/gridworld_goals.toml --trials 50   all agents of a config on the same seeds
  mapek run examples/traffic.toml --set 'monitor.detectors=["two_window"]'

exit codes: 0 done, 1 failure, 2 usage, 130 stopped by Ctrl-C (finished trials are kept)
"""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> None:  # type: ignore[override]
        self.exit(2, f"{self.prog}: {message}\nSee `{self.prog} --help`.\n")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    top = _Parser(
        prog="mapek", description=DESCRIPTION, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    top.add_argument("--version", action="store_true", help="print versions and leave")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)

    run = commands.add_parser("run", help="run a config; results go into a folder", description="Run a config.")
    run.add_argument("config", metavar="CONFIG", help="TOML file, or the config-*.json of an earlier run")
    run.add_argument("--agent", metavar="NAME", help="lay the config's [agents.NAME] over it")
    _what_runs(run)
    _where_to(run)
    run.add_argument(
        "--show", type=_span, metavar="FROM:TO", help="print the four records of these passes as sentences"
    )
    run.add_argument("--trace", type=_span, metavar="FROM:TO", help="keep every step of these episodes of trial 0")

    compare = commands.add_parser(
        "compare",
        help="several configs, or all agents of one, on the same seeds",
        description="Run configs on the same seeds: one table, with effect sizes, intervals and tests.",
    )
    compare.add_argument(
        "configs", nargs="+", metavar="CONFIG", help="config files; one alone is compared over its agents"
    )
    compare.add_argument("--agents", metavar="A,B", help="of the configs' agents, only these")
    _what_runs(compare)
    _where_to(compare)

    reproduce = commands.add_parser(
        "reproduce",
        help="the paper's experiments, table1 beside the paper's numbers",
        description="Reproduce an experiment of arXiv 2601.20714: table1 beside the paper's numbers, jump and traffic "
        "beside numbers found before.",
    )
    reproduce.add_argument("experiment", choices=["table1", "jump", "traffic"])
    _what_runs(reproduce)
    _where_to(reproduce)

    step = commands.add_parser(
        "step", help="advance record by record on Enter", description="Step through a run, record by record."
    )
    step.add_argument("config", metavar="CONFIG")
    step.add_argument("--agent", metavar="NAME", help="lay the config's [agents.NAME] over it")
    _overlays(step)
    step.add_argument(
        "--from", dest="first", type=_positive, default=1, metavar="PASS", help="run up to this pass first"
    )

    commands.add_parser("list", help="systems, detectors, planners, schedules, learners: one line each")

    check = commands.add_parser(
        "check",
        help="hold a part or system against its contract",
        description="Check that a part or a system keeps the contract of its port.",
    )
    check.add_argument("name", metavar="NAME|module:Class", help="short name, Gymnasium id, or a part of your own")
    check.add_argument("--kind", choices=["detector", "analyzer", "planner", "schedule", "learner", "system"])
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    top = parser()
    try:
        chosen = top.parse_args(arguments)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 2
    if chosen.version:
        from adapters.results.folder import versions

        print(", ".join(f"{name} {version}" for name, version in versions().items()))
        return 0
    if chosen.command is None:
        top.print_help()
        return 2
    try:
        code = _dispatch(chosen)
        sys.stdout.flush()  # here, where what goes wrong can still be said
        return code
    except KeyboardInterrupt:
        print("stopped.", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader has gone (`mapek list | head`); Python would complain once more when it flushes at exit.
        _silence()
        return 1
    except Exception as error:
        return _failed(error)


def _silence() -> None:
    # What is still in the buffer would be tried once more at exit.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _dispatch(chosen: argparse.Namespace) -> int:
    import importlib

    if (sentence := _shadowed()) is not None:
        print(f"mapek: {sentence}", file=sys.stderr)
        return 1
    module = importlib.import_module(f"adapters.cli.{chosen.command}")
    code: int = module.execute(chosen)
    return code


def _shadowed() -> str | None:
    """Say which package of another project stands in the way of one of ours, if any does."""
    import importlib.util

    home = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    for name in ("knowledge", "mape", "managed_systems"):
        spec = importlib.util.find_spec(name)
        found = "nowhere" if spec is None else spec.origin or "a folder without __init__.py"
        if os.path.dirname(os.path.dirname(os.path.abspath(found))) != home:
            return (
                f"the package {name!r} is found at {found}, not beside mapek's own in {home}: a package of another "
                "project, or a folder, stands in its way. Install mapek into a virtual environment of its own, and "
                "look at PYTHONPATH and at the folder you stand in."
            )
    return None


def _failed(error: Exception) -> int:
    from mape.errors import ConfigError, MapekError

    if isinstance(error, OSError) and error.filename is None and error.errno in (errno.ENOSPC, errno.EFBIG, errno.EIO):
        # Files of ours are written elsewhere, and named; what is left is standard output.
        print(f"mapek: standard output cannot be written: {error.strerror}. Lead it to another place.", file=sys.stderr)
        _silence()
        return 1
    if not isinstance(error, MapekError):
        raise error
    print(f"mapek: {error}", file=sys.stderr)
    if type(error).__name__ == "Stopped":
        return 130
    return 2 if isinstance(error, ConfigError) else 1


def _overlays(command: argparse.ArgumentParser) -> None:
    command.add_argument("--profile", metavar="NAME", help="lay the config's [profiles.NAME] over it")
    command.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides",
        help="override, such as plan.alpha=0.2; VALUE is TOML (repeatable)",
    )  # fmt: skip
    command.add_argument("--seed", type=_natural, metavar="N", help="root of all randomness")


def _what_runs(command: argparse.ArgumentParser) -> None:
    _overlays(command)
    command.add_argument("--trials", type=_positive, metavar="N", help="independent repetitions")
    command.add_argument("--workers", type=_positive, metavar="N", help="processes (default: one per core)")


def _where_to(command: argparse.ArgumentParser) -> None:
    command.add_argument("--out", metavar="DIR", help="new folder, or that of an unfinished run to be continued")
    command.add_argument("--json", metavar="FILE", help="write the result as JSON too; - for standard output")
    command.add_argument("--no-figures", action="store_true", help="leave the figures out")
    command.add_argument("-q", "--quiet", action="store_true", help="no progress bar")


def _positive(text: str) -> int:
    return _whole(text, 1)


def _natural(text: str) -> int:
    return _whole(text, 0)


def _whole(text: str, least: int) -> int:
    try:
        number = int(text)
    except ValueError:
        number = least - 1
    if number < least:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least {least}")
    return number


def _span(text: str) -> tuple[int, int]:
    first, _, last = text.partition(":")
    try:
        span = int(first), int(last or first)
    except ValueError:
        span = 0, 0
    if not 1 <= span[0] <= span[1]:
        raise argparse.ArgumentTypeError(f"{text!r} is not FROM:TO with 1 <= FROM <= TO, such as 298:305")
    return span
