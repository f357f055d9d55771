"""What can be said on the command line: its commands, their options, and the types of these."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

# Nothing else is imported here: `mapek --help` must answer at once.

DESCRIPTION = "Self-adaptive systems as an explicit Monitor - Analyze - Plan - Execute loop over shared Knowledge."
EPILOG = """\
examples:
  mapek reproduce table1                           the paper's Table 1, 1,000 trials, both agents
  mapek examples                                   the configs that are shipped, by the names used below
  mapek run frozen_lake --seed 7                   one run of any Gymnasium environment
  mapek run gridworld_goals --show 298:305         what each part says, pass by pass
  mapek compare gridworld_goals --trials 50        all agents of a config on the same seeds
  mapek run traffic --set 'monitor.detectors=["two_window"]'
  mapek up gridworld_goals                         the same loop as five processes

exit codes: 0 done, 1 failure, 2 usage, 130 stopped by Ctrl-C (finished trials are kept), 143 by SIGTERM
"""

_CONFIG = "TOML file, an example by its name (`mapek examples`), or the config-*.json of an earlier run"


class _Parser(argparse.ArgumentParser):
    """A command, which says of a word that it does not know which one may have been meant."""

    _way_out = ""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}\nSee `{self.prog} --help`.\n")

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        args = sys.argv[1:] if args is None else list(args)
        # Here, for else argparse first finds what a misspelt option has left missing.
        for word in itertools.takewhile(self._is_mine, args):
            option = word.partition("=")[0]
            # With a blank in it, it is a value to argparse.
            long = option.startswith("--") and option != "--" and " " not in word
            if long and not any(known.startswith(option) for known in self._option_string_actions):
                told = (name for name, a in self._option_string_actions.items() if a.help is not argparse.SUPPRESS)
                self._unknown("option", option, (name for name in told if name.startswith("--")))
        return super().parse_known_args(args, namespace)

    def _is_mine(self, word: str) -> bool:
        return word != "--"

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            what = action.option_strings[-1] if action.option_strings else action.dest
            self._unknown(what, str(value), map(str, action.choices))

    def _unknown(self, what: str, word: str, legal: Iterable[str]) -> NoReturn:
        from mape.errors import UnknownName

        self.error(str(UnknownName(what, word, legal, self._way_out if what == "option" else "")))


class _Top(_Parser):
    """The command line whole: what comes after a command is that command's."""

    _way_out = "Options of a command come after it."

    def _is_mine(self, word: str) -> bool:
        return word.startswith("-") and word != "--"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    top = _Top(
        prog="mapek", description=DESCRIPTION, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    top.add_argument("--version", action="store_true", help="print versions and leave")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)

    run = commands.add_parser("run", help="run a config; results go into a folder", description="Run a config.")
    run.add_argument("config", metavar="CONFIG", help=_CONFIG)
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
        "configs",
        nargs="+",
        metavar="CONFIG",
        help="config files, or examples by name; one alone is compared over its agents",
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
    reproduce.add_argument(
        "experiment", choices=["table1", "jump", "traffic"],
        help="goals that swap corners; jumps that become possible; a junction whose traffic shifts",
    )  # fmt: skip
    _what_runs(reproduce)
    _where_to(reproduce)
    reproduce.add_argument(
        "--no-statistics", action="store_true",
        help="leave the tables of results out; with --no-figures too, only run, store and hash",
    )  # fmt: skip

    step = commands.add_parser(
        "step", help="advance record by record on Enter", description="Step through a run, record by record."
    )
    step.add_argument("config", metavar="CONFIG", help=_CONFIG)
    step.add_argument("--agent", metavar="NAME", help="lay the config's [agents.NAME] over it")
    _overlays(step)
    step.add_argument(
        "--from", dest="first", type=_positive, default=1, metavar="PASS", help="run up to this pass first"
    )

    up = commands.add_parser(
        "up",
        help="run a config as five processes, watched and restarted",
        description="Run a config as five processes on this machine: Knowledge, Monitor, Analyze, Plan, Execute. They "
        "are watched, and started again when they die; what comes out is what `mapek run` gives, bit for bit.",
    )
    up.add_argument("config", metavar="CONFIG", help=_CONFIG)
    up.add_argument("--agent", metavar="NAME", help="lay the config's [agents.NAME] over it")
    _overlays(up)
    up.add_argument("--trials", type=_positive, metavar="N", help="independent repetitions, side by side")
    up.add_argument("--listen", metavar="ENDPOINT", help="where they meet (default: a socket in a temporary folder)")
    _where_to(up)
    _keeps(up)
    up.add_argument(
        "--hang-after", type=_seconds, default=60.0, metavar="S",
        help="restart a process that is alive and silent for so long; Execute, where its system makes no step for so "
        "long, however long an episode takes (default 60)",
    )  # fmt: skip
    _secure(up)

    serve = commands.add_parser(
        "serve",
        help="one process of a run, here or on another machine",
        description="Be one process of a run. Start the five in any order, on as many machines as you like.",
    )
    serve.add_argument("config", metavar="CONFIG", help="the same file and options for all processes")
    serve.add_argument("--role", required=True, choices=["knowledge", "monitor", "analyze", "plan", "execute"])
    serve.add_argument("--listen", metavar="ENDPOINT", help="knowledge: such as tcp/127.0.0.1:7447")
    serve.add_argument("--connect", metavar="ENDPOINT", help="the others: where Knowledge listens")
    serve.add_argument("--agent", metavar="NAME", help="lay the config's [agents.NAME] over it")
    _overlays(serve)
    serve.add_argument("--trials", type=_positive, metavar="N", help="independent repetitions, side by side")
    _where_to(serve)
    _keeps(serve)
    _secure(serve)
    _patient(serve)
    serve.add_argument(
        "--hang-after", type=_seconds, metavar="S",
        help="execute: end where the system makes no step for so long (default: wait)",
    )  # fmt: skip
    serve.add_argument("--log", metavar="FILE", help=argparse.SUPPRESS)
    serve.add_argument("--leash", action="store_true", help=argparse.SUPPRESS)

    status = commands.add_parser("status", help="who is there, and how far a run is", description="Look at a run.")
    status.add_argument("--connect", required=True, metavar="ENDPOINT", help="where Knowledge listens")
    status.add_argument("--json", action="store_true", help="as JSON")
    _secure(status)
    _patient(status)

    swap = commands.add_parser(
        "swap",
        help="replace a part of a running loop",
        description="Replace a part of a running loop at the boundary of a pass. What does not keep the contract of "
        "its kind, or fails at its first pass, is refused, and the old part goes on.",
    )
    swap.add_argument("part", metavar="PART", help="monitor, monitor.K, analyze, plan, plan.schedule or learner")
    swap.add_argument(
        "to", metavar="TO", help="short name, module:Class, or a table such as '{name = \"morphin\", alpha = 0.2}'"
    )
    swap.add_argument("--connect", required=True, metavar="ENDPOINT", help="where Knowledge listens")
    _secure(swap)
    _patient(swap)

    log = commands.add_parser(
        "log",
        help="the records of a run, from its folder",
        description="Print the records that a run of `mapek up` or `mapek serve` has logged, finished or not.",
    )
    log.add_argument("folder", metavar="DIR", help="folder of the run, or its log.sqlite")
    log.add_argument("--pass", dest="passes", type=_passes, metavar="N|FROM:TO", help="only these passes")
    log.add_argument("--stage", choices=["observation", "symptom", "request", "plan"], help="only this kind of record")
    log.add_argument("--loop", type=_natural, metavar="L", help="only this loop, by its number in the records")
    log.add_argument("--events", action="store_true", help="what happened beside the records too: who joined, ...")
    log.add_argument("--follow", action="store_true", help="go on until the run is complete, or Ctrl-C")
    log.add_argument("--json", action="store_true", help="JSON lines: each record as it stands in the log")

    replay = commands.add_parser(
        "replay",
        help="derive a run again and compare it with what is on disk",
        description="Derive each record of a log again (`mapek up`, `mapek serve`), or run the trials of a folder of "
        "tables again (`mapek run`, `compare`, `reproduce`), and name the first difference.",
    )
    replay.add_argument("folder", metavar="DIR", help="folder of the run, or its log.sqlite")
    replay.add_argument(
        "--to", type=_positive, metavar="PASS", help="stop after this pass, and show what Knowledge then held"
    )
    replay.add_argument("--loop", type=_natural, metavar="L", help="only this loop, by its number in the records")
    replay.add_argument("--json", action="store_true", help="as JSON; with --to the whole Q-table is in it")
    _how(replay)

    verify = commands.add_parser(
        "verify",
        help="hold what is on disk against its checksums",
        description="Hold a run's folder against its checksums: each record of a log, each kept state, table and "
        "result; and the log against its mark. Nothing is run again. The first thing that is not as it was written "
        "is named, with exit code 1.",
    )
    verify.add_argument("folder", metavar="DIR", help="folder of the run, or its log.sqlite")

    resume = commands.add_parser(
        "resume",
        help="continue an unfinished run, whatever command began it",
        description="Continue an unfinished run by the command that began it, in the folder where it was given.",
    )
    resume.add_argument("folder", metavar="DIR", help="folder of the run")
    resume.add_argument(
        "--mended", action="store_true",
        help="go on although modules of your own have changed since; what is finished stays as it is",
    )  # fmt: skip
    resume.add_argument(
        "--json", metavar="FILE", help="write the result as JSON too (- for standard output); that of the run's own "
        "command is not taken from the folder",
    )  # fmt: skip
    _how(resume)

    keys = commands.add_parser(
        "keys",
        help="make a private CA and the certificates of all roles",
        description="Make a private certificate authority and one certificate per role, for --tls DIR.",
    )
    keys.add_argument("folder", metavar="DIR")
    keys.add_argument(
        "--host",
        action="append",
        default=[],
        metavar="NAME",
        help="name or address of Knowledge's machine (repeatable)",
    )
    keys.add_argument("--days", type=_positive, default=365, metavar="N", help="validity (default 365)")
    keys.add_argument("--renew", metavar="ROLE", help="make this role's certificate anew, with the CA that is there")

    schema = commands.add_parser(
        "schema",
        help="the wire as an AsyncAPI document: every key expression and message",
        description="Print the AsyncAPI 3.0 document of the wire, generated from the code.",
    )
    schema.add_argument("--out", metavar="FILE", help="write it there instead")

    examples = commands.add_parser(
        "examples",
        help="configs and programs that are shipped: listed, or copied",
        description="List the examples. `mapek run NAME` finds a config among them by its bare name, where no file "
        "here has it. With DIR, copy all into that folder, overwriting nothing.",
    )
    examples.add_argument("folder", nargs="?", metavar="DIR", help="copy them into this folder, which may be new")

    commands.add_parser("list", help="systems, detectors, planners, schedules, learners: one line each")

    check = commands.add_parser(
        "check",
        help="hold a part or system against its contract",
        description="Check that a part or a system keeps the contract of its port.",
    )
    check.add_argument(
        "name", metavar="NAME|module:Class|CONFIG",
        help="short name, Gymnasium id, a part of your own, or a config, of which the system is checked",
    )  # fmt: skip
    _overlays(check, seed=False)
    check.add_argument(
        "--kind", choices=["detector", "analyzer", "planner", "schedule", "learner", "system"],
        help="what it is to be (default: told by its name or its members)",
    )  # fmt: skip
    check.add_argument(
        "--drive", type=_natural, metavar="N",
        help="episodes of a system that each clause drives (default 5; none of one that cannot be driven again, such "
        "as a plant, of which one object is made)",
    )  # fmt: skip
    return top


def _overlays(command: argparse.ArgumentParser, *, seed: bool = True) -> None:
    command.add_argument("--profile", metavar="NAME", help="lay the config's [profiles.NAME] over it")
    command.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides",
        help="override, such as plan.alpha=0.2; VALUE is TOML (repeatable)",
    )  # fmt: skip
    if seed:
        command.add_argument("--seed", type=_natural, metavar="N", help="root of all randomness")


def _what_runs(command: argparse.ArgumentParser) -> None:
    _overlays(command)
    command.add_argument("--trials", type=_positive, metavar="N", help="independent repetitions")
    command.add_argument("--workers", type=_positive, metavar="N", help="processes (default: one per core)")
    command.add_argument(
        "--engine", choices=["auto", "python", "compiled"],
        help="compile what can be (auto), nothing, or everything; the bits are the same",
    )  # fmt: skip
    command.add_argument("-v", "--verbose", action="store_true", help="say of each agent what is compiled, and why")


def _how(command: argparse.ArgumentParser) -> None:
    command.add_argument("--workers", type=_positive, metavar="N", help="processes (default: one per core)")
    command.add_argument("-q", "--quiet", action="store_true", help="no progress bar")
    _trusting(command)


def _trusting(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--trust", action="store_true",
        help="run what the folder names, although somebody else may have written it; else it is asked for",
    )  # fmt: skip


def _where_to(command: argparse.ArgumentParser) -> None:
    command.add_argument("--out", metavar="DIR", help="new folder, or that of an unfinished run to be continued")
    _trusting(command)
    command.add_argument("--json", metavar="FILE", help="write the result as JSON too; - for standard output")
    command.add_argument("--no-figures", action="store_true", help="leave the figures out")
    command.add_argument("-q", "--quiet", action="store_true", help="no progress bar")


def _keeps(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--durability", choices=["normal", "full"], default="normal",
        help="what is acknowledged outlives the process (normal), or a loss of power too (full, slower)",
    )  # fmt: skip
    command.add_argument(
        "--snapshot-every",
        type=_positive,
        default=100,
        metavar="N",
        help="passes between two kept states (default 100)",
    )
    command.add_argument(
        "--wal-limit", type=_positive, default=256, metavar="MB",
        help="size of log.sqlite-wal at which a reader who stays in the middle of a transaction ends the run "
        "(default 256)",
    )  # fmt: skip
    command.add_argument(
        "--requests",
        type=_positive,
        default=100,
        metavar="N",
        help="questions of a kind and role a second that are answered at once; others wait, so that they do not slow "
        "the run (default 100)",
    )
    command.add_argument(
        "--refusals", type=_positive, default=60, metavar="N",
        help="lines a minute that are written of who is turned away; of the others the count (default 60)",
    )  # fmt: skip
    command.add_argument(
        "--largest-message",
        type=_positive,
        default=128,
        metavar="MB",
        help="take no larger message, in MiB; a Q-table with its state is one (default 128)",
    )


def _secure(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--tls", metavar="DIR", help="keys as `mapek keys DIR` makes them: everybody proves who they are"
    )
    command.add_argument(
        "--token",
        metavar="FILE",
        help="where there are no keys: the run's token, for another user or machine than Knowledge's; Knowledge makes "
        "it, and by default it stands in the user's runtime folder, where the others find it",
    )
    command.add_argument(
        "--insecure",
        action="store_true",
        help="allow other machines without keys, where the network is trusted: nobody joins without the token, but "
        "whoever is on the way can read and change what is sent",
    )


def _patient(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--patience", type=_seconds, default=60.0, metavar="S",
        help="wait up to so long for one answer of a slow network; who says nothing for a sixth of it is away "
        "(default 60)",
    )  # fmt: skip


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0.1 <= seconds < 1e9:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds of at least 0.1")
    return seconds


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
    return _between(text, 1, "FROM:TO with 1 <= FROM <= TO, such as 298:305")


def _passes(text: str) -> tuple[int, int]:
    return _between(text, 0, "N or FROM:TO with 0 <= FROM <= TO, such as 300 or 298:305; 0 is the start")


def _between(text: str, least: int, legal: str) -> tuple[int, int]:
    first, _, last = text.partition(":")
    try:
        span = int(first), int(last or first)
    except ValueError:
        span = -1, -1
    if not least <= span[0] <= span[1]:
        raise argparse.ArgumentTypeError(f"{text!r} is not {legal}")
    return span
