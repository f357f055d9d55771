"""Findings, and the clauses that all parts share: determinism, and state that is taken up."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, NamedTuple

from knowledge import (
    Record,
    from_json,
    to_json,
)
from mape.errors import PartError
from mape.states import faults


class Finding(NamedTuple):
    """What became of one clause; `detail` says what is violated and how to mend it.

    A ``"note"`` breaks no contract, but takes something away, such as the resuming of a run.
    """

    check: str
    verdict: Literal["ok", "note", "failed"]
    detail: str = ""

    def __str__(self) -> str:
        return f"{self.verdict:<7} {self.check}" + (f": {self.detail}" if self.detail else "")


class Broken(Exception):
    """A clause does not hold; the text says which, and the way out."""


class Noted(Exception):
    """A clause holds in a lesser way."""


Clause = tuple[str, Callable[[], None]]
Feed = Callable[[Sequence[Any], int], list[Any]]
"""Puts several parts through step i of a script and returns the reading of each."""
Script = Callable[[], Feed]
"""Begins a script anew."""


def require(findings: Iterable[Finding]) -> None:
    """Raise on the findings that failed.

    Raises
    ------
    PartError
        Holds all of them, one a line.
    """
    failed = [str(finding) for finding in findings if finding.verdict == "failed"]
    if failed:
        raise PartError("\n".join(failed))


def judge(make: Callable[[], Any], members: str, clauses: Sequence[Clause]) -> list[Finding]:
    """Put parts through all clauses, and return what became of each."""

    def has_members() -> None:
        part = make()
        for member in members.split():
            name = member.removesuffix("()")
            if not hasattr(part, name):
                raise Broken(f"{type(part).__name__} has no {member}; see its contract in mape.ports")
            if member != name and not callable(getattr(part, name)):
                raise Broken(f"{name} is {getattr(part, name)!r}, not a method; see its contract in mape.ports")

    findings = [outcome("has the members of the port", has_members)]
    if findings[0].verdict == "failed":
        return findings  # the other clauses would only say so again
    return findings + [outcome(*clause) for clause in clauses]


def outcome(check: str, clause: Callable[[], None]) -> Finding:
    """Turn one clause into a finding."""
    try:
        clause()
    except Broken as broken:
        return Finding(check, "failed", str(broken))
    except Noted as note:
        return Finding(check, "note", str(note))
    except faults() as error:
        text = f": {error}" if str(error) else ""
        return Finding(check, "failed", f"{type(error).__name__} was raised{text}")
    return Finding(check, "ok")


def resumable(make: Callable[[], Any], script: Script, steps: int) -> list[Clause]:
    """Return the clauses that hold for every part with a state."""

    def deterministic() -> None:
        feed, pair = script(), (make(), make())
        for i in range(steps):
            first, second = feed(pair, i)
            if first != second:
                raise Broken(
                    f"at step {i} two fresh ones give {first} and {second}; seed what is random, share nothing "
                    "between objects, and leave clock, hash order and global state alone"
                )

    def plain() -> None:
        feed, part = script(), make()
        for i in range(steps):
            before = part.state()
            text = plain_json(before)
            feed((part,), i)
            if plain_json(before) != text:
                raise Broken(f"step {i} changed a state that was given before it; state() returns a copy")

    def takes_up() -> None:
        for used, cut in enumerate((0, 1, steps // 3, steps // 2, steps - 2)):
            feed, part, heir = script(), make(), make()
            for i in range(cut):
                feed((part,), i)
            if used % 2:
                past = script()
                for i in range(cut // 2 + 3):
                    past((heir,), i)
            heir.restore(json.loads(plain_json(part.state())))
            told = "used" if used % 2 else "fresh"
            for i in range(cut, steps):
                given, restored = feed((part, heir), i)
                if given != restored:
                    raise Broken(
                        f"a {told} one restored before step {cut} gives {restored} at step {i}, the original {given}; "
                        "state() holds all that update, advance or plan write, and restore() sets all of it"
                    )
            if plain_json(part.state()) != plain_json(heir.state()):
                raise Broken(f"a {told} one restored before step {cut} ends in another state than the original")

    return [
        ("is deterministic: two fresh ones agree, step by step", deterministic),
        ("gives its state as plain JSON, and as a copy", plain),
        ("takes up where its state was given, fresh or used", takes_up),
    ]


def plain_json(state: Any) -> str:
    """Return a state as JSON text; a clause is broken where it is none."""
    way_out = "use None, bool, int, float, str, list and dict with text as keys"
    try:
        text = json.dumps(state, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise Broken(f"state() is no plain JSON: {error}; {way_out}") from error
    if json.loads(text) != state:
        raise Broken(f"state() comes back from JSON as something else: {state!r}; {way_out}")
    return text


def walk(make: Callable[[], Any], script: Script, steps: int) -> Callable[[], None]:
    """Return a clause that puts one part through the script, whose feed says what it must not give."""

    def clause() -> None:
        feed, part = script(), make()
        for i in range(steps):
            feed((part,), i)

    return clause


def finite(value: Any) -> bool:
    """Whether a value is a finite number, and no bool."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def travels(record: Record) -> None:
    """Let a record go over the wire and back."""
    try:
        again = from_json(to_json(record))
    except (TypeError, ValueError) as error:
        raise Broken(f"{record} cannot be sent: {error}; use tuples of plain int and float") from error
    if again != record:
        raise Broken(f"{record} arrives as {again}; use tuples of plain int and float")


def stream_of(*stretches: tuple[float, float, int]) -> tuple[float, ...]:
    """Return normal values in stretches of (mean, deviation, length), from a fixed seed."""
    rng = random.Random(1954)
    return tuple(round(rng.gauss(level, spread), 6) for level, spread, count in stretches for _ in range(count))
