"""What a process may use is little: a sentence with the limit and the way out, and no traceback."""

import errno
import os
import shutil
import subprocess
import sys

import pytest
from command_line import EXAMPLES

from adapters.cli.limits import exhausted
from mape.errors import MapekError

resource = pytest.importorskip("resource")
MIB = 1 << 20
LIMITED = """
import os, resource, sys

kind, soft, hard = getattr(resource, sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
resource.setrlimit(kind, (soft, hard))
os.execv(sys.executable, [sys.executable, "-m", "mape", *sys.argv[4:]])
"""
GOALS = str(EXAMPLES / "gridworld_goals.toml")
MANY = ("run", GOALS, "--trials", "64", "--workers", "4", "--no-figures", "-q", "--out", "run")
SHORT = ("--set", "episodes=20", "--no-figures", "-q", "--out", "run")


def limited(here, kind, limit, *arguments, hard=None):
    start = [sys.executable, "-c", LIMITED, kind, str(limit), str(hard or limit)]
    return subprocess.run([*start, *arguments], cwd=here, capture_output=True, text=True, timeout=120)


def assert_told(done, *words):
    assert done.returncode in (1, 2), done.stderr
    assert "Traceback" not in done.stderr
    told = [line for line in done.stderr.splitlines() if line.startswith("mapek: ")]
    assert all(word in " ".join(told) for word in words), done.stderr


@pytest.mark.parametrize(
    ("kind", "limit", "arguments", "words"),
    [
        ("RLIMIT_NOFILE", 20, ("up", GOALS, *SHORT), ("20", "ulimit -n")),
        ("RLIMIT_NOFILE", 5, ("run", GOALS, *SHORT), ("5", "ulimit -n")),
        ("RLIMIT_NOFILE", 14, MANY, ("14", "ulimit -n", "resume")),
        ("RLIMIT_AS", 200 * MIB, ("run", GOALS, *SHORT), ("200 MiB", "ulimit -v")),
        (
            "RLIMIT_AS",
            600 * MIB,
            ("run", GOALS, "--set", "system.options={size=[4000,4000],goals=[[0,0],[8,8]],start=[4,4]}", *SHORT),
            ("600 MiB", "ulimit -v"),
        ),
    ],
)
def test_a_limit_is_named_with_the_way_out(here, kind, limit, arguments, words):
    assert_told(limited(here, kind, limit, *arguments), *words)


def test_a_soft_limit_is_raised_as_far_as_is_needed():
    code = "import resource; from adapters.cli.limits import obstacle; soft, hard = resource.getrlimit(7)\n"
    code += "resource.setrlimit(resource.RLIMIT_NOFILE, (20, 1000)); print(obstacle('up'))\n"
    code += "print(resource.getrlimit(resource.RLIMIT_NOFILE))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "None\n(40, 1000)\n", done.stderr


@pytest.mark.parametrize(
    ("error", "word"),
    [
        (OSError(errno.EMFILE, "Too many open files"), "ulimit -n"),
        (OSError(errno.ENFILE, "File table overflow"), "ulimit -n"),
        (MemoryError(), "ulimit -v"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "ulimit -v"),
        (ImportError("libllvmlite.so: failed to map segment from shared object"), "ulimit -v"),
        (RuntimeError("can't start new thread"), "ulimit -u"),
        (BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable"), "ulimit -u"),
    ],
)
def test_what_runs_out_is_recognised_as_a_cause_too(error, word):
    outer = MapekError("a part failed")
    outer.__cause__ = error
    hidden = MapekError("somebody else writes")
    hidden.__context__, hidden.__suppress_context__ = error, True
    assert word in exhausted(error)
    assert word in exhausted(outer)
    assert exhausted(hidden) is None
    assert exhausted(ValueError("no number")) is None


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_run_needs_no_standard_stream(here, closed):
    command = f"exec {sys.executable} -m mape run {GOALS} {' '.join(SHORT)} {closed}"
    done = subprocess.run(["sh", "-c", command], cwd=here, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert (here / "run" / "result.json").exists()


def test_workers_without_shared_memory_are_refused_with_a_way_out(here):
    alone = ["unshare", "-m", "sh", "-c", 'mount -t tmpfs -o ro none /dev/shm && exec "$@"', "sh"]
    able = os.path.isdir("/dev/shm") and shutil.which("unshare")
    if not able or subprocess.run([*alone, "true"], capture_output=True).returncode:
        pytest.skip("nobody may mount here")
    command = [sys.executable, "-m", "mape", *MANY]
    done = subprocess.run([*alone, *command], cwd=here, capture_output=True, text=True, timeout=120)
    assert_told(done, "/dev/shm", "--workers 1")
