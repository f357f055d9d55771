"""The certificate of one's own role as it lies on disk while the run goes on: when it ends, whether it was renewed."""

from __future__ import annotations

import logging
import time
from datetime import UTC, datetime
from pathlib import Path

from adapters.buses import security
from mape.errors import ConfigError

logger = logging.getLogger(__name__)

WARNED_DAYS = 14
"""Days before its end from which on a certificate is warned of; of one that is good for less, a tenth of its life."""

DAY = 86_400.0


class OwnKeys:
    """The files of a role's keys.

    Parameters
    ----------
    folder, role
        As `security.tls` takes them, which has found them in order.
    """

    def __init__(self, folder: Path, role: str) -> None:
        self._folder = folder
        self._role = role
        self._files = (security.authority_of(folder), *(folder.absolute() / f"{role}{end}" for end in (".pem", ".key")))
        self._used = self._refused = self._stamp()
        self._dates = security.dates(folder, role)
        self._told = ""

    def renewed(self, now: float | None = None) -> bool:
        """Say what is to be said of the certificate, once; return whether others lie there now, which are in order.

        Parameters
        ----------
        now
            Seconds since the epoch; by default the clock's.
        """
        stamp = self._stamp()
        if stamp != self._used and stamp != self._refused:
            try:
                self._dates = security.dates(self._folder, self._role)
            except ConfigError as error:  # they are replaced one after the other
                self._refused = stamp
                self._tell(f"the keys were replaced, and cannot be used so: {error}")
                return False
            self._used = stamp
            self._tell(f"goes on with the renewed keys of {self._folder}")
            return True
        self._look_at_dates(time.time() if now is None else now)
        return False

    def _look_at_dates(self, now: float) -> None:
        for path, begin, end in self._dates:
            on = f"{datetime.fromtimestamp(end, UTC):%Y-%m-%d %H:%M:%S} UTC"
            if path == self._files[0]:
                way_out = "Make all keys anew, in a new folder, for the next run"
            else:
                way_out = (
                    f"Renew it where {security.AUTHORITY}.key is: `mapek keys {self._folder} --renew {self._role}`; "
                    "who runs goes on with the new files by itself"
                )
            if now >= end:
                self._tell(f"{path} ended on {on}, and nobody lets {self._role} in with it. {way_out}")
            elif now >= end - min(WARNED_DAYS * DAY, (end - begin) / 10):
                self._tell(f"{path} ends on {on}. {way_out}")

    def _tell(self, sentence: str) -> None:
        if sentence != self._told:
            self._told = sentence
            logger.warning("%s: %s", self._role, sentence)

    def _stamp(self) -> tuple[tuple[int, int, int], ...]:
        found = []
        for path in self._files:
            try:
                at = path.stat()
                found.append((at.st_ino, at.st_mtime_ns, at.st_size))
            except OSError:
                found.append((0, 0, 0))
        return tuple(found)
