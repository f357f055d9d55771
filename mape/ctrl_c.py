"""Ctrl-C between passes: whoever stops a loop can go on with it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Self

SAID_AFTER = 1.0
"""Seconds after a Ctrl-C after which it is said for what the program waits."""

on_wait: list[Callable[[str], object]] = []
"""Called with a sentence where a Ctrl-C was heard and what is at work does not come to its end."""


class CtrlC:
    """While it is entered, a Ctrl-C is heard by `check`, and at the end; a second one at once, wherever the program is.

    So it is in the main thread, and where nobody else has set how SIGINT is handled. Else nothing changes: within
    another one it is that one which hears.

    Parameters
    ----------
    waits_for
        Says as a clause what is at work, for `on_wait`.

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

    def __init__(self, waits_for: Callable[[], str] = lambda: "what is at work") -> None:
        self._heard = self._set = False
        self._waits_for = waits_for
        self._say: threading.Timer | None = None
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
        if self._say is not None:
            self._say.cancel()
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
        self._say = threading.Timer(SAID_AFTER, self._tell)
        self._say.daemon = True
        self._say.start()

    def _tell(self) -> None:
        if self._heard:
            for tell in on_wait:
                tell(f"waiting for {self._waits_for()}; Ctrl-C again ends it at once")
