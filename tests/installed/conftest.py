"""One wheel for all tests of a worker."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent))

from wheel_of_mapek import build, unpack

collect_ignore = ["conftest.py"]


@pytest.fixture(scope="session")
def wheel(tmp_path_factory):
    return build(tmp_path_factory.mktemp("wheel"))


@pytest.fixture
def site(wheel, tmp_path):
    """A folder that holds what the wheel installs."""
    return unpack(wheel, tmp_path / "site")


@pytest.fixture
def empty(tmp_path):
    folder = tmp_path / "empty"
    folder.mkdir()
    return folder
