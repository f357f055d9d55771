"""Lets the tests of this folder import what stands beside them, and gives each a folder with a plant in it."""

import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

for _folder in (
    Path(__file__).parent,
    *(Path(__file__).parents[1] / name for name in ("buses", "processes", "results")),
):
    sys.path.append(str(_folder))

# With --doctest-modules pytest would import it a second time, under the name of another folder's.
collect_ignore = ["conftest.py"]


@pytest.fixture
def here() -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix="mp-"))
    shutil.copy(Path(__file__).parent / "pump.py", folder)
    yield folder
    shutil.rmtree(folder, ignore_errors=True)
