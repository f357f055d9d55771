"""The distributed loop as users start it: `mapek up`, or five times `mapek serve`, with doors to look into."""

import io
import itertools
import json
import os
import signal
import sqlite3
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Any, TypeVar

from real_runs import DEADLINE, MAPEK, run

from adapters.buses import Wire
from adapters.buses.messages import Status
from adapters.cli.main import main
from adapters.processes.supervise import ask_status
from adapters.stores import Store
from adapters.stores.sqlite_store import Event
from adapters.systems import make_system
from mape import load, run_trial
from mape.errors import MapekError

EXAMPLES = Path(__file__).parents[2] / "examples"
ROLES = ("knowledge", "monitor", "analyze", "plan", "execute")
SHORT = ("--no-figures", "-q")

T = TypeVar("T")


def until(condition: Callable[[], T], what: str, within: float = DEADLINE, every: float = 0.01) -> T:
    """Wait until a condition gives something that is true, and return it."""
    deadline, pause = time.monotonic() + within, threading.Event()
    while not (found := condition()):
        assert time.monotonic() < deadline, f"waited {within} s in vain for {what}"
        pause.wait(every)
    return found


def write_config(folder: Path, table: dict[str, Any], name: str = "config.json", engine: str | None = "python") -> Path:
    """Write a config; with an engine in the place of `auto`, as five processes take long to load what is compiled."""
    execute = table.get("execute", {})
    if engine is not None and execute.get("engine", "auto") == "auto":
        table = {**table, "execute": {**execute, "engine": engine}}
    path = folder / name
    path.write_text(json.dumps(table))
    return path


def endpoint(folder: Path, name: str = "k") -> str:
    return f"unixsock-stream/{folder}/{name}.sock"


def hashes(result: dict[str, Any]) -> list[tuple[str, str]]:
    return [(one["log_sha256"], one["q_table_sha256"]) for one in result["trials"]]


def alone(config: Path) -> list[tuple[str, str]]:
    """The hashes of a config of ready-made parts, run in this process."""
    loaded = load(config)
    units = itertools.product(range(loaded.trials), range(loaded.loops))
    found = [run_trial(loaded, trial, make_system, loop=loop) for trial, loop in units]
    return [(one.log_sha256, one.q_table_sha256) for one in found]


def run_here(config: Path, *options: str, code: int = 0, out: str = "run") -> dict[str, Any]:
    """What `mapek run` in one process makes of a config."""
    run("run", str(config), *options, "--out", out, *SHORT, cwd=config.parent, code=code)
    found: dict[str, Any] = json.loads((config.parent / out / "result.json").read_bytes())
    return found


class Started:
    """A command that was started; what it says goes to a file, so that no pipe can fill up."""

    def __init__(
        self, arguments: Sequence[str], cwd: Path, start: Sequence[str] = MAPEK, name: str = "process"
    ) -> None:
        self.said_in = cwd / f"{name}-{len(list(cwd.glob(f'{name}-*.said')))}.said"
        with open(self.said_in, "wb") as said:
            self.process = subprocess.Popen(
                [*start, *arguments],
                cwd=cwd,
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=said,
                start_new_session=True,
            )

    @property
    def pid(self) -> int:
        return self.process.pid

    @property
    def said(self) -> str:
        return self.said_in.read_text(errors="replace")

    @property
    def ended(self) -> bool:
        return self.process.poll() is not None

    def send(self, number: int) -> None:
        with suppress(ProcessLookupError):
            os.kill(self.pid, number)

    def end(self, code: int = 0, within: float = DEADLINE) -> str:
        """Wait until it has ended, which must be with `code`; return what it said."""
        try:
            ended_with = self.process.wait(within)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still runs after {within} s: {self.said[-2000:]}") from None
        assert ended_with == code, f"exit code {ended_with}: {self.said[-2000:]}"
        return self.said

    def signalled(self, number: int, within: float = DEADLINE) -> tuple[int, float]:
        """Send a signal; return the exit code, and how long the end took."""
        begun = time.monotonic()
        self.send(number)
        return self.process.wait(within), time.monotonic() - begun

    def close(self) -> None:
        self.send(signal.SIGCONT)
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        self.process.wait()


@contextmanager
def started(*arguments: str, cwd: Path, start: Sequence[str] = MAPEK, name: str = "process") -> Iterator[Started]:
    process = Started(arguments, cwd, start, name)
    try:
        yield process
    finally:
        process.close()


class Up:
    """A running `mapek up`; its children end with it, as their standard input is its pipe."""

    def __init__(self, process: Started, out: Path, endpoint: str) -> None:
        self.process = process
        self.out = out
        self.endpoint = endpoint

    @property
    def log(self) -> Path:
        return self.out / "log.sqlite"

    def children(self) -> dict[str, int]:
        """Role -> process id, of those who are there now."""
        return children_of(self.process.pid)

    def child(self, role: str) -> int:
        found = until(lambda: self.process.ended or self.children().get(role), f"{role} to be there")
        assert found is not True, f"the run is over: {self.process.said}"
        return found

    def passes(self) -> int:
        return passes(self.log)

    def wait_for_pass(self, number: int) -> None:
        until(lambda: self.process.ended or self.passes() >= number, f"pass {number}", every=0.005)

    def said_by(self, role: str) -> str:
        path = self.out / "logs" / f"{role}.log"
        return path.read_text(errors="replace") if path.exists() else ""

    def result(self, code: int = 0, within: float = DEADLINE) -> dict[str, Any]:
        """Wait for the end, and return what the run came to."""
        try:
            self.process.end(code, within)
        except AssertionError as error:
            logs = "\n".join(f"--- {role}\n{self.said_by(role)[-1500:]}" for role in ROLES)
            raise AssertionError(f"{error}\n{logs}") from None
        found: dict[str, Any] = json.loads((self.out / "result.json").read_bytes())
        return found


@contextmanager
def up(
    config: Path,
    *options: str,
    out: str = "up",
    start: Sequence[str] = MAPEK,
    at: str | None = None,
    short: Sequence[str] = SHORT,
) -> Iterator[Up]:
    cwd = config.parent
    where = at or endpoint(cwd, out)
    arguments = ("up", str(config), "--out", out, "--listen", where, *short, *options)
    with started(*arguments, cwd=cwd, start=start, name=out) as process:
        yield Up(process, cwd / out, where)


@contextmanager
def five(
    config: Path,
    where: str,
    *options: str,
    order: Sequence[str] = ROLES,
    out: str = "served",
    knowledge: Sequence[str] = (),
    start: Sequence[str] = MAPEK,
) -> Iterator[dict[str, Started]]:
    """Start the five processes by `mapek serve`, all at once, in an order."""
    with ExitStack() as opened:
        yield {
            role: opened.enter_context(serve(config, role, where, *options, *(knowledge if role == "knowledge" else ()),
                                             out=out, start=start))
            for role in order
        }  # fmt: skip


def end_all(served: dict[str, Started], within: float = DEADLINE) -> None:
    """Wait until all have ended, each with exit code 0."""

    def ended_or_failed() -> bool:
        codes = [process.process.poll() for process in served.values()]
        return None not in codes or any(codes)

    until(ended_or_failed, f"the end of {', '.join(f'{r} ({p.said[-300:]})' for r, p in served.items())}", within)
    for process in sorted(served.values(), key=lambda process: not process.process.poll()):
        process.end()  # first of whoever failed: the others may wait for it


@contextmanager
def serve(
    config: Path, role: str, where: str, *options: str, out: str = "served", start: Sequence[str] = MAPEK
) -> Iterator[Started]:
    edge = ("--listen", where, "--out", out, *SHORT) if role == "knowledge" else ("--connect", where)
    arguments = ("serve", str(config), "--role", role, *edge, *options)
    with started(*arguments, cwd=config.parent, start=start, name=f"{out}-{role}") as process:
        yield process


def children_of(parent: int) -> dict[str, int]:
    """Role -> process id of the processes that `parent` has started."""
    found = {}
    with suppress(OSError):
        for child in Path(f"/proc/{parent}/task/{parent}/children").read_text().split():
            with suppress(OSError, ValueError):
                words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
                found[words[words.index(b"--role") + 1].decode()] = int(child)
    return found


def resident(pid: int) -> int:
    """Bytes of memory that a process holds."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


# What stands on disk, beside the process that writes it.


@contextmanager
def store(log: Path) -> Iterator[Store]:
    with Store(log, readonly=True) as opened:
        yield opened


def passes(log: Path, loop: int = 0) -> int:
    """Finished passes that are on disk; 0 where the log has not begun."""
    return last(log, loop)[3]


def last(log: Path, loop: int = 0) -> tuple[int, int, int, int]:
    with suppress(MapekError, sqlite3.Error), store(log) as opened:
        return opened.last(loop)
    return 0, 0, 0, -1


def rows(log: Path, query: str) -> list[Any]:
    """Ask the file itself, as any SQLite tool can."""
    with closing(sqlite3.connect(f"file:{log}?mode=ro", uri=True)) as opened:
        return opened.execute(query).fetchall()


def records(log: Path) -> dict[int, int]:
    """Loop -> number of records that its log has."""
    return dict(rows(log, "SELECT loop, count(*) FROM records GROUP BY loop"))


def events(log: Path, kind: str | None = None) -> list[Event]:
    with store(log) as opened:
        return [event for event in opened.events() if kind in (None, event.kind)]


# What Knowledge says.


@contextmanager
def looking_on(where: str, system: str = "*") -> Iterator[Callable[[], Status | None]]:
    """Yield what asks Knowledge how the run is."""
    wire = Wire(where, system)
    session = wire.join("operator", DEADLINE)

    def ask() -> Status | None:
        found = ask_status(session, wire, 1.0)
        return found[0] if found else None

    try:
        yield ask
    finally:
        session.close()


def swap(running: Up, part: str, to: str, *options: str) -> tuple[int, str]:
    """Say `mapek swap` to a run, from this process; return the exit code and what it said."""
    return say("swap", part, to, "--connect", running.endpoint, *options)


def say(*arguments: str) -> tuple[int, str]:
    """Say a command in this process; return the exit code and what it said."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main(arguments)
    return code, out.getvalue() + err.getvalue()
