"""So many lines a minute of what a process says, and of the rest the count; a program by itself.

Zenoh writes lines about each handshake that it refuses, and anybody may try as many as they like. What it says is
led through this program and not through a thread: one that wants Python's lock could not read while a thread that has
it waits for room in the pipe.
"""

import os
import select
import sys
import time

MINUTE = 60.0
LONGEST = 2000
"""Bytes that are kept of a line."""


def sieve(most: int, source: int, sink: int, minute: float = MINUTE) -> None:
    """Hand lines on from one file descriptor to another until the first ends.

    Parameters
    ----------
    most
        Lines that are handed on in each minute.
    source, sink
        File descriptors.
    minute
        Seconds.
    """
    left, more, over, rest = most, 0, 0.0, b""

    def tell() -> None:
        nonlocal more
        if more:
            os.write(sink, f"{more:,} more lines of Zenoh's within a minute, of which {most} are shown\n".encode())
        more = 0

    while True:
        if more and not select.select([source], [], [], max(0.0, over - time.monotonic()))[0]:
            tell()
        chunk = os.read(source, 1 << 16)
        if time.monotonic() >= over:
            tell()
            left, over = most, time.monotonic() + minute
        *lines, rest = (rest + chunk).split(b"\n")
        rest = rest[:LONGEST]
        if not chunk and rest:
            lines, rest = [*lines, rest], b""
        for line in lines[:left]:
            # A stranger chooses names in it, and a terminal may show it.
            said = line[:LONGEST].decode(errors="replace")
            os.write(sink, ("".join(c if c.isprintable() else "?" for c in said) + "\n").encode())
        more += max(0, len(lines) - left)
        left = max(0, left - len(lines))
        if not chunk:
            tell()
            return


if __name__ == "__main__":
    sieve(int(sys.argv[1]), 0, 1)
