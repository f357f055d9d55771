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
        (("morphin", "--set", "plan.alpha=0.2"), "are laid over a config; 'morphin' is the name of a planner"),
        (("FrozenLake-v1", "--profile", "tabulated"), "'FrozenLake-v1' is the name of a system"),
    ],
)
def test_what_cannot_be_checked_is_refused_as_usage(mapek: Mapek, arguments: tuple[object, ...], says: str) -> None:
    outcome = mapek("check", *arguments)

    assert (outcome.code, outcome.out) == (2, "")
    assert says in outcome.err
