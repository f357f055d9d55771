"""`mapek check`: of parts and systems by name, and of the system of a config."""

from pathlib import Path

import pytest
from command_line import EXAMPLES, Mapek

RULES = "has rules that equal its steps, bit for bit"


def test_a_part_is_checked_by_its_name(mapek: Mapek) -> None:
    outcome = mapek("check", "page_hinkley")

    lines = outcome.out.splitlines()
    assert (outcome.code, lines[0], lines[-1]) == (0, "detector page_hinkley", "7 checks, all kept")
    assert "  ok      has a rule that does what its methods do, in Python and compiled" in lines


def test_a_part_that_declares_no_rule_keeps_its_contract(mapek: Mapek) -> None:
    outcome = mapek("check", "bad_parts:Quiet")

    assert outcome.code == 0
    assert "  note    has a rule that does what its methods do, in Python and compiled: detector Quiet" in outcome.out


def test_a_part_whose_rule_does_something_else_fails(mapek: Mapek, here: Path) -> None:
    (here / "two_rules.py").write_text(
        "from mape.plan.constant import Constant, constant\n"
        "from mape.ports import QuietRule\n\n\n"
        "class Fixed(Constant):\n"
        "    quiet = QuietRule(constant, [], (0.2,))\n"
    )
    outcome = mapek("check", "two_rules:Fixed")

    assert outcome.code == 1
    assert "at step 1 its methods give 0.1, its rule in Python 0.2" in outcome.out
    assert outcome.out.splitlines()[-1].endswith("checks, 1 failed")


def test_the_system_of_a_config_is_checked_as_the_config_sees_it(mapek: Mapek) -> None:
    path = EXAMPLES / "frozen_lake.toml"
    plain, tabulated = mapek("check", path), mapek("check", path, "--profile", "tabulated")

    assert (plain.code, tabulated.code) == (0, 0)
    assert plain.out.splitlines()[0] == f"system FrozenLake-v1 of {path}"
    assert tabulated.out.splitlines()[0] == f"system FrozenLake-v1 of {path}, from its transition table"
    assert f"  note    {RULES}" in plain.out
    assert f"  ok      {RULES}" in tabulated.out


def test_what_is_set_is_laid_over_the_config_that_is_checked(mapek: Mapek) -> None:
    outcome = mapek("check", EXAMPLES / "frozen_lake.toml", "--set", "system.tabulated=true")

    assert outcome.code == 0
    assert f"  ok      {RULES}" in outcome.out


def test_a_config_as_json_is_checked_too(mapek: Mapek, here: Path) -> None:
    (here / "kept.json").write_text('{"episodes": 2, "system": {"id": "mapek/TrafficJunction-v0"}}')
    outcome = mapek("check", "kept.json", "--kind", "system")

    assert outcome.code == 0
    assert outcome.out.startswith("system mapek/TrafficJunction-v0 of kept.json\n")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("nowhere.toml",), "no config file 'nowhere.toml'"),
        ((EXAMPLES / "traffic.toml", "--profile", "fast"), "unknown profile 'fast'"),
        ((EXAMPLES / "traffic.toml", "--kind", "planner"), "give the name of the planner itself"),
        (("morphin", "--set", "alfa=0.2"), "planner.alfa: no such option; did you mean 'alpha'?"),
        (("morphin", "--set", "schedule=3"), "planner.schedule: "),
        (("morphin", "--profile", "fast"), "is laid over a config; 'morphin' is the name of a planner"),
        (("FrozenLake-v1", "--set", "options.map_name=4x4"), "'FrozenLake-v1' is the name of a system"),
        (("FrozenLake-v1", "--profile", "tabulated"), "'FrozenLake-v1' is the name of a system"),
    ],
)
def test_what_cannot_be_checked_is_refused_as_usage(mapek: Mapek, arguments: tuple[object, ...], says: str) -> None:
    outcome = mapek("check", *arguments)

    assert (outcome.code, outcome.out) == (2, "")
    assert says in outcome.err


@pytest.mark.parametrize("name", ["no_such_levers:Levers-v0", "no_such_parts:Detector", "no_such.parts:Detector"])
def test_a_module_that_is_nowhere_is_said_with_where_it_was_looked_for(mapek: Mapek, here: Path, name: str) -> None:
    outcome = mapek("check", name)

    assert (outcome.code, outcome.out) == (2, "")
    module = name.partition(":")[0].partition(".")[0]
    assert f"{name!r}: there is no module {module!r} in this folder, {here}, nor" in outcome.err
    assert "detector" not in outcome.err


def test_a_module_that_lacks_another_one_or_raises_is_said_as_such(mapek: Mapek, here: Path) -> None:
    (here / "needs_more.py").write_text("import no_such_dependency\n")
    (here / "raises_early.py").write_text("raise RuntimeError('boom')\n")
    lacking, raising = mapek("check", "needs_more:Levers-v0"), mapek("check", "raises_early:Levers-v0")

    assert (lacking.code, raising.code) == (2, 2)
    assert "'needs_more:Levers-v0' needs the package 'no_such_dependency', which is not installed" in lacking.err
    assert "'raises_early:Levers-v0': its module raised RuntimeError: boom" in raising.err
    assert "detector" not in lacking.err + raising.err


def test_a_name_that_a_module_neither_registers_nor_has_is_said_as_such(mapek: Mapek, here: Path) -> None:
    (here / "one_part.py").write_text("class Watch:\n    pass\n")
    outcome = mapek("check", "one_part:Watsh")

    assert outcome.code == 2
    assert "unknown class of one_part 'Watsh'; did you mean 'Watch'?" in outcome.err


def test_a_part_gets_its_options_by_set(mapek: Mapek, here: Path) -> None:
    (here / "needs_option.py").write_text(
        "from mape.monitor.oracle import Oracle\n\n\n"
        "class Late(Oracle):\n"
        "    Config = None\n\n"
        "    def __init__(self, *, episode):\n"
        "        super().__init__(Oracle.Config(episodes=(episode,)))\n"
    )
    without, given = mapek("check", "needs_option:Late"), mapek("check", "needs_option:Late", "--set", "episode=5")

    assert (without.code, without.out) == (2, "")
    assert "cannot be made with no options: TypeError" in without.err
    assert without.err.endswith("; give its options with --set KEY=VALUE\n")
    assert given.code == 0, given.out
    assert given.out.startswith("detector needs_option:Late (episode = 5)\n")
    wrong = mapek("check", "page_hinkley", "--set", "threshold=text")
    assert (wrong.code, wrong.out) == (2, "")
    assert "threshold" in wrong.err
    assert mapek("check", "morphin", "--set", "alpha=0.2", "--set", "schedule.name=constant").code == 0
