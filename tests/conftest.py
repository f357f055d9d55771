"""What all tests share: Hypothesis' profile, a cache of compiled code that is not the user's, an end to every hang."""

import faulthandler
import importlib
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import pytest
from gymnasium.envs.registration import registry
from hypothesis import HealthCheck, settings

# pytest puts this folder on the path, where the folders `knowledge` and `mape` would be taken for the packages; the
# modules that stand beside the tests, such as `mape_runs`, are found whatever the import mode.
_HERE = Path(__file__).parent
sys.path[:] = [entry for entry in sys.path if Path(entry) != _HERE]
sys.path += [str(_HERE / folder) for folder in ("knowledge", "mape", "replay")]
for _package in ("knowledge", "managed_systems", "mape"):
    importlib.import_module(_package)

# Ctrl-C is heard, here and by the processes that tests start: what a shell starts in its background is deaf to it.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Each folder has a conftest.py, none of which --doctest-modules can import under the others' name.
collect_ignore_glob = ["conftest.py", "*/conftest.py"]

# One folder for all runs and workers: compiling the episode takes seconds, and its name holds a hash of the sources.
_CACHE = Path(tempfile.gettempdir(), f"mapek-test-cache-{os.getuid()}")
_CACHE.mkdir(mode=0o700, exist_ok=True)
os.environ["MAPEK_CACHE"] = str(_CACHE)

# The tokens of what tests listen on are not among the user's own either.
_RUNTIME = Path(tempfile.gettempdir(), f"mapek-test-runtime-{os.getuid()}")
_RUNTIME.mkdir(mode=0o700, exist_ok=True)
os.environ["XDG_RUNTIME_DIR"] = str(_RUNTIME)

settings.register_profile(
    "mapek",
    deadline=None,  # the first example of a compiled episode may have to compile it
    max_examples=60,
    derandomize="CI" in os.environ,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("mapek")

# A test that is out of time is failed by a signal, and the signal's handler is Python: it never runs where native code
# stands still, with the GIL or without. So many seconds later a thread of faulthandler's, which needs no GIL, says what
# every thread does and ends the process; xdist names the test, and goes on with another worker.
GRACE = 30.0
_STDERR = pytest.StashKey[int]()
_END = pytest.StashKey[float]()


def pytest_configure(config):
    config.stash[_STDERR] = os.dup(sys.__stderr__.fileno())  # while a test runs, pytest captures what goes there


def _end_by_itself_or_be_ended(item):
    left = max(GRACE, item.stash[_END] - time.monotonic())
    faulthandler.dump_traceback_later(left, exit=True, file=item.config.stash[_STDERR])


@pytest.hookimpl(tryfirst=True)
def pytest_timeout_set_timer(item, settings):
    item.stash[_END] = time.monotonic() + settings.timeout + GRACE
    _end_by_itself_or_be_ended(item)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_teardown(item):
    if _END in item.stash:  # pytest has called it off if the test failed, and a failed one hangs first of all
        _end_by_itself_or_be_ended(item)


@pytest.hookimpl(tryfirst=True)
def pytest_timeout_cancel_timer():
    faulthandler.cancel_dump_traceback_later()


@pytest.fixture
def own_folder(tmp_path, monkeypatch):
    """An empty current folder for modules of a user's own; they and their environments are forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    importlib.invalidate_caches()
    modules, environments = set(sys.modules), dict(registry)
    yield tmp_path
    registry.clear()
    registry.update(environments)
    for name in set(sys.modules) - modules:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(tmp_path)):
            del sys.modules[name]
