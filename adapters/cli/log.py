"""`mapek log`: the records of a run, from its folder, finished or not."""

from __future__ import annotations

import argparse
import json
import os
import sys
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


Entry = tuple[int, int, "str | Swap | Dropped | Event"]
"""Pass, stage, and what stands there: a record as JSON, or what happened before it."""


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    with opened(Path(chosen.folder), chosen.follow) as store:
        config = config_in(store, chosen.follow)
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
        if chosen.events:
            for cursor in cursors:
                cursor.tell_events(of_all=cursor is cursors[0])
        printer = _JsonLines() if chosen.json else _Sentences(units)
        told = False
        while True:
            over = not chosen.follow or all(store.last(loop)[3] >= last for loop in loops)
            for cursor in cursors:
                for number, stage, what in cursor.read(over):
                    printer.entry(cursor.loop, number, stage, what)
                    told = True
            printer.flush()
            if over and not told:
                begun = any(store.count(loop) for loop in range(units))
                none = "no such record" if begun else "no record yet; --follow waits for the first"
                raise ResultsError(f"{store.path} holds {none}")
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
        self._wants_events = self._of_all = False
        self._newest = 0  # number of the last event that was looked at
        self._waiting: list[Entry] = []  # events that were not yielded yet

    def tell_events(self, *, of_all: bool) -> None:
        """Yield the loop's events too from now on, and, if `of_all`, those that are of no single loop."""
        self._wants_events, self._of_all = True, of_all

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
        else:  # what happens while no record comes may be why none does
            yield from self._before(self._events(), (last + 1, 0))

    def _before(self, beside: list[Entry], place: tuple[int, int]) -> Iterator[Entry]:
        while beside and beside[0][:2] <= place:
            entry = beside.pop(0)
            if isinstance(entry[2], Event):
                self._waiting.remove(entry)
            else:
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
        found = [entry for entry in found if _key(entry) not in self._told]
        return sorted([*self._events(), *found], key=lambda entry: entry[:2])

    def _events(self) -> list[Entry]:
        """Return the events that are to be told, each where it happened."""
        first, last = self._range
        for event in self._store.events(self._newest) if self._wants_events else ():
            self._newest = event.number
            number = event.pass_no or 0
            if first <= number <= last and (event.loop == self.loop or (event.loop is None and self._of_all)):
                self._waiting.append((*_place(event), event))
        self._waiting.sort(key=lambda entry: entry[:2])
        return [*self._waiting]


def _place(event: Event) -> tuple[int, int]:
    """Return pass and stage before which an event stands."""
    number, stage = event.pass_no or 0, STAGE_OF.get(event.role, 0)
    if event.loop is not None:
        return number, stage
    # The run was in this pass: the role's own record of it was still to come, or, of Execute, that of the next one.
    if number == 0:
        return 0, 0
    return (number, stage) if stage else (number + 1, 0)


def _key(entry: Entry) -> tuple[object, ...]:
    return type(entry[2]), *entry[2][:3]  # loop, pass and part; or loop, first and last episode


class _Sentences:
    def __init__(self, units: int) -> None:
        self._units = units
        self._at: tuple[int, int] | None = None

    def entry(self, loop: int, number: int, stage: int, what: str | Swap | Dropped | Event) -> None:
        if isinstance(what, Event):
            self._event(what)
            return
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

    @staticmethod
    def _event(event: Event) -> None:
        stamp = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(event.time))
        where = f" (loop {event.loop}, pass {event.pass_no})"
        if event.loop is None:
            where = f" (in pass {event.pass_no})" if event.pass_no else ""
        print(f"Event     {stamp} UTC, {event.role} {event.kind}{where}: {event.text}")

    def flush(self) -> None:
        print(end="", flush=True)


class _JsonLines:
    def entry(self, loop: int, number: int, stage: int, what: str | Swap | Dropped | Event) -> None:
        if isinstance(what, str):
            print(what)
        elif isinstance(what, Event):
            self._event(what)
        elif isinstance(what, Swap):
            _, _, part, spec, handed_over, planned = what
            self._print(
                swap={"loop": loop, "pass": number, "part": part, "to": spec, "handed_over": handed_over,
                      "planned": planned}
            )  # fmt: skip
        else:
            self._print(dropped=what._asdict())

    def _event(self, event: Event) -> None:
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


def opened(folder: Path, follow: bool) -> Store:
    """Open the log of a run's folder for reading; if it is to be followed, wait for it, and say so.

    Raises
    ------
    ResultsError
        The folder has no log, or will never have one.
    """
    waits = False
    while True:
        there = os.path.exists(folder)
        path = log_of(folder) if there or not follow else None
        if path is not None:
            return Store(path, readonly=True)
        # A folder takes its name before there is anything in it.
        begun = there and (not follow or os.path.exists(folder / "manifest.json"))
        if begun and read_manifest(folder).get("kind") != "up":
            raise ResultsError(
                f"{folder} has the tables of a run, and no log of its records: `mapek up` and `mapek serve` write one. "
                "`mapek run CONFIG --show FROM:TO` prints records while it runs"
            )
        if not follow:
            raise ResultsError(f"{folder} has no log yet; --follow waits for it")
        if not waits:
            waits = True
            print(f"waiting for the log of {folder}", file=sys.stderr)
        time.sleep(LOOK_EVERY)  # until another process has made it


def config_in(store: Store, follow: bool) -> dict[str, Any] | None:
    """Return the config of a log's run; None where it is not written yet, unless the log is followed."""
    while (config := store.facts().get("config")) is None and follow:
        time.sleep(LOOK_EVERY)  # until another process has written it
    return config
