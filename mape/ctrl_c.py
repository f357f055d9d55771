"""Ctrl-C between passes: whoever stops a loop can go on with it."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType
from typing import Self


class CtrlC:
    """While it is entered, a Ctrl-C is heard by `check`, and at the end; a second one at once, wherever the program is.

    So it is in the main thread, and where nobody else has set how SIGINT is handled. Else nothing changes: within
    another one it is that one which hears.

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
        self._outer: CtrlC | None = None

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            handler = signal.getsignal(signal.SIGINT)
            if handler is signal.default_int_handler:
                signal.signal(signal.SIGINT, self._hear)
                self._set = True
            elif isinstance(outer := getattr(handler, "__self__", None), CtrlC):
                self._outer = outer
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self._set:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        if error is None:
            self.check()

    @property
    def heard(self) -> bool:
        """Whether there was a Ctrl-C that is still to be raised, by this one or by that around it."""
        return self._heard or (self._outer is not None and self._outer.heard)

    def check(self) -> None:
        """Raise KeyboardInterrupt if there was a Ctrl-C."""
        if self._heard:
            self._heard = False
            raise KeyboardInterrupt

    def _hear(self, number: int, frame: FrameType | None) -> None:
        if self._heard:
            raise KeyboardInterrupt
        self._heard = True
