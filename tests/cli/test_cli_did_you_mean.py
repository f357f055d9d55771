"""A name that is nearly right is answered with the one that is, before anything is begun or anybody is asked."""

import argparse
import contextlib
import io
import re
import shlex
import string
from pathlib import Path

import pytest
from command_line import Mapek
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from adapters.cli.options import parser
from adapters.cli.up import _waiting
from adapters.processes.supervise import Supervisor
from mape.config_files import shipped
from mape.errors import BusError
from mape.near import nearest_path

NOBODY = "--connect tcp/127.0.0.1:9"

NEARLY = [
    ("comapre gridworld_goals", "compare"),
    ("exmaples", "examples"),
    ("--versoin", "--version"),
    ("run frozen_lake --trails 3", "--trials"),
    ("run frozen_lake --sed=3", "--seed"),
    ("compare gridworld_goals --agnets morphin", "--agents"),
    ("up frozen_lake --durabilty full", "--durability"),
    ("status --conect tcp/127.0.0.1:9", "--connect"),  # and not: --connect is missing
    ("serve frozen_lake --rolle plan", "--role"),
    ("reproduce tabel1", "table1"),
    ("serve frozen_lake --role monitr --connect tcp/127.0.0.1:9", "monitor"),
    ("run frozen_lake --engine compield", "compiled"),
    ("log . --stage symptm", "symptom"),
    ("check page_hinkley --kind detectr", "detector"),
    ("up frozen_lake --durability ful", "full"),
    ("run frozen_lke", "frozen_lake"),
    ("run mine.tml", "mine.toml"),
    ("run configs/other.toml", "configs/others.toml"),
    ("run cofnigs/others.toml", "configs/others.toml"),
    ("run cofnigs/othrs.toml", "configs/others.toml"),
    ("compare mine.toml configs/othrs.toml", "configs/others.toml"),
    ("step elsewhere/frozen_lake.toml", "frozen_lake"),
    ("check frozen_lakes", "frozen_lake"),
    ("check page_hinckley", "page_hinkley"),
    ("check FrozenLke-v1", "FrozenLake-v1"),
    ("log rsults/first", "results/first"),
    ("log results/frist", "results/first"),
    ("replay results/frist", "results/first"),
    ("resume results/frist", "results/first"),
    (f"status --tls kyes {NOBODY}", "keys/ca.pem"),
    ("run mine.toml --agent oen", "one"),
    ("run mine.toml --profile qick", "quick"),
    ("compare mine.toml --agents one,tow", "two"),
    ("run mine.toml --set epsiodes=3", "episodes"),
    ("run mine.toml --set plan.alhpa=3", "alpha"),
    ("run mine.toml --set plan=morphine", "morphin"),
    ("run mine.toml --set execute.engine=compield", "compiled"),
    ("run mine.toml --set execute.mode=lock_step", "lockstep"),
    ("run mine.toml --set system.id=FrozenLke-v1", "FrozenLake-v1"),
    ("run mine.toml --set system.options.map_nam=4x4", "map_name"),
    ("run mine.toml --set 'plan.respond_to=[\"drfit\"]'", "drift"),
    ('run mine.toml --set \'monitor.detectors=[{name="two_window", signal="retrun"}]\'', "return"),
    ("run gridworld_goals --set monitor.detectors.0.treshold=50", "threshold"),
    ("run extending.toml", "frozen_lake"),
    (f"swap plann q_learning {NOBODY}", "plan"),
    (f"swap plan.shedule constant {NOBODY}", "plan.schedule"),
    (f"swap plan q_leraning {NOBODY}", "q_learning"),
    (f"swap monitor.1 two_windows {NOBODY}", "two_window"),
    (f"swap learner expected_salsa {NOBODY}", "expected_sarsa"),
    (f"swap plan '{{name = \"morphin\", alhpa = 0.2}}' {NOBODY}", "alpha"),
    (f'swap plan \'{{name = "morphin", schedule = "constnt"}}\' {NOBODY}', "constant"),
]


@pytest.fixture
def names(here: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with configs, runs and keys; in it nobody may be connected to."""

    def refuse(*arguments: object) -> None:
        raise BusError("somebody was connected to")

    monkeypatch.setattr("adapters.buses.wire._open", refuse)
    text = 'episodes = 3\nsystem = { id = "FrozenLake-v1" }\n[agents.one]\n[agents.two]\n[profiles.quick]\n'
    (here / "configs").mkdir()
    for name in ("mine.toml", "configs/others.toml"):
        (here / name).write_text(text)
    (here / "extending.toml").write_text('extends = "frozen_lakes"')
    (here / "results" / "first").mkdir(parents=True)
    (here / "keys").mkdir()
    (here / "keys" / "ca.pem").write_text("")
    return here


@pytest.mark.parametrize(("line", "meant"), NEARLY, ids=[line for line, _ in NEARLY])
def test_what_was_meant_is_asked(names: Path, mapek: Mapek, line: str, meant: str) -> None:
    before = sorted(names.rglob("*"))
    code, out, err = mapek(*shlex.split(line))

    assert (code, out) == (1 if line.split()[0] in ("log", "replay", "resume") and "--stage" not in line else 2, "")
    assert re.search(rf"did you mean '(/.*/)?{re.escape(meant)}'\?", err), err
    assert sorted(names.rglob("*")) == before


def test_a_part_that_is_built_in_is_looked_at_before_anybody_is_asked_and_ones_own_where_it_runs(
    mapek: Mapek, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = "somebody was connected to"

    def refuse(*arguments: object) -> None:
        raise BusError(asked)

    monkeypatch.setattr("adapters.cli.swap.operator", refuse)
    for to in ("q_learning", "nowhere:Class", '{name = "nowhere:Class", alhpa = 3}', '{name = "morphin", alpha = 0.2}'):
        assert asked in mapek("swap", "plan", to, *NOBODY.split()).err
    assert asked in mapek("swap", "monitor", '{name = "two_window", signal = "x"}', *NOBODY.split()).err
    assert asked not in mapek("swap", "plan", '{name = "q_learning", alpha = "much"}', *NOBODY.split()).err


def test_a_word_after_two_dashes_and_a_value_are_no_options(mapek: Mapek) -> None:
    outcome = mapek("run", "--", "--trails")
    assert "no config file '--trails'" in outcome.err
    assert "no config file 'nowhere'" in mapek("run", "nowhere", "--set", "name=--x").err


@given(
    st.one_of(
        st.sampled_from(["--trial", "--q", "--show=1:2", "--verbose", "--no-figures", "--set"]),
        st.text(string.ascii_lowercase + "-= ", min_size=1, max_size=12).map("--{}".format),
    )
)
def test_what_is_refused_as_an_unknown_option_is_what_argparse_would_have_left_over(word: str) -> None:
    command = parser()._subparsers._group_actions[0].choices["run"]  # type: ignore[union-attr, index]
    left, said = [], io.StringIO()
    with contextlib.suppress(SystemExit), contextlib.redirect_stderr(None):
        left = argparse.ArgumentParser.parse_known_args(command, ["x.toml", word])[1]
    with contextlib.suppress(SystemExit), contextlib.redirect_stderr(said):
        command.parse_known_args(["x.toml", word])
    assert ("unknown option" in said.getvalue()) == (left == [word] and " " not in word)  # else it is a value


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.text(max_size=300))
def test_no_name_of_a_file_ends_otherwise_than_in_a_sentence(here: Path, mapek: Mapek, name: str) -> None:
    if name in shipped() or name.startswith("-"):
        return
    (here / "there.toml").write_text("")
    code, out, err = mapek("step", name)
    assert (code, out) == (2, "")
    assert err.startswith(("mapek: no config file", "mapek: config file")), err


def test_a_folder_that_may_not_be_looked_into_answers_nothing(here: Path) -> None:
    assert nearest_path(here / "nothing" / "at" / "all") is None
    assert nearest_path(Path("/")) is None


def test_a_run_whose_knowledge_is_just_starting_says_so_and_nothing_of_who_does_not_answer(here: Path) -> None:
    """What the table of `mapek up` has for a title, from the first look on."""
    from adapters.buses.wire import Wire

    wire = Wire(f"unixsock-stream/{here}/k.sock", "example")
    said: list[str] = []

    class Enough(Exception):
        pass

    def look(supervisor: Supervisor) -> None:
        said.append(_waiting(supervisor))
        if len(said) == 3:
            raise Enough

    commands = {role: ["sleep", "1000"] for role in ("knowledge", "execute", "monitor", "analyze", "plan")}
    with pytest.raises(Enough), Supervisor(wire, commands, here) as supervisor:
        supervisor.watch(look)
    assert said == ["starting"] * 3
