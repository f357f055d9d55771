"""The checksums of a store's rows: each row has one, those of records hang together as chains, and all have a total.

A sum is a SHA-256 over the row's values, each with its type and length. That of a record is over the sum before it too:
of the record before of the same loop and stage. The total is the exclusive or of the sums of all rows; so a row that is
written or let go changes it by one operation, and a row that is missing, or there once too often, is told by it.
"""

from __future__ import annotations

import hashlib
from typing import Any

SIZE = 32
"""Bytes of a sum."""


def row_sum(table: str, values: tuple[Any, ...]) -> bytes:
    """Return the sum of a row of `table`; a bool counts as the integer that SQLite makes of it."""
    digest = hashlib.sha256(table.encode())
    for value in values:
        if isinstance(value, bytes):
            kind, data = "bytes", value
        else:
            value = int(value) if isinstance(value, bool) else value
            kind, data = type(value).__name__, str(value).encode("utf-8", "surrogateescape")
        digest.update(f"{kind} {len(data)} ".encode())
        digest.update(data)
    return digest.digest()


def record_sum(before: bytes, loop: int, number: int, stage: int, body: str, row: bytes | None) -> bytes:
    """Return the sum of a record that follows the one with the sum `before`, which is empty for the first."""
    data, packed = body.encode("utf-8", "surrogateescape"), b"" if row is None else row
    head = f"{loop} {number} {stage} {len(data)} {None if row is None else len(row)} "
    return hashlib.sha256(b"%b%b%b%b" % (before, head.encode(), data, packed)).digest()


def seal_sum(run: str, commits: int, total: bytes) -> bytes:
    """Return the sum of the row that seals a file: the total, after so many commits of a run."""
    return hashlib.sha256(b"%b %d %b" % (run.encode("utf-8", "surrogateescape"), commits, total)).digest()


def toggled(total: int, row: bytes) -> int:
    """Return the total with a row's sum put in, or taken out."""
    return total ^ int.from_bytes(row, "big")
