"""What the command line writes, without what a terminal would take for a command.

Texts of events, names of hosts, errors of parts: much that is printed was written elsewhere, and an escape sequence in
it could move the cursor, rename the window, or hide what follows. So whatever is printed goes through here.
"""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Iterable, Iterator
from typing import Any

# C0 without tab and line feed, DEL and C1; then what turns the direction of writing, or ends a line.
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def cleaned(text: str) -> str:
    r"""Return a text with each control character as its JSON escape, so that JSON stays the same JSON.

    >>> print(cleaned("\x1b[2Jgone"))
    \u001b[2Jgone
    """
    return _CONTROL.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


class Clean:
    """A stream of text that cleans what is written to it; in all else the stream that it is made of."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write a text, cleaned; return how long it was."""
        self.stream.write(cleaned(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write texts, cleaned."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextlib.contextmanager
def clean_streams() -> Iterator[None]:
    """Clean all that is printed on standard output and standard error."""
    with (
        contextlib.redirect_stdout(Clean(sys.stdout)),
        contextlib.redirect_stderr(Clean(sys.stderr)),
    ):
        yield
