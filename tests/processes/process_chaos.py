"""Kills and freezes the processes of a run at random moments, and says what became of it."""

import os
import random
import signal
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from real_processes import MAPEK, ROLES, Up, up

from adapters.buses.wire import LEASE_MS

LONGER_THAN_LEASE = LEASE_MS / 1000 + 0.5


class Blow(NamedTuple):
    """What is done to whom, once the run has so many passes and after a pause."""

    number: int
    role: str
    freeze: bool
    pause: float


def blows(seed: int, total: int, kills: int, freezes: int, must: Sequence[str] = ()) -> list[Blow]:
    """Draw a plan of blows over a run of `total` passes; `must` are killed at least once each.

    A third of them come in pairs, where the second meets processes that are just starting and restoring.
    """
    draw = random.Random(seed)
    victims = [*must, *(draw.choice(ROLES) for _ in range(kills - len(must)))]
    frozen = [draw.choice(ROLES) for _ in range(freezes)]
    plan = [(role, False) for role in victims] + [(role, True) for role in frozen]
    draw.shuffle(plan)
    moments = sorted(draw.randint(1, round(0.8 * total)) for _ in plan)
    pauses = [draw.uniform(0.0, 0.01) for _ in plan]
    for at in range(2, len(moments), 3):
        moments[at], pauses[at] = moments[at - 1], draw.uniform(0.0, 1.0)
    return [
        Blow(number, role, freeze, pause) for number, pause, (role, freeze) in zip(moments, pauses, plan, strict=True)
    ]


def strike(running: Up, plan: Sequence[Blow]) -> list[Blow]:
    """Do what was planned; return what was done before the run was over."""
    pause, done = threading.Event(), []
    for blow in plan:
        running.wait_for_pass(blow.number)
        pause.wait(blow.pause)  # a random moment
        victim = _find(running, blow.role)
        if victim is None:
            break
        with suppress(ProcessLookupError):
            os.kill(victim, signal.SIGSTOP if blow.freeze else signal.SIGKILL)
            done.append(blow)
            if blow.freeze:
                pause.wait(LONGER_THAN_LEASE)  # until its peers take it for gone
                os.kill(victim, signal.SIGCONT)
    return done


def _find(running: Up, role: str) -> int | None:
    """Return the role's process; None once the run is over."""
    while not running.process.ended:
        found = running.children()
        if role in found:
            return found[role]
        if (running.out / "result.json").exists():
            break
        threading.Event().wait(0.005)
    return None


def survive(
    config: Path,
    plan: Sequence[Blow],
    *options: str,
    out: str = "up",
    start: Sequence[str] = MAPEK,
    within: float = 90.0,
) -> tuple[dict[str, Any], list[Blow], float]:
    """Run `mapek up` under blows; return its result, the blows that it took, and how long it was."""
    begun = time.monotonic()
    with up(config, *options, out=out, start=start) as running:
        done = strike(running, plan)
        return running.result(within=within), done, time.monotonic() - begun
