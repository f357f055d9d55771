"""What all tests share: Hypothesis' profile, and a cache of compiled code that is not the user's."""

import importlib
import os
import sys
import tempfile
from pathlib import Path

from hypothesis import HealthCheck, settings

# pytest puts this folder on the path, where the folders `knowledge` and `mape` would be taken for the packages; the
# modules that stand beside the tests, such as `mape_runs`, are found whatever the import mode.
_HERE = Path(__file__).parent
sys.path[:] = [entry for entry in sys.path if Path(entry) != _HERE]
sys.path += [str(_HERE / folder) for folder in ("knowledge", "mape", "replay")]
for _package in ("knowledge", "managed_systems", "mape"):
    importlib.import_module(_package)

# Each folder has a conftest.py, none of which --doctest-modules can import under the others' name.
collect_ignore_glob = ["conftest.py", "*/conftest.py"]

# One folder for all runs and workers: compiling the episode takes seconds, and its name holds a hash of the sources.
_CACHE = Path(tempfile.gettempdir(), f"mapek-test-cache-{os.getuid()}")
_CACHE.mkdir(mode=0o700, exist_ok=True)
os.environ["MAPEK_CACHE"] = str(_CACHE)

settings.register_profile(
    "mapek",
    deadline=None,  # the first example of a compiled episode may have to compile it
    max_examples=60,
    derandomize="CI" in os.environ,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("mapek")
