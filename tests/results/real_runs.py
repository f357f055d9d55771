"""`mapek run` as a real process, which can be killed, interrupted, and given little room."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from adapters.results.chunk import read_chunk
from adapters.results.folder import read_manifest
from mape.config import from_table
from mape.trials import TrialResult

FROZEN_LAKE = Path(__file__).parents[2] / "examples" / "frozen_lake.toml"
MAPEK = (sys.executable, "-m", "mape")
MANY = (
    "run", str(FROZEN_LAKE), "--set", "episodes=400", "--trials", "16", "--workers", "2", "--no-figures", "-q",
)  # fmt: skip
"""16 chunks of one trial each, which take some seconds."""
DEADLINE = 90.0


def contents(folder: Path) -> dict[str, str]:
    """Every file below a folder, by name, with the hash of its bytes."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def finished_chunks(out: Path) -> list[Path]:
    return sorted(out.glob("chunks/*/*.json"))


def leftovers(out: Path) -> list[str]:
    return [str(path) for path in out.rglob("*.part")]


def result_of(out: Path) -> dict[str, Any]:
    """The result of a finished run, without the command line that differs."""
    found: dict[str, Any] = json.loads((out / "result.json").read_bytes())
    for name in ("command", "sha256"):
        del found[name]
    return found


def results_in(chunk: Path) -> list[TrialResult] | None:
    """The results of a chunk, named by its JSON."""
    (config,) = read_manifest(chunk.parents[2])["agents"].values()
    return read_chunk(chunk.with_suffix(""), from_table(config))


def run(*arguments: str, cwd: Path, code: int = 0, start: tuple[str, ...] = MAPEK) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, which must be with `code`."""
    done = subprocess.run([*start, *arguments], cwd=cwd, capture_output=True, text=True, timeout=DEADLINE, check=False)
    assert done.returncode == code, done.stderr
    return done


def little_room(most_bytes: int) -> tuple[str, ...]:
    """Start `mapek` where no file can grow beyond `most_bytes`, as on a full disk."""
    return (
        sys.executable,
        "-c",
        "import resource, sys\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({most_bytes}, {most_bytes}))\n"
        "from adapters.cli.main import main\n"
        "if __name__ == '__main__': sys.exit(main())",
    )


@contextmanager
def running(*arguments: str, cwd: Path) -> Iterator["subprocess.Popen[str]"]:
    """Start a command in a process group of its own, of which nothing outlives the block."""
    with subprocess.Popen(
        [*MAPEK, *arguments], cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            yield process
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def wait_for_a_chunk(process: "subprocess.Popen[str]", out: Path) -> None:
    """Wait until the first chunk is on disk; the run must not be over by then."""
    deadline = time.monotonic() + DEADLINE
    while not finished_chunks(out):
        assert time.monotonic() < deadline
        try:
            process.wait(0.005)
        except subprocess.TimeoutExpired:
            continue
        raise AssertionError(f"the run ended by itself: {process.communicate()}")


def children_of(process: int) -> set[int]:
    """Processes that were started by `process`."""
    return {int(child) for child in Path(f"/proc/{process}/task/{process}/children").read_text().split()}


def wait_until_gone(processes: set[int]) -> None:
    """Wait until no process of these runs any more; one that nobody has waited for yet counts as gone."""
    deadline = time.monotonic() + DEADLINE
    pause = threading.Event()
    while any(_runs(process) for process in processes):
        assert time.monotonic() < deadline, f"{processes} are still there"
        pause.wait(0.005)


def _runs(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
