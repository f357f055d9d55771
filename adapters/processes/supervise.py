"""Starts the five processes of a run on this machine, watches them, and starts them again when they die.

Who died by a signal is started again at once. Where the system broke an episode off, Execute itself has begun it again
as often as the config says (`mape.execute.attempts`), and the run ends. Who ended with another error gets one more try,
for the error may have been the world's, and Execute one for each retry of the config besides, for it may have been the
system that ended the process; where it comes again at the same place, the run ends with it. So it does where
Knowledge fails again soon: with the disk full, each start of it makes room for a few passes more. Who is alive and says
nothing for too long is hung: it is killed, and started again. Execute speaks while it drives, however long an episode
takes, and ends itself where a step does not return.

All are started at once, and the roles hold until Knowledge, the one that was started here, has answered: at the same
place there may be that of another run.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

import zenoh

from adapters import private
from adapters.buses.messages import Status
from adapters.buses.wire import LEASE_MS, Wire
from adapters.roles import KNOWLEDGE, OPERATOR, ROLES
from knowledge import MalformedRecord
from mape.errors import BusError, ConfigError, MapekError

SYSTEM_FAILED = 4
"""Exit code of Execute where the system broke an episode off once too often: it is not started again over it."""

HUNG = 5
"""Exit code of an Execute in whose system a step did not return, and which may begin the episode again."""

LOOK_EVERY = 0.1
"""Seconds between two looks at the processes."""

STATUS_EVERY = 0.5
"""Seconds between two questions to Knowledge."""

ENDS_WITHIN = 1.5
"""Seconds that a process has to end after SIGTERM, before SIGKILL."""

STARTS_WITHIN = 30.0
"""Seconds that a process has for its start at least, before its silence counts."""

CRASHES = 10
"""So many deaths of one role without a pass in between, and the run is given up; of Execute, its retries more."""

KEEPS_FAILING = 60.0
"""Seconds within which a second error of Knowledge is the first one's, however many passes lie between."""

FRESH = 3.0
"""Seconds for which Knowledge's word on who is hung is believed."""

TOLD_AFTER = 15.0
"""Seconds after its start after which it is told that Knowledge cannot be reached."""

STOPPED_AFTER = LEASE_MS / 1000
"""Seconds from one look at the clock to the next after which this process is taken to have been stopped, as by Ctrl-Z.

Meanwhile it has heard nobody, and its link to Knowledge may be gone.
"""


class Failed(MapekError):
    """A process of the run failed in a way that another start does not mend."""


class Child:
    """One process of the run, over all its starts."""

    def __init__(self, role: str, command: Sequence[str], log: Path) -> None:
        self.role = role
        self.command = list(command)
        self.log = log
        self.starts = 0
        self.process: subprocess.Popen[bytes] | None = None
        self.started_at = 0.0
        self.place = 0.0, -1  # when it died first where it died last, and after how many passes that was
        self.deaths = 0  # there
        self.failures = 0  # those of them that were an end with an error
        self.failed_at = -math.inf
        self.hung = 0
        self.killed = False  # it may take a moment until it is gone
        self.released = False
        self.left_at: float | None = None  # when it was seen to have ended without an error
        self.done = False

    @property
    def pid(self) -> int:
        """Process id, 0 before the first start."""
        return 0 if self.process is None else self.process.pid

    @property
    def restarts(self) -> int:
        """How often it was started again."""
        return max(0, self.starts - 1)

    def start(self) -> None:
        """Start it, in a session of its own, so that Ctrl-C reaches the supervisor alone."""
        if self.process is not None and self.process.stdin is not None:
            self.process.stdin.close()
        with open(self.log, "ab", opener=private.opener) as log:
            self.process = subprocess.Popen(
                self.command, stdin=subprocess.PIPE, stdout=log, stderr=log, start_new_session=True
            )
        self.starts += 1
        self.killed = self.released = False
        self.left_at = None
        self.started_at = time.monotonic()

    def release(self) -> None:
        """Let it join; the time that it has for its start begins here."""
        if not self.released and self.process is not None and self.process.stdin is not None:
            self.released = True
            self.started_at = time.monotonic()
            with contextlib.suppress(BrokenPipeError):
                os.write(self.process.stdin.fileno(), b"\n")  # unbuffered: nothing is left for `close`

    def end(self) -> None:
        """Ask it to end."""
        if self.process is not None and self.process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                self.process.send_signal(signal.SIGCONT)  # a frozen one cannot hear
                self.process.terminate()

    def kill(self) -> None:
        """End it at once."""
        if self.process is not None and self.process.poll() is None:
            self.process.kill()

    def wait(self, timeout: float) -> None:
        """Wait until it has ended; kill it if it does not."""
        if self.process is None:
            return
        try:
            self.process.wait(max(0.0, timeout))
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        if self.process.stdin is not None:
            self.process.stdin.close()

    def said(self) -> str:
        """Return the last lines that it wrote."""
        with contextlib.suppress(OSError):
            return "\n".join(self.log.read_text(encoding="utf-8", errors="replace").splitlines()[-6:])
        return ""


class Supervisor:
    """The processes of one run.

    Parameters
    ----------
    wire
        Where they meet.
    commands
        Role -> command line; Knowledge's among them.
    logs
        Folder for what they write.
    hang_after
        Seconds after which a process that is alive and silent is taken for hung.
    retries
        How often the config has an episode begun again that the managed system breaks off.
    tell
        Told, as a sentence, what is done about a process.
    """

    def __init__(
        self,
        wire: Wire,
        commands: dict[str, list[str]],
        logs: Path,
        *,
        hang_after: float = 60.0,
        retries: int = 0,
        tell: Callable[[str], object] = lambda sentence: None,
    ) -> None:
        self.wire = wire
        self.hang_after = hang_after
        self.retries = retries
        self.tell = tell
        self.children = {role: Child(role, command, logs / f"{role}.log") for role, command in commands.items()}
        self.status: Status | None = None
        self._status_of = 0.0  # when it was asked for
        self._unreached = ""
        self._others = False  # whether another Knowledge answers in the place of ours
        self._told_unreached = False
        self._heard_at = 0.0
        self._asked_at = 0.0
        self._awake_at = 0.0
        self._listens_since = 0.0  # no silence began before
        self._passes = 0
        self._operator: zenoh.Session | None = None

    def __enter__(self) -> Self:
        for role in (KNOWLEDGE, *ROLES):
            self.children[role].start()
        return self

    def __exit__(self, *error: object) -> None:
        self._leave()
        for child in self.children.values():
            child.end()
        deadline = time.monotonic() + ENDS_WITHIN
        for child in self.children.values():
            child.wait(deadline - time.monotonic())

    def watch(self, tell: Callable[[Supervisor], object] = lambda supervisor: None) -> None:
        """Look after the processes until the run is complete and all have ended.

        Parameters
        ----------
        tell
            Called after each look.

        Raises
        ------
        Failed
            A process ended with an error twice, or dies again and again.
        ConfigError
            One of them could not make what the config names.
        """
        # Knowledge leaves last, and leaves only a complete run; who is killed on the way out has lost nothing.
        while not self.children[KNOWLEDGE].done:
            self._ask()  # first: what one knows from before a stop is nothing to judge by
            for child in self.children.values():
                self._look_at(child)
                if self._heard_at and child.role != KNOWLEDGE:
                    child.release()
            tell(self)
            time.sleep(LOOK_EVERY)  # a child may die, or Knowledge be silent: no one event tells of both

    def _look_at(self, child: Child) -> None:
        assert child.process is not None
        if child.done:
            return
        code = child.process.poll()
        if code is None:
            if not child.killed:
                self._is_hung(child)
            return
        if code == 0:
            child.left_at = child.left_at or time.monotonic()
            child.done = self._has_made_its_part(child)
            if child.done or self._status_of <= child.left_at:
                return  # in the second case, Knowledge is still to say
        if code == 2:
            raise ConfigError(_last_sentence(child))
        if code == SYSTEM_FAILED:
            raise Failed(_last_sentence(child))
        if child.role != KNOWLEDGE:
            self._ask(at_once=True)  # how far it came, Knowledge may have been told since it was asked last
        now = time.monotonic()
        if code == HUNG:
            self.tell(f"{child.role} (process {child.pid}) ended itself: {_last_sentence(child)} It is started again.")
            child.start()
            return
        if child.place[1] != self._passes:
            child.place, child.deaths, child.failures = (now, self._passes), 0, 0
        child.deaths += 1
        if code >= 0 and (again := self._again(child, now)):
            raise Failed(f"{child.role} failed {again}: {self._failure(child, code)}")
        if child.deaths >= CRASHES + self._retries_of(child):
            raise Failed(
                f"{child.role} died {child.deaths} times within {now - child.place[0]:.0f} s, without a pass in "
                f"between ({self._why(child, code)}): {_last_sentence(child)}"
            )
        child.start()

    def _has_made_its_part(self, child: Child) -> bool:
        """Whether a child that ended without an error was to end; Knowledge does only when all is complete."""
        if child.role == KNOWLEDGE or self.children[KNOWLEDGE].done:
            return True
        status = self.status
        return status is not None and status.roles[child.role].last_pass >= status.episodes

    def _again(self, child: Child, now: float) -> str:
        """Say in how far an error that came now is the last ones again; empty where the child gets another try."""
        apart, child.failed_at = now - child.failed_at, now
        child.failures += 1
        if child.failures > 1 + self._retries_of(child):
            return f"{'twice' if child.failures == 2 else f'{child.failures} times'} at the same place"
        return f"twice within {apart:.0f} s" if child.role == KNOWLEDGE and apart < KEEPS_FAILING else ""

    def _retries_of(self, child: Child) -> int:
        return self.retries if child.role == "execute" else 0

    @staticmethod
    def _failure(child: Child, code: int) -> str:
        said = _last_sentence(child)
        if code == 0:
            last = f" Its last words: {said}" if child.said().strip() else ""
            return f"it ended as if all were done, as code does that exits by itself.{last}"
        return said

    def _why(self, child: Child, code: int) -> str:
        if child.hung:
            return f"silent for {self.hang_after:g} s; if that is not long for it, give a longer --hang-after"
        return f"exit code {code}"

    def _is_hung(self, child: Child) -> None:
        now = self._now()
        # Nobody is heard while this process, or Knowledge, is not there to hear.
        silent = now - max(child.started_at, self._listens_since, self.children[KNOWLEDGE].started_at)
        if child.role == KNOWLEDGE:
            spoke = self._heard_at > child.started_at
            silent = min(silent, now - self._heard_at)
        else:
            role = None if self.status is None else self.status.roles.get(child.role)
            if role is None or now - self._heard_at > FRESH:
                return  # who is hung, Knowledge tells
            spoke = role.pid == child.pid  # else it has not joined since its start
            if spoke:
                silent = min(silent, role.beat_age or 0.0)
        if silent > (self.hang_after if spoke else max(self.hang_after, STARTS_WITHIN)):
            if child.role == KNOWLEDGE and child.hung and not self._heard_at:
                why = self._unreached or "it does not answer"
                raise Failed(f"{KNOWLEDGE} runs, and cannot be reached: {_sentence(why)}")
            child.hung += 1
            child.killed = True
            self.tell(
                f"{child.role} (process {child.pid}) was silent for {silent:.1f} s; it is killed and started again"
            )
            child.kill()

    def why_waiting(self) -> str:
        """Say for what the run waits, as far as that is known; of a Knowledge that is just starting, nothing."""
        if not self._heard_at:
            return self._unreached if self._others or self._told_unreached else ""
        for role, child in self.children.items():
            joined = None if self.status is None else self.status.roles.get(role)
            if joined is not None and not joined.alive and not child.done and child.said():
                return f"{role}: {_last_sentence(child)}"
        return ""

    def _ask(self, at_once: bool = False) -> None:
        now = self._now()
        if self._heard_at and not at_once and now - self._asked_at < STATUS_EVERY:
            return
        self._asked_at = now
        found: list[Status] = []
        try:
            if self._operator is None:
                self._operator = self.wire.join(OPERATOR, 0.2)
            found = ask_status(self._operator, self.wire, 0.5)
            self._others = bool(found)
            self._unreached = f"another Knowledge answers on {self.wire.endpoint}" if found else ""
        except BusError as error:
            self._unreached = str(error)
        ours = [status for status in found if status.pid == self.children[KNOWLEDGE].pid]
        if not ours:
            self._tell_unreached(now)
            return
        self.status = ours[0]
        self._status_of = now
        self._heard_at = self._now()
        self._passes = max(self._passes, self.status.passes)

    def _tell_unreached(self, now: float) -> None:
        started = self.children[KNOWLEDGE].started_at
        if self._unreached and not self._heard_at and not self._told_unreached and now - started > TOLD_AFTER:
            self._told_unreached = True
            self.tell(f"waiting since {now - started:.0f} s: {self._unreached}")

    def _now(self) -> float:
        now = time.monotonic()
        if now - self._awake_at > STOPPED_AFTER:
            self._listens_since = now
            self._leave()
        self._awake_at = now
        return now

    def _leave(self) -> None:
        operator, self._operator = self._operator, None
        if operator is not None:
            operator.close()  # type: ignore[no-untyped-call]


def ask_status(session: zenoh.Session, wire: Wire, timeout: float) -> list[Status]:
    """Return what each Knowledge that can be reached says of its run."""
    found = []
    for reply in session.get(wire.ask("status"), timeout=timeout):
        if reply.ok is not None:
            with contextlib.suppress(MalformedRecord):
                found.append(Status.unpack(reply.ok.payload.to_bytes())[0])
    return found


def _last_sentence(child: Child) -> str:
    lines = [line for line in child.said().splitlines() if line.strip()]
    told = [line.removeprefix("mapek: ") for line in lines if line.startswith("mapek: ")]
    text = told[-1] if told else (lines[-1] if lines else "it said nothing")
    return _sentence(text)


def _sentence(text: str) -> str:
    return text if text.endswith((".", "!", "?")) else f"{text}."


def command_of(role: str, config: Path, *options: str) -> list[str]:
    """Return the command line of a process; nothing in the present folder takes the place of what it imports."""
    return [sys.executable, "-P", "-m", "mape", "serve", str(config), "--role", role, "--leash", *options]
