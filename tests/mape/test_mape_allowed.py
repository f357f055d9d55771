"""A name is looked at before anything of it is called, and, where somebody else gives it, before it is imported."""

import contextlib
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mape import registry
from mape.allowed import check_part
from mape.config import from_table
from mape.errors import ConfigError
from mape.parts import make
from mape.specs import PartSpec

PARTS = {"monitor": "detector", "analyze": "analyzer", "plan": "planner", "plan.schedule": "schedule"}
PARTS["learner"] = "learner"

NOTES = """
import pathlib
pathlib.Path({mark!r}).touch()

class Part:
    direction, statistic = "unknown", None
    def update(self, x): return False
    def reset(self): pass
"""


@pytest.fixture
def mark(own_folder):
    """A file that is there once a module has been imported, or a command been run."""
    return own_folder / "mark"


def config(**table):
    watched = {"detectors": ["page_hinkley"]}
    return from_table({"episodes": 5, "system": {"id": "any"}, "monitor": watched, **table})


def spec(name, **options):
    return PartSpec.model_validate({"name": name, **options})


@pytest.mark.parametrize("kind", sorted(set(PARTS.values())))
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("subprocess:Popen", {"args": ["touch", "{mark}"]}),
        ("subprocess:run", {"args": ["touch", "{mark}"]}),
        ("os:system", {"command": "touch {mark}"}),
        ("builtins:open", {"file": "{mark}", "mode": "w"}),
        ("pathlib:Path.touch", {"self": "{mark}"}),
    ],
)
def test_what_is_no_class_with_the_methods_of_its_kind_is_not_called(mark, kind, name, options):
    filled = {
        key: [part.format(mark=mark) for part in value] if isinstance(value, list) else value.format(mark=mark)
        for key, value in options.items()
    }
    with pytest.raises(ConfigError):
        registry.build(kind, spec(name, **filled))
    assert not mark.exists()


def test_a_class_that_lacks_a_method_is_not_made(own_folder, mark):
    (own_folder / "half.py").write_text(
        f"class Half:\n    def __init__(self):\n        open({str(mark)!r}, 'w')\n    def update(self, x): ...\n"
    )
    with pytest.raises(ConfigError, match=r"detector 'half:Half' has no direction, statistic, reset"):
        make("detector", spec("half:Half"))
    assert not mark.exists()


def test_options_are_not_looked_at_by_a_class_that_is_no_part(own_folder, mark):
    (own_folder / "odd.py").write_text(
        "from pydantic import BaseModel, model_validator\n"
        "class Odd:\n    class Config(BaseModel):\n        @model_validator(mode='before')\n"
        f"        def of(cls, value):\n            open({str(mark)!r}, 'w')\n            return value\n"
    )
    with pytest.raises(ConfigError, match="has no analyze"):
        config(analyze="odd:Odd")
    assert not mark.exists()


@pytest.mark.parametrize("part", sorted(PARTS))
def test_a_module_that_nobody_here_named_is_not_imported(own_folder, mark, monkeypatch, part):
    elsewhere = own_folder / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "their_parts.py").write_text(NOTES.format(mark=str(mark)))
    monkeypatch.syspath_prepend(elsewhere)
    with pytest.raises(ConfigError, match=r"'their_parts:Part'.*working folder"):
        check_part(config(), part, spec("their_parts:Part"))
    assert "their_parts" not in sys.modules
    assert not mark.exists()


def test_the_schedule_that_a_planner_brings_is_looked_at_too(own_folder):
    brought = spec("morphin", schedule={"name": "subprocess:Popen", "args": ["id"]})
    with pytest.raises(ConfigError, match="schedule 'subprocess:Popen'"):
        check_part(config(), "plan", brought)


def test_the_modules_of_the_working_folder_are_allowed_and_not_imported_for_that(own_folder, mark):
    (own_folder / "my_parts.py").write_text(NOTES.format(mark=str(mark)))
    (own_folder / "mine").mkdir()
    (own_folder / "mine" / "__init__.py").write_text(NOTES.format(mark=str(mark)))
    (own_folder / "plain").mkdir()
    (own_folder / "plain" / "parts.py").write_text(NOTES.format(mark=str(mark)))
    for name in ("my_parts:Part", "mine:Part", "mine.parts:Part", "plain.parts:Part"):
        check_part(config(), "monitor", spec(name))
    assert not mark.exists()


def test_a_module_of_the_library_is_none_of_the_working_folder_whatever_is_called_so(own_folder):
    (own_folder / "subprocess.py").touch()
    with pytest.raises(ConfigError, match="'subprocess', which is not imported"):
        check_part(config(), "monitor", spec("subprocess:Popen"))


def test_what_the_config_names_and_what_is_registered_is_allowed(own_folder, monkeypatch):
    elsewhere = own_folder / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "theirs.py").write_text(NOTES.format(mark=str(own_folder / "mark")))
    monkeypatch.syspath_prepend(elsewhere)
    named = config(monitor={"detectors": ["theirs:Part"]})
    planned = config(swap=[{"pass": 3, "part": "monitor", "to": "theirs:Part"}])
    for each in (named, planned):
        check_part(each, "monitor", spec("theirs:Part"))
    for name in ("page_hinkley", "mape.monitor.two_window:TwoWindow"):
        check_part(config(), "monitor", spec(name))
    monkeypatch.delitem(sys.modules, "theirs")


@given(st.from_regex(r"[a-z_.]{1,12}:[A-Za-z_.]{1,8}", fullmatch=True))
def test_no_name_that_can_be_thought_of_imports_anything(name):
    before = set(sys.modules)
    with contextlib.suppress(ConfigError):
        check_part(config(), "monitor", spec(name))
    assert set(sys.modules) == before
