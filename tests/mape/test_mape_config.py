import json
from pathlib import Path

import pytest
from mape_runs import GRID

from mape.config import Config, from_table, load, merge, overlays_of, parse_override, parts_of
from mape.errors import ConfigError, UnknownName

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def file(tmp_path):
    def write(text, name="run.toml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


RUN = """
episodes = 5
[system]
id = "mapek/Gridworld-v0"
[plan]
name = "morphin"
alpha = 0.2
schedule = { name = "success", decay = 0.5 }
[monitor]
detectors = [{ name = "page_hinkley", threshold = 40.0 }]
[profiles.fast]
episodes = 2
[profiles.fast.plan]
alpha = 0.3
[agents.plain]
plan = { name = "q_learning", alpha = 0.4 }
monitor = { detectors = [] }
[agents.other]
plan = { schedule = { name = "constant" } }
[agents.decay]
plan = { schedule = { decay = 0.25 } }
"""


def test_what_a_file_leaves_out_has_its_default(file):
    config = load(file('episodes = 5\n[system]\nid = "x"'))
    assert (config.trials, config.seed, config.name, config.plan.name) == (1, 0, "run", "morphin")
    assert [spec.name for _, _, spec in parts_of(config)] == ["q_learning", "changes", "morphin", "exponential"]


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_example_is_legal_with_each_of_its_profiles_and_agents(path):
    config = load(path)
    assert from_table(json.loads(config.to_json())) == config
    for profile in [None, *overlays_of(path, "profile")]:
        for agent in [None, *overlays_of(path, "agent")]:
            assert load(path, profile=profile, agent=agent).system.id == config.system.id


def test_a_config_comes_back_from_its_json_as_it_was(file):
    for agent in (None, "plain", "other"):
        config = load(file(RUN), agent=agent)
        assert from_table(json.loads(config.to_json())) == config


def test_profile_agent_and_overrides_are_laid_over_in_this_order(file):
    path = file(RUN)
    assert load(path).plan.options == {"alpha": 0.2}
    assert load(path, profile="fast").plan.options == {"alpha": 0.3}
    assert load(path, profile="fast", agent="plain").plan.options == {"alpha": 0.4}
    assert load(path, profile="fast", agent="plain", overrides=["plan.alpha=0.9"]).plan.options == {"alpha": 0.9}
    assert load(path, profile="fast").episodes == 2


def test_a_table_that_names_another_part_takes_the_place_of_the_whole_table(file):
    config = load(file(RUN), agent="plain")
    assert (config.plan.name, config.plan.schedule.name) == ("q_learning", "exponential")
    assert load(file(RUN), agent="other").plan.schedule.options == {}


def test_a_table_that_names_no_other_part_is_merged(file):
    schedule = load(file(RUN), agent="decay").plan.schedule
    assert (schedule.name, schedule.options) == ("success", {"decay": 0.25})
    assert load(file(RUN), agent="decay").plan.options == {"alpha": 0.2}


def test_merging_changes_neither_table():
    base, over = {"a": {"b": 1}, "c": [1]}, {"a": {"d": 2}, "c": [2]}
    assert merge(base, over) == {"a": {"b": 1, "d": 2}, "c": [2]}
    assert (base, over) == ({"a": {"b": 1}, "c": [1]}, {"a": {"d": 2}, "c": [2]})


def test_a_part_given_by_its_name_alone_takes_further_options():
    assert merge({"plan": "morphin"}, {"plan": {"alpha": 0.5}}) == {"plan": {"name": "morphin", "alpha": 0.5}}
    assert merge({"plan": {"name": "morphin", "alpha": 0.5}}, {"plan": "q_learning"}) == {"plan": "q_learning"}


def test_the_name_of_a_run_does_not_make_it_another_part():
    merged = merge(GRID, {"name": "other", "episodes": 3})
    assert merged == {**GRID, "name": "other", "episodes": 3}


def test_a_file_extends_another_without_taking_its_overlays(file, tmp_path):
    file(RUN, "base.toml")
    (tmp_path / "sub").mkdir()
    path = file('extends = "../base.toml"\nepisodes = 9\n[profiles.own]\nseed = 4', "sub/top.toml")
    assert (load(path).episodes, load(path).plan.options) == (9, {"alpha": 0.2})
    assert load(path, profile="own").seed == 4
    assert overlays_of(path, "agent") == []
    with pytest.raises(UnknownName, match="unknown profile 'fast'"):
        load(path, profile="fast")


@pytest.mark.parametrize("chain", [["a"], ["a", "b"], ["a", "b", "c"]])
def test_files_that_extend_each_other_in_a_circle_are_refused(file, chain):
    for name, following in zip(chain, [*chain[1:], chain[0]], strict=True):
        path = file(f'extends = "{following}.toml"', f"{name}.toml")
    with pytest.raises(ConfigError, match="extends itself, by way of"):
        load(path)


def test_a_file_of_json_is_read_too(file):
    assert load(file(json.dumps(GRID), "run.json")).to_json() == from_table(GRID).to_json()


@pytest.mark.parametrize(
    ("text", "name", "reason"),
    [
        ("episodes = ", "run.toml", "is not valid TOML"),
        ("{", "run.json", "is not valid JSON"),
        ("[1]", "run.json", "holds no table"),
        ("extends = 3", "run.toml", "is not the path of another config file"),
        ('extends = "nowhere.toml"', "run.toml", "no config file .*nowhere.toml"),
        ("profiles = 3", "run.toml", "profiles is a table of tables"),
        ('episodes = 5\n[system]\nid = "x"\noptions = { when = 2026-01-01 }', "run.toml", "is not a number, text"),
    ],
)
def test_a_file_that_cannot_be_read_as_a_config_says_why(file, text, name, reason):
    with pytest.raises(ConfigError, match=reason):
        load(file(text, name))


def test_a_missing_file_points_to_the_examples(tmp_path):
    with pytest.raises(ConfigError, match=r"no config file .*examples"):
        load(tmp_path / "none.toml")


@pytest.mark.parametrize(("kind", "name", "close"), [("profile", "fsat", "fast"), ("agent", "plian", "plain")])
def test_an_unknown_profile_or_agent_is_asked_back(file, kind, name, close):
    with pytest.raises(UnknownName, match=f"unknown {kind} '{name}'; did you mean '{close}'"):
        load(file(RUN), **{kind: name})


@pytest.mark.parametrize(
    ("text", "table"),
    [
        ("plan.alpha=0.2", {"plan": {"alpha": 0.2}}),
        ("plan.alpha = 0.2 ", {"plan": {"alpha": 0.2}}),
        ("episodes=7", {"episodes": 7}),
        ("plan=q_learning", {"plan": "q_learning"}),
        ('plan="q_learning"', {"plan": "q_learning"}),
        ("execute.mask_greedy=true", {"execute": {"mask_greedy": True}}),
        ("monitor.detectors=[]", {"monitor": {"detectors": []}}),
        ("system.options.size=[5, 6]", {"system": {"options": {"size": [5, 6]}}}),
        (
            'plan.schedule={name = "constant", epsilon = 0.5}',
            {"plan": {"schedule": {"name": "constant", "epsilon": 0.5}}},
        ),
        ("learner=my.module:Class", {"learner": "my.module:Class"}),
        ("description=a=b", {"description": "a=b"}),
        ("description=", {"description": ""}),
    ],
)
def test_an_override_is_a_dotted_key_and_a_toml_value_or_else_text(text, table):
    assert parse_override(text) == table


@pytest.mark.parametrize("text", ["", "episodes", "=3", ".a=3", "a.=3", "a..b=3"])
def test_an_override_without_key_and_value_is_refused(text):
    with pytest.raises(ConfigError, match="is not KEY=VALUE"):
        parse_override(text)


def changed(**over):
    return merge(GRID, over)


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        (changed(epsiodes=3), "epsiodes: no such option; did you mean 'episodes'"),
        (changed(system={"max_step": 3}), r"system\.max_step: no such option; did you mean 'max_steps'"),
        (changed(execute={"engin": "auto"}), r"execute\.engin: no such option; did you mean 'engine'"),
        (changed(plan={"name": "morphin", "alpah": 0.1}), r"plan\.alpah: no such option; did you mean 'alpha'"),
        (changed(plan={"name": "morfin"}), "unknown planner 'morfin'; did you mean 'morphin'"),
        (changed(learner="q_learn"), "unknown learner 'q_learn'; did you mean 'q_learning'"),
        (
            changed(monitor={"detectors": ["page_hinkly"]}),
            "unknown detector 'page_hinkly'; did you mean 'page_hinkley'",
        ),
        (changed(execute={"engine": "fast"}), "engine 'fast' is not one of auto, compiled, python"),
        ({"system": {"id": "x"}}, "episodes: is needed and missing"),
        ({"episodes": 3}, "system: is needed and missing"),
    ],
)
def test_a_name_that_does_not_exist_is_asked_back(table, reason):
    with pytest.raises(ConfigError, match=reason):
        from_table(table)


@pytest.mark.parametrize(
    ("table", "where"),
    [
        (changed(episodes="5"), "episodes: .*got '5'"),
        (changed(episodes=5.0), "episodes"),
        (changed(episodes=True), "episodes"),
        (changed(episodes=float("nan")), "episodes"),
        (changed(trials=float("inf")), "trials"),
        (changed(episodes=0), "episodes"),
        (changed(seed=-1), "seed"),
        (changed(name="a/b"), "name"),
        (changed(learner={"name": "q_learning", "discount": "0.9"}), r"learner\.discount: .*got '0.9'"),
        (changed(learner={"name": "q_learning", "discount": 1.1}), r"learner\.discount: .*got 1.1"),
        (changed(execute={"mask_greedy": 1}), r"execute\.mask_greedy"),
        (
            changed(plan={"name": "morphin", "schedule": {"name": "constant", "epsilon": True}}),
            r"plan\.schedule\.epsilon",
        ),
        (changed(monitor={"detectors": [{"name": "page_hinkley", "delta": "1"}]}), r"monitor\.detectors\[0\]\.delta"),
        (changed(system={"discretise": {"low": [0.0], "high": [1.0, 2.0], "bins": [3]}}), "one number per dimension"),
        (changed(system={"discretise": {"low": [1.0], "high": [1.0], "bins": [3]}}), "low is below high"),
    ],
)
def test_a_value_of_the_wrong_type_or_size_is_refused_and_not_converted(table, where):
    with pytest.raises(ConfigError, match=where):
        from_table(table, "the file")


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize(
    "table",
    [
        lambda bad: changed(learner={"name": "q_learning", "discount": bad}),
        lambda bad: changed(plan={"name": "morphin", "k": bad}),
        lambda bad: changed(monitor={"detectors": [{"name": "page_hinkley", "threshold": bad}]}),
    ],
)
def test_a_number_that_is_not_finite_is_refused(table, bad):
    with pytest.raises(ConfigError, match="finite"):
        from_table(table(bad))


def test_a_toml_file_cannot_smuggle_in_nan(file):
    with pytest.raises(ConfigError, match=r"plan\.alpha: .*finite"):
        load(file(RUN.replace("alpha = 0.2", "alpha = nan")))


def test_every_wrong_field_is_named_at_once():
    with pytest.raises(ConfigError) as refused:
        from_table({"episodes": "5", "seed": -1, "system": {"id": ""}}, "the file")
    assert [line.split(": ")[1] for line in str(refused.value).splitlines()] == ["episodes", "seed", "system.id"]


def test_a_config_cannot_be_changed():
    config = from_table(GRID)
    assert isinstance(config, Config)
    with pytest.raises(ValueError, match="frozen"):
        config.episodes = 3
