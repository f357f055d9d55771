"""One process of a run: Knowledge, or one of the roles that join it."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

from adapters.buses.hub import KnowledgeHub
from adapters.buses.member import Member
from adapters.buses.messages import Layout
from adapters.buses.pace import PACE
from adapters.buses.wire import Wire, versions
from adapters.processes.supervise import ENDS_WITHIN
from adapters.scratch import remove_orphan
from adapters.stores import Store
from adapters.stores.database import WAL_LIMIT
from adapters.stores.ledger import Ledger
from mape.config import Config
from mape.errors import PartError, ResultsError, Stop

logger = logging.getLogger(__name__)

LEFT_WITHIN = 5.0
"""Seconds that the roles of a complete run have to leave before Knowledge does."""


class Terminated(Stop):
    """SIGTERM came."""


@contextlib.contextmanager
def terminated_by_signal() -> Iterator[None]:
    """Let SIGTERM end what runs here as Ctrl-C does: by an exception, so that sessions are closed."""
    signals = {Terminated: signal.SIGTERM, KeyboardInterrupt: signal.SIGINT}

    def raise_it(number: int, frame: FrameType | None) -> None:
        # Once: what cleans up then is not to be broken off by the next signal.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise Terminated

    def raise_again(lost: type[BaseException]) -> None:
        # Python was where no exception comes out of; a moment later it is elsewhere.
        if lost is Terminated:
            signal.signal(signal.SIGTERM, raise_it)
        threading.Timer(0.01, os.kill, (os.getpid(), signals[lost])).start()

    def lost_in_a_finaliser(lost: Any) -> None:
        if lost.exc_type in signals:
            raise_again(lost.exc_type)
        else:
            hook(lost)

    def not_of_a_signal(record: logging.LogRecord) -> bool:
        # Of what a callback raises, Zenoh makes a line of its log; those of a session run in this thread too.
        lost = record.exc_info[0] if record.exc_info else None
        if lost is None or lost not in signals:
            return True
        raise_again(lost)
        return False

    callbacks = logging.getLogger("zenoh.handlers")
    callbacks.addFilter(not_of_a_signal)
    hook, sys.unraisablehook = sys.unraisablehook, lost_in_a_finaliser
    before = signal.signal(signal.SIGTERM, raise_it)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
        sys.unraisablehook = hook
        callbacks.removeFilter(not_of_a_signal)


def leash(folder: Path | None = None) -> threading.Event:
    """End this process when the one that started it is gone: its standard input then ends.

    Parameters
    ----------
    folder
        Where the processes meet; where it is one of `scratch`, which nobody else would remove then.

    Returns
    -------
    threading.Event
        Set when a line has come: the other one lets this one join its run.
    """
    released = threading.Event()

    def watch() -> None:
        # The descriptor itself: a thread that waits in `sys.stdin` would abort the interpreter's exit.
        with contextlib.suppress(OSError):
            while os.read(0, 4096):
                released.set()
        if folder is not None:
            remove_orphan(folder, ENDS_WITHIN)
        os.kill(os.getpid(), signal.SIGTERM)
        # A part may keep to itself what ends it. Nobody else would say the last word now; where all goes well, this
        # thread ends with its process in the middle of its sleep.
        time.sleep(ENDS_WITHIN)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, name="leash", daemon=True).start()
    return released


def quick_switches() -> None:
    """Let Zenoh's threads have the interpreter when something arrives; by default they wait five milliseconds."""
    sys.setswitchinterval(0.0005)


def open_ledger(config: Config, path: Path | None, durability: str, wal_limit: int = WAL_LIMIT) -> Ledger:
    """Open or begin Knowledge's file of a run.

    Raises
    ------
    ResultsError
        It is that of another run, or not whole, or another process writes it.
    """
    with contextlib.ExitStack() as opened:
        store = opened.enter_context(Store(path, durability, wal_limit=wal_limit))
        facts = store.facts()
        wanted = json.loads(config.to_json())
        if facts.get("config", wanted) != wanted:
            raise ResultsError(f"{path} is the log of a run with another config; choose another folder")
        if "config" not in facts:
            store.set_facts(config=wanted, versions=versions())
            store.commit()
        ledger = Ledger(store, config.units, config.episodes, free=config.execute.mode == "free")
        opened.pop_all()  # the ledger's from now on
    return ledger


def serve_knowledge(
    config: Config,
    wire: Wire,
    path: Path | None,
    *,
    durability: str = "normal",
    snapshot_every: int = 100,
    wal_limit: int = WAL_LIMIT,
    requests: int = PACE,
) -> None:
    """Be Knowledge until the run is complete and the roles have left.

    Raises
    ------
    ResultsError
        The log cannot be written; what was acknowledged is kept.
    """
    quick_switches()
    ledger = open_ledger(config, path, durability, wal_limit)
    try:
        hub = KnowledgeHub(ledger, wire, json.loads(config.to_json()), versions(), snapshot_every, requests)
        with hub:
            logger.info("Knowledge listens on %s; its log is %s", wire.endpoint, path or "in memory")
            while not hub.ended.wait(0.2):  # in steps, so that signals are heard
                hub.look_at_keys()
            if hub.failure is not None:
                raise hub.failure
            hub.left.wait(LEFT_WITHIN)
    finally:
        ledger.store.close()


def serve_role(
    config: Config, role: str, wire: Wire, released: threading.Event | None = None, hang_after: float | None = None
) -> None:
    """Be one of the roles until the run is complete.

    Parameters
    ----------
    config, role, wire
        What runs, which role it is, and where Knowledge listens.
    released
        Once it is set this role joins; None where it may at once.
    hang_after
        Of Execute: seconds without a step after which it ends this process; None for never.

    Raises
    ------
    MapekError
        A part or the system failed, or Knowledge refuses this role.
    """
    from adapters.processes.roles import make_role

    quick_switches()

    def member_of(layout: Layout | None) -> Member:
        return Member(
            wire,
            role,
            config=json.loads(config.to_json()),
            versions=versions(),
            layout=layout,
            waiting=lambda sentence: print(f"{role}: {sentence}", file=sys.stderr, flush=True),  # noqa: T201
        )

    try:
        made = make_role(role, config, member_of, hang_after)
        if released is not None:
            made.released = released
        made.run()
    except SystemExit as stop:
        # It would end this process as if all were done, or with a code that means something else.
        raise PartError(f"{role} failed: a part or the system of the config called sys.exit({stop.code!r})") from stop
