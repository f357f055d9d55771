"""A run with parts of the user's own: the folder keeps which version of them it is, and mixes no two."""

import hashlib
import json
import sys
from collections.abc import Callable
from pathlib import Path

import gymnasium
import pytest
from real_runs import contents, result_of, run
from replay_logs import edited

from adapters.cli.main import main

CONFIG = """\
name = "own"
episodes = 6

[system]
id = "mapek/Gridworld-v0"
options = { size = [3, 3], start = [0, 0], goals = [[2, 2]], max_steps = 10 }

[execute]
engine = "python"
"""
DETECTOR = """\
from mape.monitor.page_hinkley import PageHinkley

class Mine(PageHinkley):
    pass
"""
JUMPY = """
    def update(self, x):
        super().update(x)
        return True
"""
WATCHED = ("--set", 'monitor.detectors=["own_detector:Mine"]')
RUN = ("run", "own.toml", *WATCHED, "--no-figures", "-q", "--workers", "1")


@pytest.fixture
def here(own_folder: Path) -> Path:
    """A folder with a config and a detector, whose modules and environments are forgotten afterwards."""
    (own_folder / "own.toml").write_text(CONFIG)
    (own_folder / "own_detector.py").write_text(DETECTOR)
    return own_folder


def sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def modules_of(folder: Path) -> object:
    return json.loads((folder / "manifest.json").read_text())["modules"]


@pytest.mark.parametrize("again", [("resume", "out"), (*RUN, "--out", "out")], ids=["resume", "the same command"])
def test_a_run_whose_part_was_edited_meanwhile_is_not_gone_on_with_until_it_is_put_back(
    here: Path, stop: Callable[..., None], capsys: pytest.CaptureFixture[str], again: tuple[str, ...]
) -> None:
    assert main([*RUN, "--out", "undisturbed"]) == 0
    stop(*RUN, "--out", "out")
    edited = DETECTOR.replace("pass", "patience = 3")
    (here / "own_detector.py").write_text(edited)
    before = contents(here / "out")
    capsys.readouterr()

    assert main(list(again)) == 1

    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert f"module 'own_detector' ({here / 'own_detector.py'})" in said.err
    assert f"{sha256(DETECTOR)[:12]} then, {sha256(edited)[:12]} now" in said.err
    assert "choose another --out" in said.err
    assert contents(here / "out") == before
    (here / "own_detector.py").write_text(DETECTOR)
    assert main(list(again)) == 0
    assert result_of(here / "out") == result_of(here / "undisturbed")


def test_replay_names_the_modules_that_have_changed_where_it_finds_a_difference(
    here: Path, stop: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    stop(*RUN, "--out", "out")
    (here / "own_detector.py").write_text(DETECTOR.replace("pass", JUMPY))
    del sys.modules["own_detector"]
    assert main(["resume", "out", "--mended"]) == 0  # all passes were made before
    (here / "own_detector.py").write_text(last := DETECTOR.replace("pass", JUMPY + "    # once more\n"))
    del sys.modules["own_detector"]
    capsys.readouterr()

    assert main(["replay", "out", "-q"]) == 1

    said = capsys.readouterr().out
    assert "first difference: agent own, trial 0, episode" in said
    assert f"another version of module 'own_detector' ({here / 'own_detector.py'})" in said
    assert f"{sha256(last)[:12]} now" in said
    assert "module 'own_detector' was changed in the middle of the run" in said
    assert sha256(DETECTOR)[:12] in said

    assert main(["replay", "out", "-q", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["modules"]["own_detector"][1] == sha256(last)
    assert found["mended"] == [{"module": "own_detector", "sha256": sha256(DETECTOR)}]


def test_a_module_that_is_nowhere_any_more_is_said(
    here: Path, stop: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    stop(*RUN, "--out", "out")
    with edited(Path("out/manifest.json")) as manifest:
        manifest["modules"]["own_helper"] = sha256("gone")
    capsys.readouterr()

    assert main(["resume", "out"]) == 1
    assert "module 'own_helper'" in (said := capsys.readouterr().err)
    assert "nowhere now" in said


def test_an_older_manifest_keeps_no_modules_and_its_run_goes_on(here: Path, stop: Callable[..., None]) -> None:
    stop(*RUN, "--out", "out")
    with edited(Path("out/manifest.json")) as manifest:
        del manifest["modules"]

    assert main(["resume", "out"]) == 0


def test_what_is_installed_is_kept_as_a_version_and_not_as_a_module(here: Path) -> None:
    assert main(["run", "own.toml", "--no-figures", "-q", "--set", "monitor.detectors=['page_hinkley']", "--set",
                 "plan.schedule='mape.plan.constant:Constant'", "--out", "out"]) == 0  # fmt: skip

    assert modules_of(here / "out") == {}


def test_modules_of_all_agents_of_swaps_and_of_the_system_are_kept(here: Path) -> None:
    plan = "from mape.plan.morphin import Morphin\n\nclass Mine(Morphin):\n    pass\n"
    levers = (
        "import gymnasium\n"
        "from gymnasium.spaces import Discrete\n\n"
        "class Levers(gymnasium.Env):\n"
        "    observation_space, action_space = Discrete(1), Discrete(3)\n\n"
        "    def reset(self, *, seed=None, options=None):\n"
        "        super().reset(seed=seed)\n"
        "        return 0, {}\n\n"
        "    def step(self, action):\n"
        "        return 0, float(action), False, False, {}\n"
    )
    register = "import gymnasium\n\ngymnasium.register('OwnLevers-v0', 'own_levers:Levers', max_episode_steps=5)\n"
    for name, text in {"own_plan": plan, "own_levers": levers, "own_worlds": register}.items():
        (here / f"{name}.py").write_text(text)
    (here / "several.toml").write_text(
        'episodes = 6\nsystem = { id = "own_worlds:OwnLevers-v0" }\n'
        '[agents.one]\nswap = [{ pass = 3, part = "plan", to = "own_plan:Mine" }]\n'
        '[agents.two]\nmonitor = { detectors = ["own_detector:Mine"] }\n'
    )

    assert main(["compare", "several.toml", "--no-figures", "-q", "--trials", "2", "--out", "out"]) == 0

    assert gymnasium.spec("OwnLevers-v0").entry_point == "own_levers:Levers"
    assert modules_of(here / "out") == {
        "own_detector": sha256(DETECTOR),
        "own_levers": sha256(levers),
        "own_plan": sha256(plan),
        "own_worlds": sha256(register),
    }


PRODUCT = """
import numpy as np

VALUES = np.random.default_rng(0).standard_normal(200_001)

class Product(PageHinkley):
    def update(self, x):
        return super().update(x * float(VALUES @ VALUES))
"""


def test_a_part_that_multiplies_large_arrays_gives_the_same_bits_whatever_the_number_of_cores(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (here / "own_detector.py").write_text(DETECTOR + PRODUCT)
    product = ("--set", 'monitor.detectors=["own_detector:Product"]')
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)  # by default one for each core
    run(*RUN, *product, "--out", "default", cwd=here)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    run(*RUN, *product, "--out", "one", cwd=here)
    assert result_of(here / "default")["log_sha256"] == result_of(here / "one")["log_sha256"]
