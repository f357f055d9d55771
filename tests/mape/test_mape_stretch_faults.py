"""What is wrong with a rule that a part declares is said in a sentence that names the part."""

import re

import misdeclared_rules
import pytest
from mape_runs import GRID, config, loop_of
from misdeclared_rules import Declares
from stretch_parts import Ruled

from mape.config import from_table
from mape.errors import ConfigError, PartError
from mape.loop import Loop
from mape.testing import check_detector


def declaring(**options):
    return config(GRID, monitor={"detectors": [{"name": "oracle"}, {"name": "misdeclared_rules:Declares", **options}]})


NUMBERS_ALONE = "it holds numbers alone, and NaN for none"


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"state": "text"}, "state is '0.5'; it is the list of numbers on which the methods work"),
        ({"state": "nothing"}, "state is None; it is the list of numbers on which the methods work"),
        ({"state": "texts"}, f"state holds '0.5'; {NUMBERS_ALONE}"),
        ({"state": "nested"}, f"state holds (1.0, 2.0); {NUMBERS_ALONE}"),
        ({"state": "holds nothing"}, f"state holds None; {NUMBERS_ALONE}"),
        ({"state": "huge"}, "state holds a number that is too large for a float"),
        ({"params": "text"}, "params is '0.5'; it is a tuple of numbers"),
        ({"params": "nothing"}, "params is None; it is a tuple of numbers"),
        ({"params": "number"}, "params is 3.0; it is a tuple of numbers"),
        ({"params": "texts"}, f"params holds '0.5'; {NUMBERS_ALONE}"),
        ({"params": "nested"}, f"params holds (1.0, 2.0); {NUMBERS_ALONE}"),
        ({"params": "huge"}, "params holds a number that is too large for a float"),
        ({"function": "none"}, "function is None; it is a module-level function"),
        ({"function": "list"}, "function is [<function sound at "),
    ],
)
def test_what_is_no_rule_over_numbers_is_refused_before_the_first_pass(options, says):
    loop = loop_of(declaring(**options))
    with pytest.raises(PartError) as refused:
        loop.run(5)
    assert str(refused.value).startswith(f"detector monitor.1 Declares declares a rule (quiet) whose {says}")
    assert str(refused.value).endswith("or choose the engine 'python', which asks for none.")
    assert loop.log.passes == 0
    plain = loop_of(declaring(**options).model_copy(update={"execute": config(execute={"engine": "python"}).execute}))
    plain.run(5)
    assert plain.log.passes == 5


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"function": "none"}, "quiet.function is None; it is a module-level function"),
        ({"params": "nothing"}, "quiet.params is None; it is a tuple of numbers"),
        ({"params": "text"}, "quiet.params is '0.5'; it is a tuple of numbers"),
        ({"function": "writes_beyond"}, "IndexError was raised"),
        ({"function": "gives_nothing"}, "was raised: cannot unpack non-iterable NoneType object"),
    ],
)
def test_the_check_says_it_too(options, says):
    failed = [f.detail for f in check_detector(lambda: Declares(**options)) if f.verdict == "failed"]
    assert any(says in detail for detail in failed)


@pytest.mark.parametrize("function", ["writes_beyond", "reads_beyond"])
def test_a_rule_that_reaches_beyond_its_numbers_is_refused_before_it_reaches_into_memory(function):
    loop = loop_of(declaring(function=function))
    with pytest.raises(PartError) as refused:
        loop.run(5)
    assert str(refused.value).startswith(
        "detector monitor.1 Declares declares a rule (quiet) whose function reaches beyond its numbers: it has 1 in "
        "state and 0 in params. Mend it"
    )
    assert loop.log.passes == 0


@pytest.mark.parametrize("function", ["writes_beyond_for_nothing", "divides", "asks_what_is_compiled"])
def test_a_rule_that_fails_otherwise_on_a_signal_that_is_not_the_runs_is_taken(function):
    loop = loop_of(declaring(function=function))
    loop.run(5)
    assert loop.obstacles() == []
    assert loop.log.passes == 5


@pytest.mark.parametrize("options", [{"state": "nothing"}, {"params": "number"}])
def test_what_becomes_no_rule_on_the_way_is_refused_between_two_runs(options):
    loop = loop_of(declaring(late=3, **options))
    loop.run(5)  # in stretches: the detector itself sees nothing
    loop.monitor.detectors[1][1].update(0.0)
    loop.run(2)
    for _ in range(2):
        loop.monitor.detectors[1][1].update(0.0)
    with pytest.raises(PartError, match=r"^detector monitor\.1 Declares declares a rule \(quiet\) whose"):
        loop.run(1)
    assert loop.log.passes == loop.execute.passes == 7


def test_numbers_of_a_schedule_are_said_to_be_its_own():
    loop = loop_of(config(plan={"name": "morphin", "schedule": "misdeclared_rules:Stateless"}))
    with pytest.raises(PartError, match=r"^schedule Stateless declares a rule \(quiet\) whose state is None;"):
        loop.run(1)


@pytest.mark.parametrize(
    ("function", "says"),
    [
        ("gives_nothing", "rule gives_nothing cannot be compiled by Numba: "),
        ("names_its_side", "rule names_its_side cannot be compiled by Numba: "),
        ("takes_too_much", "rule takes_too_much cannot be compiled by Numba: "),
        ("asks_remainder", "rule asks_remainder cannot be compiled by Numba: Unknown attribute 'fmod' of type Module"),
        ("partial", "functools.partial(<function takes_too_much>, more=1.0) cannot be compiled: a rule is a module-"),
        ("method", "misdeclared_rules.Declares.method cannot be compiled: a rule is a module-level function."),
    ],
)
def test_a_rule_that_cannot_be_compiled_is_named_with_its_part_and_no_address(function, says):
    loop = loop_of(declaring(function=function))
    with pytest.raises(ConfigError) as refused:
        loop.run(5)
    assert str(refused.value).startswith(f"detector monitor.1 Declares: {says}")
    assert " 0x" not in str(refused.value)
    assert loop.log.passes == 0


def test_a_rule_of_a_schedule_that_cannot_be_compiled_is_named_with_its_schedule():
    loop = loop_of(config(plan={"name": "morphin", "schedule": "misdeclared_rules:Nowhere"}))
    with pytest.raises(ConfigError, match=r"^schedule Nowhere: rule goes_nowhere cannot be compiled by Numba: "):
        loop.run(1)


def test_a_rule_of_a_learner_that_cannot_be_compiled_is_named_with_its_learner():
    with pytest.raises(ConfigError, match=r"^learner Worthless: rule worthless cannot be compiled by Numba: "):
        loop_of(config(learner={"name": "misdeclared_rules:Worthless"}))


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"step": misdeclared_rules.stands}, "the episode of this system and learner cannot be compiled by Numba: "),
        ({"step": None}, "None cannot be compiled: a rule is a module-level function."),
        ({"params": object()}, "the episode of this system and learner cannot be compiled by Numba: "),
    ],
)
def test_rules_of_a_system_that_cannot_be_compiled_are_said_to_be_the_systems(changed, says):
    system = Ruled()
    for name, value in changed.items():
        setattr(system.rules, name, value)
    with pytest.raises(ConfigError, match=f"^the system's rules: {re.escape(says)}") as refused:
        Loop(from_table({"name": "ruled", "episodes": 9, "system": {"id": "ruled"}}), system)
    assert " 0x" not in str(refused.value)
