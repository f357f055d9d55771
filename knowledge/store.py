"""Knowledge: what the four stages share."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

from knowledge.log import Log
from knowledge.q_table import QTable
from knowledge.records import ChangePlan

TABLES = 8
"""Number of Q-tables that stay remembered."""


class Knowledge:
    """The log, the plan in force, the known actions, and the Q-tables that may be read or remembered.

    Each entry has one writer, named here; everybody may read.

    ============== ======== =============================================================
    entry          writer   meaning
    ============== ======== =============================================================
    ``log``        (each)   every record, in order; each stage appends its own kind
    ``plan``       Plan     newest ChangePlan
    ``actions``    Execute  ids with a row in the Q-table
    ``q_table``    Execute  the table at the end of the last episode, as a copy, on request
    ``remembered`` Plan     tables kept by hash for a later ``ChangePlan.adopt``
    ============== ======== =============================================================

    Parameters
    ----------
    log
        The loop's log.
    memory
        Number of Q-tables that can be remembered; the one unused for longest goes first.
    """

    def __init__(self, log: Log, memory: int = TABLES) -> None:
        self.log = log
        self.plan: ChangePlan | None = None
        self.actions: tuple[int, ...] = ()
        self._read_q: Callable[[], QTable] | None = None
        self._remembered: OrderedDict[str, QTable] = OrderedDict()
        self._memory = memory

    def serve_q_table(self, read: Callable[[], QTable] | None) -> None:
        """Let Execute, the only writer of the Q-table, say how a copy of it is had; None when it leaves."""
        self._read_q = read

    def q_table(self) -> QTable:
        """Return a copy of the Q-table at the end of the last episode.

        Raises
        ------
        LookupError
            No Execute is there.
        """
        if self._read_q is None:
            raise LookupError("no Execute is there that serves a Q-table")
        return self._read_q()

    def remember(self, table: QTable) -> str:
        """Keep a copy of `table` and return its hash, by which a plan can adopt it."""
        key = table.sha256()
        self._remembered[key] = table.copy()
        self._remembered.move_to_end(key)
        while len(self._remembered) > self._memory:
            self._remembered.popitem(last=False)
        return key

    def recall(self, key: str) -> QTable:
        """Return a copy of the remembered table with that hash.

        Raises
        ------
        LookupError
            It was never remembered, or others have taken its place.
        """
        if key not in self._remembered:
            raise LookupError(f"no Q-table {key[:12]}... is remembered; {len(self._remembered)} others are")
        self._remembered.move_to_end(key)
        return self._remembered[key].copy()

    def history(self, signal: str) -> list[float]:
        """Return the values of `signal` over the passes in the log's window, oldest first."""
        return [finished.observation.signals[signal] for finished in self.log.window]
