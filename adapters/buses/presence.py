"""Who of the roles is there: their tokens, their heartbeats, and what a person is told of them."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from typing import Any

import zenoh

from adapters.buses.messages import Beat, Join, RoleStatus, Status
from adapters.buses.wire import LARGEST_MESSAGE
from adapters.roles import ROLES, STAGE_OF
from adapters.stores.ledger import Ledger
from knowledge import MalformedRecord


class _Seen:
    """What is known of a role beside its epoch."""

    def __init__(self) -> None:
        self.tokens: set[int] = set()
        self.pid = 0
        self.host = ""
        self.beat: Beat | None = None
        self.beat_at: float | None = None
        self.refused = 0


class Presence:
    """What Knowledge sees of the roles; for people and for the supervisor, never for the log.

    Parameters
    ----------
    ledger
        The logs, which say how far each role is.
    system, config
        The system's segment on the wire, and the run's config.
    """

    def __init__(self, ledger: Ledger, system: str, config: Mapping[str, Any]) -> None:
        self._ledger = ledger
        self._system = system
        self._config = config
        self._seen = {role: _Seen() for role in ROLES}
        self._came: set[str] = set()  # roles that were here since this Knowledge listens

    @property
    def all_came_and_went(self) -> bool:
        """Whether each role was here, and none is any more."""
        return self._came.issuperset(ROLES) and not any(seen.tokens for seen in self._seen.values())

    def joins(self, join: Join) -> None:
        """Take note that a role introduces itself."""
        seen = self._seen[join.role]
        seen.pid, seen.host, seen.beat, seen.beat_at = join.pid, join.host, None, time.monotonic()

    def refused(self, role: str) -> None:
        """Count something that was refused to a role."""
        if role in self._seen:
            self._seen[role].refused += 1

    def beats(self, sample: zenoh.Sample) -> None:
        """Take note of a heartbeat.

        Raises
        ------
        MalformedRecord
            It is none.
        """
        role = str(sample.key_expr).rsplit("/", 1)[-1]
        try:
            if len(sample.payload) > LARGEST_MESSAGE:
                raise MalformedRecord(f"{len(sample.payload)} bytes")
            beat, _ = Beat.unpack(sample.payload.to_bytes())
        except MalformedRecord as error:
            raise MalformedRecord(f"heartbeat: {error}") from error
        if role in self._seen and beat.epoch == self._ledger.epoch(role):
            seen = self._seen[role]
            seen.beat, seen.beat_at, seen.pid = beat, time.monotonic(), beat.pid

    def token(self, sample: zenoh.Sample) -> None:
        """Take note that a role's liveliness token came or went."""
        role, epoch = str(sample.key_expr).split("/")[-2:]
        if role not in self._seen or not (epoch.isascii() and epoch.isdigit() and len(epoch) <= 18):
            return
        if sample.kind == zenoh.SampleKind.PUT:
            self._seen[role].tokens.add(int(epoch))
            self._came.add(role)
        else:
            self._seen[role].tokens.discard(int(epoch))

    def forget_tokens(self) -> None:
        """Know of nobody that it is here; who is comes again."""
        for seen in self._seen.values():
            seen.tokens.clear()

    def status(self) -> Status:
        """Say who is there, and how far the run is."""
        ledger = self._ledger
        lasts = [ledger.last(loop) for loop in range(ledger.units)]
        now = time.monotonic()
        roles = {}
        for role, seen in self._seen.items():
            stage = STAGE_OF[role]
            beat = seen.beat
            roles[role] = RoleStatus(
                alive=ledger.epoch(role) in seen.tokens,
                epoch=ledger.epoch(role),
                pid=seen.pid,
                host=seen.host,
                passes=sum(max(0, last[stage]) for last in lasts),
                last_pass=min(last[stage] for last in lasts),
                beat_age=None if seen.beat_at is None else round(now - seen.beat_at, 3),
                refused=seen.refused + (0 if beat is None else beat.refused),
            )
        newest = [ledger.store.body(0, last, stage) if last >= 0 else None for stage, last in enumerate(lasts[0])]
        return Status(
            system=self._system,
            name=str(self._config.get("name", "run")),
            mode="free" if ledger.free else "lockstep",
            episodes=ledger.episodes,
            units=ledger.units,
            passes=sum(max(0, last[3]) for last in lasts),
            last=tuple(body or "" for body in newest),  # type: ignore[arg-type]
            roles=roles,
            refused=ledger.refused,
            dropped=sum(b - a + 1 for loop in range(ledger.units) for a, b in ledger.store.dropped(loop)),
            complete=ledger.complete,
            pid=os.getpid(),
        )
