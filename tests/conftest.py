"""What all tests share: Hypothesis' profile, and a cache of compiled code that is not the user's."""

import os
import sys
import tempfile
from pathlib import Path

from hypothesis import HealthCheck, settings

# pytest imports test modules without a path to their neighbours, such as `mape_runs`.
sys.path += [str(Path(__file__).parent / folder) for folder in ("knowledge", "mape")]

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
