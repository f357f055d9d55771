"""Configs by bare names: which file is taken, from where, and that it is said; and the examples, copied."""

import re
from pathlib import Path

import pytest
from command_line import EXAMPLES, Mapek, contents

from adapters.results import read_episodes
from adapters.systems import make_system
from mape import ConfigError, load, run_trial
from mape.config_files import examples, find_config, shipped

QUIETLY = ("--no-figures", "-q", "--workers", 1)
OWN = 'name = "own"\nepisodes = 3\nsystem = { id = "FrozenLake-v1" }\n'


def test_a_bare_name_finds_an_example_from_anywhere_and_which_file_it_is_is_said_once(mapek: Mapek) -> None:
    outcome = mapek("run", "frozen_lake", "--set", "episodes=12", *QUIETLY, "--out", "bare")
    named = mapek("run", EXAMPLES / "frozen_lake.toml", "--set", "episodes=12", *QUIETLY, "--out", "named")

    assert (outcome.code, named.code) == (0, 0)
    assert outcome.err == f"frozen_lake is {EXAMPLES / 'frozen_lake.toml'}\n"
    assert named.err == ""
    returns = [read_episodes(f"{name}/episodes-frozen_lake.npz")["return"].tobytes() for name in ("bare", "named")]
    assert returns[0] == returns[1]


def test_what_stands_here_goes_before_what_is_shipped_and_the_very_name_before_the_suffix(
    mapek: Mapek, here: Path
) -> None:
    (here / "frozen_lake.toml").write_text(OWN)
    outcome = mapek("run", "frozen_lake", *QUIETLY)
    assert (outcome.code, outcome.err) == (0, "frozen_lake is frozen_lake.toml\n")
    assert "own: FrozenLake-v1" in outcome.out

    (here / "frozen_lake").write_text(OWN.replace("own", "bare"))
    outcome = mapek("run", "frozen_lake", *QUIETLY)
    assert (outcome.code, outcome.err) == (0, "")
    assert "bare: FrozenLake-v1" in outcome.out


def test_a_folder_of_that_name_is_no_config(mapek: Mapek, here: Path) -> None:
    (here / "taxi").mkdir()
    assert find_config("taxi") == EXAMPLES / "taxi.toml"
    (here / "own").mkdir()
    outcome = mapek("run", "own", *QUIETLY)
    assert (outcome.code, outcome.out) == (2, "")
    assert "'own' cannot be read" in outcome.err


def test_a_name_with_a_suffix_or_a_folder_is_no_example(here: Path) -> None:
    for name in ("taxi.toml", "elsewhere/taxi", "taxi.json"):
        with pytest.raises(ConfigError, match=re.escape(f"no config file '{name}'")):
            find_config(name)
    (here / "elsewhere").mkdir()
    (here / "elsewhere" / "taxi.toml").write_text(OWN)
    assert find_config("elsewhere/taxi") == Path("elsewhere/taxi.toml")


def test_a_config_extends_an_example_or_its_neighbour_by_a_bare_name(here: Path) -> None:
    (here / "below").mkdir()
    (here / "below" / "mine.toml").write_text('extends = "frozen_lake"\nepisodes = 7\n')
    assert load("below/mine").episodes == 7
    assert load("below/mine").system == load("frozen_lake").system
    (here / "below" / "frozen_lake.toml").write_text(OWN)
    assert load("below/mine").name == "own"


def test_every_command_takes_a_bare_name(mapek: Mapek, monkeypatch: pytest.MonkeyPatch) -> None:
    few = ("--set", "episodes=4")
    compared = mapek("compare", "frozen_lake", "cliff_walking", "--trials", 2, *few, *QUIETLY)
    assert compared.code == 0, compared.err
    assert len(compared.err.splitlines()) == 2
    checked = mapek("check", "frozen_lake", "--profile", "tabulated")
    assert checked.code == 0, checked.out
    monkeypatch.setattr("builtins.input", lambda prompt: "q")
    assert mapek("step", "frozen_lake").code == 0


def test_a_run_that_was_begun_by_a_bare_name_goes_on_from_elsewhere(
    mapek: Mapek, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = ("run", "frozen_lake", "--trials", 2, "--set", "episodes=5", *QUIETLY)
    whole = mapek(*line, "--out", "whole", "--json", "-").json
    mapek(*line, "--out", "begun")
    (here / "begun" / "result.json").unlink()
    (here / "elsewhere").mkdir()
    monkeypatch.chdir(here / "elsewhere")
    resumed = mapek("resume", "../begun")
    assert resumed.code == 0, resumed.err
    assert whole["log_sha256"] in resumed.out


def test_parts_that_examples_name_are_found_wherever_the_example_is_used(mapek: Mapek, here: Path) -> None:
    outcome = mapek("run", "own_rule", "--set", "episodes=5", *QUIETLY)
    assert outcome.code == 0, outcome.err
    assert mapek("check", "swap_detector:Failures").code == 0
    assert run_trial(load("own_rule", overrides=["episodes=5"]), 0, make_system).log_sha256 in outcome.out


def test_a_module_here_goes_before_that_of_an_example(mapek: Mapek, here: Path) -> None:
    assert mapek("check", "swap_detector:Failures").code == 0
    (here / "swap_planner.py").write_text("class Ours:\n    direction = statistic = update = reset = None\n")
    assert "Ours" in mapek("check", "swap_planner:Gentle").err


def test_the_examples_are_listed_with_what_they_are(mapek: Mapek) -> None:
    outcome = mapek("examples")
    assert (outcome.code, outcome.err) == (0, "")
    about = dict(line.split(maxsplit=1) for line in outcome.out.splitlines() if "  " in line)
    assert set(about) == {*shipped(), *(path.name for path in EXAMPLES.glob("*.py"))}
    assert about["frozen_lake"] == load("frozen_lake").description
    assert about["teach_a_pass.py"] == "One pass of the loop, by hand: who says what to whom."


def test_the_examples_are_copied_and_nothing_is_overwritten(mapek: Mapek, here: Path) -> None:
    (here / "new" / "deep").mkdir(parents=True)
    (here / "new" / "deep" / "taxi.toml").write_text("my own")
    outcome = mapek("examples", "new/deep")
    assert outcome.code == 1
    assert "files of its own called taxi.toml" in outcome.err
    expected = {name: digest for name, digest in contents(examples()).items() if Path(name).suffix in (".toml", ".py")}
    copied = contents(here / "new" / "deep")
    assert copied.pop("taxi.toml") != expected.pop("taxi.toml")
    assert copied == expected

    (here / "new" / "deep" / "taxi.toml").unlink()
    for said in (
        f"1 examples copied, {len(expected)} were there",
        f"0 examples copied, {len(expected) + 1} were there",
    ):
        outcome = mapek("examples", "new/deep")
        assert (outcome.code, outcome.err) == (0, "")
        assert said in outcome.out


def test_a_file_is_no_folder_for_the_examples(mapek: Mapek, here: Path) -> None:
    (here / "file").write_text("kept")
    outcome = mapek("examples", "file")
    assert (outcome.code, outcome.out) == (2, "")
    assert (here / "file").read_text() == "kept"
    below = mapek("examples", "file/below")
    assert (below.code, below.out) == (1, "")
    assert "file/below" in below.err
