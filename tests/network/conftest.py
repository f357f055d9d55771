"""Lets the tests of this folder import what stands beside them and beside the tests of the processes."""

import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

for _folder in (Path(__file__).parent, *(Path(__file__).parents[1] / name for name in ("processes", "results"))):
    sys.path.append(str(_folder))

# With --doctest-modules pytest would import it a second time, under the name of another folder's.
collect_ignore = ["conftest.py"]


@pytest.fixture
def here() -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix="mn-"))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)
