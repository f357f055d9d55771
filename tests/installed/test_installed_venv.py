"""The wheel as people install it, from an empty folder and an empty home: what the first hour is made of."""

import os
import subprocess
import sys
import sysconfig
import venv
import zipfile

import pytest
from wheel_of_mapek import ROOT

pytestmark = pytest.mark.long

DEPENDENCIES = sysconfig.get_path("purelib")
"""Of this environment: nothing is fetched. Its own mapek, an editable one, is not found by a path alone."""


def pip(python, *arguments, **environment):
    install = [sys.executable, "-m", "pip", "--python", python, "install", "--no-index", "--no-deps", "-q"]
    done = subprocess.run(
        [*install, *map(str, arguments)],
        capture_output=True, text=True, timeout=240, env={**os.environ, **environment},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


class Installed:
    """A command, and the folder in which it is typed."""

    def __init__(self, command, folder, **environment):
        self.command, self.folder = command, folder
        home = folder / "home"
        home.mkdir()
        kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "MAPEK_CACHE")}
        self.environment = {**kept, "HOME": str(home), "MAPEK_CACHE": os.environ["MAPEK_CACHE"], **environment}

    def __call__(self, *arguments, code=0, start=None):
        done = subprocess.run(
            [*(start or self.command), *map(str, arguments)],
            cwd=self.folder, capture_output=True, text=True, timeout=240, env=self.environment,
        )  # fmt: skip
        assert done.returncode == code, done.stdout + done.stderr
        assert "Traceback" not in done.stderr
        return done.stdout + done.stderr


def an_environment(folder):
    venv.create(folder / "venv", with_pip=False)
    python = folder / "venv" / "bin" / "python"
    (site,) = (folder / "venv" / "lib").glob("python*/site-packages")
    # By this name before the file of an editable install, which needs them.
    (site / "_dependencies.pth").write_text(DEPENDENCIES)
    return python


@pytest.fixture
def fresh(wheel, tmp_path):
    python = an_environment(tmp_path)
    pip(python, wheel)
    return Installed([python.with_name("mapek")], tmp_path)


@pytest.fixture(params=["venv", "target", "user"])
def anyhow(request, wheel, tmp_path):
    """Installed into an environment, into a folder, or for the user beside the system's Python."""
    if request.param == "venv":
        return request.getfixturevalue("fresh")
    if request.param == "target":
        pip(sys.executable, "--target", tmp_path / "there", wheel)
        path = os.pathsep.join((str(tmp_path / "there"), DEPENDENCIES))
        return Installed([sys.executable, "-m", "mapek"], tmp_path, PYTHONPATH=path)
    base = sys._base_executable
    pip(base, "--user", "--break-system-packages", wheel, PYTHONUSERBASE=str(tmp_path / "user"))
    user = {"PYTHONUSERBASE": str(tmp_path / "user"), "PYTHONPATH": DEPENDENCIES}
    return Installed([tmp_path / "user" / "bin" / "mapek"], tmp_path, **user)


def test_the_paper_is_reproduced_however_it_was_installed(anyhow):
    said = anyhow("reproduce", "table1", "--trials", 2, "--no-figures", "-q", "--out", "table1")
    assert "Table 1 of arXiv 2601.20714, profile reference, 2 trials per agent" in said
    assert (anyhow.folder / "table1" / "result.json").exists()
    said = anyhow("run", "own_rule", "--set", "episodes=20", "--no-figures", "-q")
    assert "mape/examples/own_rule.toml" in said


def test_the_first_hour_in_an_empty_folder(fresh):
    assert "frozen_lake" in fresh("--help")
    assert "morphin" in fresh("list")
    assert "frozen_lake" in fresh("examples")
    assert "return:" in fresh("run", "frozen_lake", "--set", "episodes=50", "-q", "--out", "lake")
    assert (fresh.folder / "lake" / "figures" / "learning_curve.png").exists()
    assert "all kept" in fresh("check", "page_hinkley")
    shipped = [path for path in (ROOT / "examples").iterdir() if path.suffix in (".toml", ".py")]
    assert f"{len(shipped)} examples copied" in fresh("examples", "examples")
    python = fresh.command[0].with_name("python")
    for program in ("teach_a_pass", "swap_system", "machine"):
        assert fresh(f"examples/{program}.py", start=[python])
    said = fresh("up", "gridworld_goals", "--set", "episodes=40", "-q", "--no-figures", "--out", "goals")
    assert "Timeout" not in said
    (log,) = (line for line in said.splitlines() if line.startswith("log:"))
    assert log in fresh("run", "examples/gridworld_goals.toml", "--set", "episodes=40", "-q", "--no-figures")
    assert "no difference" in fresh("replay", "goals", "-q")


def test_another_projects_wheel_over_ours_is_told_and_an_installation_anew_is_the_way_out(fresh, wheel, tmp_path):
    python = fresh.command[0].with_name("python")
    theirs = tmp_path / "pymape-0.1.0-py3-none-any.whl"
    about = "pymape-0.1.0.dist-info"
    with zipfile.ZipFile(theirs, "w") as archive:
        archive.writestr("mape/__init__.py", "from fastapi_that_is_nowhere import FastAPI\n")
        archive.writestr(f"{about}/METADATA", "Metadata-Version: 2.1\nName: pymape\nVersion: 0.1.0\n")
        archive.writestr(f"{about}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        names = ("mape/__init__.py", *(f"{about}/{name}" for name in ("METADATA", "WHEEL", "RECORD")))
        archive.writestr(f"{about}/RECORD", "".join(f"{name},,\n" for name in names))
    pip(python, theirs)
    for arguments in (["--version"], ["list"], ["run", "frozen_lake"]):
        (line,) = fresh(*arguments, code=1).splitlines()
        assert "mape/__init__.py" in line
        assert "pymape 0.1.0" in line
    pip(python, "--force-reinstall", wheel)
    assert fresh("--version").startswith("mapek ")


def test_its_types_are_seen_by_a_type_checker(fresh):
    (fresh.folder / "mine.py").write_text(
        "import mape\nfrom adapters.results import read_episodes\nfrom knowledge import Knowledge\n"
        "reveal_type(mape.load('frozen_lake'))\nx: int = read_episodes('somewhere')\n"
    )
    checker = [sys.executable, "-m", "mypy", "--python-executable", fresh.command[0].with_name("python")]
    said = fresh("mine.py", start=checker, code=1)
    assert 'Revealed type is "mape.config.Config"' in said
    assert "Incompatible types in assignment" in said
    assert "Found 1 error" in said


def test_an_editable_installation_has_the_examples_of_its_checkout(tmp_path):
    """Nothing of the wheel's copy lands beside it, where a folder `mape` would be taken for the package."""
    python = an_environment(tmp_path)
    pip(python, "--no-build-isolation", "--editable", ROOT)
    fresh = Installed([python.with_name("mapek")], tmp_path)
    assert "examples/frozen_lake.toml" in fresh("run", "frozen_lake", "--set", "episodes=5", "-q", "--no-figures")
