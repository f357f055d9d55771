import sys

import pytest

from mape import registry
from mape.errors import ConfigError, UnknownName
from mape.monitor.page_hinkley import PageHinkley
from mape.specs import PartSpec

OWN = """
import math
from pydantic import Field
from mape.specs import PartConfig

class Part:
    direction, statistic = "unknown", None
    def update(self, x): return False
    def reset(self): pass
    def start(self, loop): pass
    def plan(self, request, knowledge): pass
    def state(self): pass
    def restore(self, state): pass

class Plain(Part):
    def __init__(self, threshold=3.0, schedule=None):
        if threshold < 0:
            raise ValueError("threshold is negative")
        self.threshold, self.schedule = threshold, schedule

class Lonely(Part):
    def __init__(self, threshold):
        self.threshold = threshold

class StrictConfig(PartConfig):
    threshold: float = Field(3.0, gt=0)

class Strict(Part):
    Config = StrictConfig
    def __init__(self, config, schedule=None):
        self.threshold, self.schedule = config.threshold, schedule
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A module of the user's own, found in the folder where the user stands."""
    (tmp_path / "own_parts.py").write_text(OWN)
    (tmp_path / "needs_more.py").write_text("import a_package_that_is_not_there")
    (tmp_path / "broken_parts.py").write_text("1 / 0")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield "own_parts"
    for name in ("own_parts", "needs_more", "broken_parts"):
        sys.modules.pop(name, None)


def spec(name, **options):
    return PartSpec.model_validate({"name": name, **options})


@pytest.mark.parametrize("kind", sorted(registry.PARTS))
def test_every_short_name_leads_to_a_class_with_a_summary(kind):
    for name, entry in registry.PARTS[kind].items():
        assert isinstance(registry.find(kind, name), type)
        assert entry.summary


def test_a_part_is_found_by_short_name_and_by_module_and_class():
    assert registry.find("detector", "page_hinkley") is PageHinkley
    assert registry.find("detector", "mape.monitor.page_hinkley:PageHinkley") is PageHinkley


def test_a_part_of_ones_own_is_found_in_the_folder_where_one_stands(own):
    assert registry.build("detector", spec(f"{own}:Plain")).threshold == 3.0


def test_a_part_without_config_gets_its_options_as_keyword_arguments(own):
    assert registry.build("detector", spec(f"{own}:Plain", threshold=5)).threshold == 5


def test_a_part_with_config_gets_its_options_checked(own):
    assert registry.build("detector", spec(f"{own}:Strict", threshold=5.0)).threshold == 5.0
    with pytest.raises(ConfigError, match=r"detector\.threshold: .*greater than 0.* got -1"):
        registry.build("detector", spec(f"{own}:Strict", threshold=-1.0))
    with pytest.raises(ConfigError, match=r"no such option; did you mean 'threshold'\? Legal: threshold"):
        registry.build("detector", spec(f"{own}:Strict", treshold=1.0))


def test_a_schedule_reaches_a_planner_that_takes_one(own):
    for name in ("Plain", "Strict"):
        assert registry.build("planner", spec(f"{own}:{name}"), schedule="given").schedule == "given"
    assert registry.build("planner", spec(f"{own}:Lonely", threshold=1), schedule="given").threshold == 1


def test_options_that_a_part_does_not_take_are_said_with_its_own_words(own):
    with pytest.raises(ConfigError, match=r"cannot be made with .*ValueError: threshold is negative"):
        registry.build("detector", spec(f"{own}:Plain", threshold=-1))
    with pytest.raises(ConfigError, match=r"cannot be made with .*unexpected keyword argument 'colour'"):
        registry.build("detector", spec(f"{own}:Plain", colour="red"))
    with pytest.raises(ConfigError, match="cannot be made with no options"):
        registry.build("detector", spec(f"{own}:Lonely"))


def test_a_part_without_the_members_of_its_port_is_refused_with_what_it_lacks(own):
    with pytest.raises(ConfigError, match="schedule 'own_parts:Plain' has no epsilon, advance"):
        registry.build("schedule", spec(f"{own}:Plain"))


def test_an_unknown_short_name_is_asked_back_with_the_way_to_ones_own():
    with pytest.raises(UnknownName, match=r"did you mean 'page_hinkley'.*module:Class"):
        registry.find("detector", "page_hinkly")


@pytest.mark.parametrize("name", ["no_such_module:Class", "mape.monitor.none:Class", "mape.none.more:Class"])
def test_an_unknown_module_is_named(name):
    with pytest.raises(ConfigError, match=rf"detector '{name}': there is no module '\S+' in this folder"):
        registry.find("detector", name)


def test_an_unknown_class_is_asked_back_with_those_of_the_module(own):
    with pytest.raises(
        UnknownName, match=f"unknown class of {own} 'Strikt'; did you mean 'Strict'.*Lonely, Part, Plain"
    ):
        registry.find("detector", f"{own}:Strikt")


def test_a_module_that_needs_a_missing_package_says_which(own):
    with pytest.raises(ConfigError, match="needs the package 'a_package_that_is_not_there', which is not installed"):
        registry.find("detector", "needs_more:Class")


def test_a_module_that_raises_says_what(own):
    with pytest.raises(ConfigError, match="its module raised ZeroDivisionError"):
        registry.find("detector", "broken_parts:Class")


def test_a_registered_part_is_found_by_its_short_name(monkeypatch):
    monkeypatch.setitem(registry.PARTS, "detector", dict(registry.PARTS["detector"]))
    registry.register("detector", "mine", "mape.monitor.page_hinkley:PageHinkley", "as an example")
    assert registry.find("detector", "mine") is PageHinkley
