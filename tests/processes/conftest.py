"""Lets the tests of this folder import what stands beside them, and gives each a folder whose path is short enough."""

import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from mape import registry

for _folder in (Path(__file__).parent, *(Path(__file__).parents[1] / name for name in ("buses", "results"))):
    sys.path.append(str(_folder))

# With --doctest-modules pytest would import it a second time, under the name of another folder's.
collect_ignore = ["conftest.py"]


@pytest.fixture
def here() -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix="mp-"))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(autouse=True)
def let_in_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let parts of a module `own`, which some tests make up, be asked for as those of a registered plug-in."""
    known = {**registry.PARTS["detector"], "own": registry.Entry("own:Any", "of the tests")}
    monkeypatch.setitem(registry.PARTS, "detector", known)


WALKS = """
import os
import time

from mape.analyze.changes import Changes


class Walks(Changes):
    def analyze(self, symptom):
        if os.path.exists(os.environ.get("WALK", "")):
            time.sleep(0.02)
        return super().analyze(symptom)
"""


class Walk:
    """An analyzer with which a run in processes goes at a walk: it is not over before what is to meet it."""

    part = "walks:Walks"

    def __init__(self, folder: Path) -> None:
        (folder / "walks.py").write_text(WALKS)
        self.path = folder / "walk"
        self.path.touch()

    def over(self) -> None:
        """Let the run go on at its own pace, and others after it."""
        self.path.unlink()


@pytest.fixture
def walk(here: Path, monkeypatch: pytest.MonkeyPatch) -> Walk:
    found = Walk(here)
    monkeypatch.setenv("WALK", str(found.path))
    monkeypatch.syspath_prepend(here)
    return found
