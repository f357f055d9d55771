"""`mapek up`: a config as five processes on this machine, watched, and started again when they die."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

from adapters import private
from adapters.buses import tokens
from adapters.buses.endpoints import check_endpoint
from adapters.buses.wire import Wire, system_segment
from adapters.cli.common import config_of, finish, open_folder, prepare, say, wire_of
from adapters.cli.run import as_json, report, say_untaught
from adapters.cli.sentences import sentence
from adapters.cli.terminal import cleaned
from adapters.experiments.runner import check
from adapters.processes.export import export
from adapters.processes.orphans import wait_for_orphans
from adapters.processes.serve import Terminated, open_ledger, terminated_by_signal
from adapters.processes.supervise import Failed, Supervisor, command_of
from adapters.results import RunFolder
from adapters.roles import KNOWLEDGE, ROLES
from adapters.scratch import scratch
from adapters.stores import LOG_NAME, Swap
from adapters.stores.begun import go_on
from adapters.systems.declared import is_plant
from knowledge import from_json
from mape.config import Config, parts_of
from mape.errors import ConfigError
from mape.parts import make
from mape.trials import TrialResult


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    try:
        with terminated_by_signal():
            return _run(chosen)
    except Terminated:  # before there was a folder to speak of
        return 143


def _run(chosen: argparse.Namespace) -> int:
    prepare()
    config = config_of(chosen.config, chosen, chosen.agent)
    label = chosen.agent or config.name
    with contextlib.ExitStack() as opened:
        if chosen.tls is not None and chosen.listen is None:
            raise ConfigError(
                "the processes of `mapek up` meet on a socket of your own, which takes no keys; with --tls say where "
                "on the network they do, such as --listen tcp/127.0.0.1:7447"
            )
        endpoint = chosen.listen or _own_endpoint(opened)
        wire = wire_of(chosen, endpoint, system_segment(config.system.id))
        wire.check_here()
        folder = opened.enter_context(open_folder(chosen, "up", config.name, {label: config}, check=_check))
        try:
            _drive(chosen, config, label, wire, folder)
            conclude(chosen, config, label, folder)
        except (KeyboardInterrupt, Terminated) as stop:
            code = 130 if isinstance(stop, KeyboardInterrupt) else 143
            say(chosen, f"stopped. All that was logged is kept; `mapek resume {folder.path}` continues.")
            return code
        except Failed as failed:
            raise Failed(_with_way_on(str(failed), folder)) from failed
    return 0


def conclude(chosen: argparse.Namespace, config: Config, label: str, folder: RunFolder) -> None:
    """Make of Knowledge's log what `mapek run` makes: tables, summary, figures."""
    results, live = _collect(config, label, folder)
    result = as_json(config, results)
    if live:
        result["live_swaps"] = [
            {"loop": s.loop, "pass": s.pass_no, "part": s.part, "to": s.spec, "handed_over": s.handed_over}
            for s in live
        ]
    report(chosen, config, results, folder.last_episodes(label, "return", min(100, config.episodes)))
    say_untaught(chosen, config, results, folder, label)
    for swap in live:
        loop = f", loop {swap.loop}" if config.units > 1 else ""
        say(chosen, f"swapped:  {swap.part} is {json.dumps(swap.spec)} from pass {swap.pass_no} on{loop}")
    figures = []
    if not chosen.no_figures:
        from adapters.experiments.pictures import pictures_of_run

        figures = pictures_of_run(folder, label)
    finish(chosen, folder, result, figures)


def _with_way_on(said: str, folder: RunFolder) -> str:
    """Add to what a process said how the run is continued; who writes the log says so itself, and knows no folder."""
    named = said.replace("`mapek resume`", f"`mapek resume {folder.path}`")
    return named if named != said else f"{said} {folder.kept()}"


def _own_endpoint(opened: contextlib.ExitStack) -> str:
    # A socket in a folder that only this user can enter. Its path has to be short, and to have nothing in it that means
    # something in an endpoint; what is named by TMPDIR may be neither.
    for place in (None, "/tmp"):
        folder = opened.enter_context(scratch(place))
        endpoint = f"unixsock-stream/{folder}/k.sock"
        with contextlib.suppress(ConfigError):
            check_endpoint(endpoint, anywhere=False)
            opened.callback(tokens.forget, endpoint)
            return endpoint
    raise ConfigError(f"no socket can be made in {folder}; say where the processes meet: --listen tcp/127.0.0.1:7447")


def _check(config: Config) -> object:
    if is_plant(config.system):  # only Execute makes it, and tells what cannot be told without
        for kind, _, spec in parts_of(config):
            make(kind, spec)
        return None
    # What a free-running system is made of can be looked at as if it waited.
    still = config.execute.model_copy(update={"mode": "lockstep", "rate": None})
    return check(config.model_copy(update={"execute": still}), in_processes=True)


def _drive(chosen: argparse.Namespace, config: Config, label: str, wire: Wire, folder: RunFolder) -> None:
    logs = folder.path / "logs"
    private.make_folder(logs)
    wait_for_orphans(folder.path)
    ledger = open_ledger(config, folder.path / LOG_NAME, chosen.durability)
    with ledger.store:
        go_on(ledger)
        if ledger.complete:
            return  # only its tables are still to be made
    path = folder.path / f"config-{label}.json"
    shared = [
        *(["--tls", str(wire.tls)] if wire.tls else []),
        *(["--token", str(wire.token)] if wire.token else []),
        *(["--insecure"] if wire.insecure else []),
        *["--largest-message", str(chosen.largest_message)],
    ]
    kept = ["--durability", chosen.durability, "--snapshot-every", str(chosen.snapshot_every)]
    kept += ["--wal-limit", str(chosen.wal_limit)]
    kept += ["--requests", str(chosen.requests), "--refusals", str(chosen.refusals)]
    commands = {
        KNOWLEDGE: command_of(
            KNOWLEDGE, path, "--listen", wire.endpoint, "--log", str(folder.path / LOG_NAME), *kept, *shared
        ),
        **{role: command_of(role, path, "--connect", wire.endpoint, *shared) for role in ROLES},
    }
    commands["execute"] += ["--hang-after", str(chosen.hang_after)]
    if not chosen.quiet:
        print(f"five processes meet on {wire.endpoint}; the log is {folder.path / LOG_NAME}", file=sys.stderr)
    screen = Screen(chosen, config)
    with (
        Supervisor(
            wire, commands, logs, hang_after=chosen.hang_after, retries=config.system.retries, tell=screen.tell
        ) as supervisor,
        screen,
    ):
        supervisor.watch(screen.show)
        restarts = {role: child.restarts for role, child in supervisor.children.items() if child.restarts}
    if restarts:
        say(chosen, "restarts: " + ", ".join(f"{role} {count}" for role, count in restarts.items()))


def _collect(config: Config, label: str, folder: RunFolder) -> tuple[list[TrialResult], list[Swap]]:
    """Return the results, and the parts that were replaced while the loops ran."""
    ledger = open_ledger(config, folder.path / LOG_NAME, "normal")
    with ledger.store:
        results = export(config, ledger, Path(folder.chunk_stem(label, 0, config.units)))
        live = [swap for swap in ledger.store.swaps() if not swap.planned]
    folder.assemble(label)
    return results, live


def _waiting(supervisor: Supervisor) -> str:
    why = supervisor.why_waiting()
    if supervisor.status is None and not why:
        return "starting"
    return f"waiting ({why.rstrip('.')})" if why else "waiting"


class Screen:
    """What one sees of a run: a table that is drawn anew on a terminal, elsewhere a line now and then."""

    def __init__(self, chosen: argparse.Namespace, config: Config) -> None:
        self._quiet = chosen.quiet
        self._total = config.units * config.episodes
        self._seen: deque[tuple[float, int]] = deque(maxlen=20)
        self._live: Any = None
        self._said_at = time.monotonic()

    def __enter__(self) -> Screen:
        if not self._quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.live import Live

            # It draws by control characters: past what cleans standard error, so that each text is cleaned by itself.
            console = Console(file=getattr(sys.stderr, "stream", sys.stderr), markup=False)
            self._live = Live(console=console, transient=True, auto_refresh=False)
            self._live.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        if self._live is not None:
            self._live.__exit__(*error)

    def tell(self, sentence: str) -> None:
        """Say something beside the table."""
        if self._live is not None:
            self._live.console.print(cleaned(sentence))
        else:
            print(f"mapek: {sentence}", file=sys.stderr, flush=True)

    def show(self, supervisor: Supervisor) -> None:
        """Show how far the run is."""
        status = supervisor.status
        passes = 0 if status is None else status.passes
        now = time.monotonic()
        if not self._seen or now - self._seen[-1][0] > 0.4:
            self._seen.append((now, passes))
        (then, before), (here, after) = self._seen[0], self._seen[-1]
        rate = (after - before) / (here - then) if here > then else 0.0
        left = f"{(self._total - passes) / rate:,.0f} s left" if rate > 0 else _waiting(supervisor)
        if self._live is not None:
            self._live.update(self._table(supervisor, f"{passes:,} of {self._total:,} passes, {rate:,.0f}/s, {left}"))
            self._live.refresh()
        elif not self._quiet and now - self._said_at > 10.0:
            self._said_at = now
            print(f"{passes:,} of {self._total:,} passes, {rate:,.0f}/s, {left}", file=sys.stderr, flush=True)

    def _table(self, supervisor: Supervisor, title: str) -> Any:
        from rich.table import Table

        table = Table(title=cleaned(title), title_justify="left", expand=True)
        for name in ("role", "pid", "pass", "restarts", "state"):
            table.add_column(name, no_wrap=True)
        table.add_column("last record", no_wrap=True, ratio=1, overflow="ellipsis")
        status = supervisor.status
        for name, child in supervisor.children.items():
            role = None if status is None else status.roles.get(name)
            last, said, state = "", "", "starting"
            if role is not None and status is not None:
                last = f"{max(0, role.last_pass):,}"
                state = "done" if child.done else "here" if role.alive else "away"
                body = status.last[ROLES.index(name)]
                said = sentence(from_json(body)).split(maxsplit=1)[1] if body else ""
            elif name == KNOWLEDGE and status is not None:
                state, last = "here", f"{status.passes // max(1, status.units):,}"
                said = f"{status.refused} refused, {status.dropped} dropped"
            table.add_row(name, str(child.pid), last, str(child.restarts), state, cleaned(said))
        return table
