"""The command line in this process, from an empty folder, without traces of one test in the next."""

import sys
from pathlib import Path

import pytest

from adapters.cli.main import main

# pytest imports test modules without a path to their neighbours; `command_line` is one.
sys.path.append(str(Path(__file__).parent))

from command_line import Mapek, Outcome

# With --doctest-modules pytest would import it a second time, under the name of another folder's.
collect_ignore = ["conftest.py"]


@pytest.fixture
def here(own_folder: Path) -> Path:
    """An empty current folder, whose modules and environments are forgotten afterwards."""
    return own_folder


@pytest.fixture
def mapek(here: Path, capsys: pytest.CaptureFixture[str]) -> Mapek:
    """Run a command line; return its exit code and what it printed."""

    def run(*arguments: object) -> Outcome:
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        said = capsys.readouterr()
        return Outcome(code, said.out, said.err)

    return run
