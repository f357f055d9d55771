"""What the tests of this folder share; and lets them import what stands beside them."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from adapters.cli.main import main
from adapters.results import RunFolder
from mape.errors import ResultsError

sys.path.append(str(Path(__file__).parent))

# With --doctest-modules pytest would import it a second time, under the name of another folder's.
collect_ignore = ["conftest.py"]


@pytest.fixture
def stop(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Run a command that stops before its tables are made."""

    def run_until_then(*command: str) -> None:
        def fail(folder: RunFolder, agent: str) -> None:
            raise ResultsError("stopped here")

        with monkeypatch.context() as context:
            context.setattr(RunFolder, "assemble", fail)
            assert main(list(command)) == 1

    return run_until_then
