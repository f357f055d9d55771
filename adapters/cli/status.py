"""`mapek status`: who is there, and how far the run is."""

from __future__ import annotations

import argparse
import json
import sys

from adapters.buses.messages import Status
from adapters.cli.common import operator
from adapters.cli.sentences import sentence
from adapters.processes.supervise import ask_status
from adapters.roles import ROLES
from knowledge import from_json
from mape.errors import BusError

ANSWERED_WITHIN = 15.0
"""Seconds that Knowledge has to answer; over a good network it takes some milliseconds."""


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    with operator(chosen) as (session, wire):
        found = ask_status(session, wire, min(ANSWERED_WITHIN, wire.patience))
    if not found:
        raise BusError(f"Knowledge on {wire.endpoint} did not answer; with keys, only a role that it knows may ask")
    for status in found:
        if chosen.json:
            json.dump({"schema": status.tag(), **status.model_dump(mode="json")}, sys.stdout, indent=2)
            print()
        else:
            _print(status)
    return 0


def _print(status: Status) -> None:
    total = status.units * status.episodes
    loops = f", {status.units} loops" if status.units > 1 else ""
    print(
        f"{status.name} on {status.system}: {status.passes:,} of {total:,} passes{loops}, {status.mode}"
        f"{', complete' if status.complete else ''}"
    )
    print(f"{'role':<10}{'state':<8}{'pid':>8}  {'host':<16}{'start':>6}{'pass':>9}{'beat':>8}  last record")
    for name, role in status.roles.items():
        state = "here" if role.alive else "away"
        beat = "-" if role.beat_age is None else f"{role.beat_age:.1f} s"
        body = status.last[ROLES.index(name)]
        said = sentence(from_json(body)).split(maxsplit=1)[1] if body else ""
        print(
            f"{name:<10}{state:<8}{role.pid:>8}  {role.host[:15]:<16}{role.epoch:>6}{max(0, role.last_pass):>9,}"
            f"{beat:>8}  {said}"
        )
    print(f"knowledge {'here':<8}{status.pid:>7}   refused {status.refused}, dropped {status.dropped}")
