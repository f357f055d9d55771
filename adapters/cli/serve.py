"""`mapek serve`: one process of a run, on whatever machine."""

from __future__ import annotations

import argparse
import logging
import os
import subprocess
import sys
import threading
from pathlib import Path

from adapters.buses.endpoints import folder_of
from adapters.buses.wire import Wire, system_segment
from adapters.cli.common import config_of, open_folder, prepare, wire_of
from adapters.cli.terminal import Clean
from adapters.processes import sieve
from adapters.processes.serve import (
    Terminated,
    leash,
    open_ledger,
    serve_knowledge,
    serve_role,
    terminated_by_signal,
)
from adapters.processes.supervise import SYSTEM_FAILED
from adapters.stores import LOG_NAME
from adapters.stores.begun import go_on
from mape.config import Config
from mape.errors import ConfigError, ManagedSystemError


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    prepare()
    logging.basicConfig(stream=sys.stderr, level=logging.WARNING, format="%(asctime)s %(levelname)s %(message)s")
    logging.getLogger("adapters").setLevel(logging.INFO)  # ours alone: who draws the figures has much to say
    released = leash(folder_of(chosen.listen or chosen.connect or "")) if chosen.leash else None
    try:
        with terminated_by_signal():
            return _serve(chosen, released)
    except Terminated:
        return 143
    except ManagedSystemError as error:
        if released is None:
            raise
        print(f"mapek: {error}", file=sys.stderr)
        return SYSTEM_FAILED


def _serve(chosen: argparse.Namespace, released: threading.Event | None) -> int:
    config = config_of(chosen.config, chosen, chosen.agent)
    knowledge = chosen.role == "knowledge"
    endpoint, wrong = (chosen.listen, chosen.connect) if knowledge else (chosen.connect, chosen.listen)
    if endpoint is None or wrong is not None:
        raise ConfigError(
            f"role {chosen.role} {'listens' if knowledge else 'connects'}: give "
            f"{'--listen' if knowledge else '--connect'} ENDPOINT, such as tcp/127.0.0.1:7447, and not the other"
        )
    if chosen.hang_after is not None and chosen.role != "execute":
        raise ConfigError(
            f"--hang-after {chosen.hang_after:g} is of role execute, which ends itself where its system makes no step "
            f"for so long; {chosen.role} has no system"
        )
    wire = wire_of(chosen, endpoint, system_segment(config.system.id))
    _keep_standard_output(chosen.refusals if knowledge else None)
    if not knowledge:
        serve_role(config, chosen.role, wire, released, chosen.hang_after)
        return 0
    kept = {
        "durability": chosen.durability,
        "snapshot_every": chosen.snapshot_every,
        "wal_limit": chosen.wal_limit,
        "requests": chosen.requests,
    }
    if chosen.log is not None:  # somebody else makes the tables
        path = None if chosen.log == ":memory:" else Path(chosen.log)  # in memory: to be measured against
        serve_knowledge(config, wire, path, **kept)
        return 0
    _serve_with_results(chosen, config, wire, kept)
    return 0


def _keep_standard_output(most: int | None) -> None:
    """Lead what Zenoh writes to standard error; it knows standard output only, where results may go.

    Of Knowledge's, which anybody may make it write, `most` lines a minute.
    """
    sys.stdout.flush()
    ours = os.dup(1)
    os.environ.setdefault("NO_COLOR", "1")
    if most is None:
        os.dup2(2, 1)
    else:
        # It ends when this process does, and in a session of its own no sooner.
        program = [sys.executable, "-I", "-S", sieve.__file__, str(most)]
        through = subprocess.Popen(program, stdin=subprocess.PIPE, stdout=2, start_new_session=True)
        assert through.stdin is not None
        os.dup2(through.stdin.fileno(), 1)
        through.stdin.close()
    sys.stdout = Clean(os.fdopen(ours, "w", encoding="utf-8"))


def _serve_with_results(chosen: argparse.Namespace, config: Config, wire: Wire, kept: dict[str, object]) -> None:
    """Be Knowledge, with a folder of results at the end as `mapek up` makes it."""
    from adapters.cli import up

    label = chosen.agent or config.name
    wire.check_listen()  # no folder is begun by who cannot listen
    with open_folder(chosen, "up", config.name, {label: config}, check=lambda config: None) as folder:
        ledger = open_ledger(config, folder.path / LOG_NAME, chosen.durability)
        with ledger.store:
            go_on(ledger)
        serve_knowledge(config, wire, folder.path / LOG_NAME, **kept)  # type: ignore[arg-type]
        up.conclude(chosen, config, label, folder)
