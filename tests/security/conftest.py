import shutil
import sys
import tempfile
from pathlib import Path

import pytest

from adapters.buses import certificates

# pytest imports test modules without a path to their neighbours; `security_deployment` is one.
sys.path.append(str(Path(__file__).parent))
sys.path.append(str(Path(__file__).parents[1] / "buses"))
sys.path.append(str(Path(__file__).parents[1] / "processes"))
sys.path.append(str(Path(__file__).parents[1] / "results"))

from security_deployment import Deployment


@pytest.fixture(scope="session")
def shared_keys(tmp_path_factory):
    """Keys that tests leave as they are."""
    folder = tmp_path_factory.mktemp("keys")
    certificates.make(folder)
    return folder


@pytest.fixture
def keys(shared_keys, tmp_path):
    """Keys that a test may spoil."""
    return Path(shutil.copytree(shared_keys, tmp_path / "keys"))


@pytest.fixture
def deployment(keys):
    with Deployment(keys) as running:
        yield running


@pytest.fixture
def here():
    """A folder whose path is short enough for a socket in it."""
    folder = Path(tempfile.mkdtemp(prefix="ms-"))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)
