"""`mapek log`: the records of a run, from its folder, finished or not."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from adapters.cli.sentences import sentence
from adapters.replay.records import BATCH, log_of
from adapters.results.folder import read_manifest
from adapters.roles import STAGE_OF
from adapters.stores import Store
from adapters.stores.sqlite_store import Event, Swap
from knowledge import Observation, from_json
from mape.config import SwapConfig
from mape.errors import ConfigError, ResultsError
from mape.parts import owner
from mape.specs import PartSpec
from mape.swap import swap_sentence

LOOK_EVERY = 0.15
"""Seconds between two looks at a log that is followed."""

STAGES = ("observation", "symptom", "request", "plan")


class Dropped(NamedTuple):
    """Episodes of a free-running loop that are not in the log."""

    loop: int
    first: int
    last: int


Entry = tuple[int, int, "str | Swap | Dropped"]
"""Pass, stage, and what stands there: a record as JSON, or what happened before it."""


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    with _opened(chosen) as store:
        config = _config(store, chosen.follow)
        if config is None:
            raise ResultsError(f"{store.path} holds no record yet; --follow waits for the first")
        units, episodes = config["trials"] * config["loops"], config["episodes"]
        first, last = chosen.passes or (0, episodes)
        if last > episodes:
            raise ConfigError(f"--pass {first}:{last} goes beyond the run's {episodes} episodes")
        if chosen.loop is not None and chosen.loop >= units:
            raise ConfigError(f"--loop {chosen.loop}: the run has loops 0 to {units - 1}")
        loops = range(units) if chosen.loop is None else [chosen.loop]
        stages = range(4) if chosen.stage is None else [STAGES.index(chosen.stage)]
        cursors = [Cursor(store, loop, stages, first, last) for loop in loops]
        printer = _JsonLines() if chosen.json else _Sentences(units)
        events = 0
        while True:
            over = not chosen.follow or all(store.last(loop)[3] >= last for loop in loops)
            if chosen.events:
                for event in store.events(events):
                    events = event.number
                    if _wanted(event, chosen.loop, chosen.passes):
                        printer.event(event)
            for cursor in cursors:
                for number, stage, what in cursor.read(over):
                    printer.entry(cursor.loop, number, stage, what)
            printer.flush()
            if over:
                return 0
            time.sleep(LOOK_EVERY)  # another process writes the file, and tells nobody


class Cursor:
    """Reads one loop's log as far as it goes, and from there on at the next look.

    Parameters
    ----------
    store
        The log.
    loop
        Number of the loop in the records.
    stages
        Of the records that are wanted, from 0 for Observations.
    first, last
        Passes that are wanted; plan 0 is of pass 0.
    """

    def __init__(self, store: Store, loop: int, stages: Any, first: int, last: int) -> None:
        self.loop = loop
        self._store = store
        self._range = (first, last)
        # Of a free-running loop each stage is at another pass.
        self._next = dict.fromkeys(stages, first)
        self._told: set[tuple[object, ...]] = set()

    def read(self, over: bool) -> Iterator[Entry]:
        """Yield what is new, in order of pass and stage; if it is `over`, what stands after the last record too."""
        last = self._range[1]
        while wanted := {stage: number for stage, number in self._next.items() if number <= last}:
            found = self._store.since(self.loop, wanted, BATCH)
            if not found:
                break
            # Asked after the records: what was written before them is there then.
            beside = self._beside()
            for number, stage, body in found:
                self._next[stage] = number + 1
                if number <= last:
                    yield from self._before(beside, (number, stage))
                    yield number, stage, body
        if over:
            yield from self._before(self._beside(), (last + 1, 0))

    def _before(self, beside: list[Entry], place: tuple[int, int]) -> Iterator[Entry]:
        while beside and beside[0][:2] <= place:
            entry = beside.pop(0)
            self._told.add(_key(entry))
            yield entry

    def _beside(self) -> list[Entry]:
        first, last = self._range
        found: list[Entry] = [
            (max(first, a), 0, Dropped(self.loop, a, b))
            for a, b in self._store.dropped(self.loop)
            if a <= last and b >= first
        ]
        # A replacement stands right before the first record that the new part has made.
        found += [
            (swap.pass_no, STAGE_OF[owner(swap.part)], swap)
            for swap in self._store.swaps()
            if swap.loop == self.loop and first <= swap.pass_no <= last
        ]
        return sorted((entry for entry in found if _key(entry) not in self._told), key=lambda entry: entry[:2])


def _key(entry: Entry) -> tuple[object, ...]:
    return type(entry[2]), *entry[2][:3]  # loop, pass and part; or loop, first and last episode


class _Sentences:
    def __init__(self, units: int) -> None:
        self._units = units
        self._at: tuple[int, int] | None = None

    def entry(self, loop: int, number: int, stage: int, what: str | Swap | Dropped) -> None:
        of = f"loop {loop}, " if self._units > 1 else ""
        if isinstance(what, Dropped):
            one = what.first == what.last
            passes = f"pass {what.first}" if one else f"passes {what.first} to {what.last}"
            print(f"--- {of}{passes}: dropped, driven while Knowledge took no records")
            return
        if self._at != (loop, number):
            self._at = (loop, number)
            print(f"--- {of}pass {number}" if number else f"--- {of}start")
        if isinstance(what, Swap):
            planned = SwapConfig.model_validate(
                {"pass": what.pass_no, "part": what.part, "to": PartSpec.model_validate(what.spec)}
            )
            print(f"Swap      {swap_sentence(planned, what.handed_over)}.")
            return
        record = from_json(what)
        said = sentence(record)
        if isinstance(record, Observation) and record.age != 1:
            said = f"{said.removesuffix('.')}; the plan was {record.age} passes old."
        print(said)

    def event(self, event: Event) -> None:
        self._at = None
        stamp = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(event.time))
        where = "" if event.loop is None else f" (loop {event.loop}, pass {event.pass_no})"
        print(f"Event     {stamp} UTC, {event.role} {event.kind}{where}: {event.text}")

    def flush(self) -> None:
        print(end="", flush=True)


class _JsonLines:
    def entry(self, loop: int, number: int, stage: int, what: str | Swap | Dropped) -> None:
        if isinstance(what, str):
            print(what)
        elif isinstance(what, Swap):
            _, _, part, spec, handed_over, planned = what
            self._print(
                swap={"loop": loop, "pass": number, "part": part, "to": spec, "handed_over": handed_over,
                      "planned": planned}
            )  # fmt: skip
        else:
            self._print(dropped=what._asdict())

    def event(self, event: Event) -> None:
        number, clock, role, kind, loop, pass_no, text = event
        self._print(
            event={
                "number": number, "time": clock, "role": role, "kind": kind, "loop": loop, "pass": pass_no, "text": text
            }
        )  # fmt: skip

    def flush(self) -> None:
        print(end="", flush=True)

    @staticmethod
    def _print(**what: Any) -> None:
        print(json.dumps(what, separators=(",", ":")))


def _opened(chosen: argparse.Namespace) -> Store:
    folder = Path(chosen.folder)
    while True:
        path = log_of(folder)
        if path is not None:
            return Store(path, readonly=True)
        if read_manifest(folder).get("kind") != "up":
            raise ResultsError(
                f"{folder} has the tables of a run, and no log of its records: `mapek up` and `mapek serve` write one. "
                "`mapek run CONFIG --show FROM:TO` prints records while it runs"
            )
        if not chosen.follow:
            raise ResultsError(f"{folder} has no log yet; --follow waits for it")
        time.sleep(LOOK_EVERY)  # until another process has made it


def _config(store: Store, follow: bool) -> dict[str, Any] | None:
    while (config := store.facts().get("config")) is None and follow:
        time.sleep(LOOK_EVERY)  # until another process has written it
    return config


def _wanted(event: Event, loop: int | None, passes: tuple[int, int] | None) -> bool:
    """Whether an event is of the loop and passes that are asked for; what is of none always is."""
    if loop is not None and event.loop not in (None, loop):
        return False
    return passes is None or event.pass_no is None or passes[0] <= event.pass_no <= passes[1]
