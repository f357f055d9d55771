"""Ctrl-C between passes: whoever stops a loop can go on with it."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType
from typing import Self


class CtrlC:
    """While it is entered, a Ctrl-C is heard by `check`, and at the end; a second one at once, wherever the program is.

    So it is in the main thread, and where nobody else has set how SIGINT is handled. Else nothing changes.

    Examples
    --------
    >>> try:
    ...     with CtrlC() as ctrl_c:
    ...         signal.raise_signal(signal.SIGINT)
    ...         print("this is still done")
    ...         ctrl_c.check()
    ...         print("and this no more")
    ... except KeyboardInterrupt:
    ...     print("stopped")
    this is still done
    stopped
    """

    def __init__(self) -> None:
        self._heard = self._set = False

    def __enter__(self) -> Self:
        ours = threading.current_thread() is threading.main_thread()
        if ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._hear)
            self._set = True
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self._set:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        if error is None:
            self.check()

    def check(self) -> None:
        """Raise KeyboardInterrupt if there was a Ctrl-C."""
        if self._heard:
            self._heard = False
            raise KeyboardInterrupt

    def _hear(self, number: int, frame: FrameType | None) -> None:
        if self._heard:
            raise KeyboardInterrupt
        self._heard = True
