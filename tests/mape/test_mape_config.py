import json
import re
from pathlib import Path

import pytest
from mape_runs import GRID

from mape.config import Config, DetectorSpec, SwapConfig, SystemConfig, from_table, load, overlays_of, parts_of
from mape.errors import ConfigError, UnknownName
from mape.monitor.page_hinkley import PageHinkleyConfig
from mape.tables import NOTHING, first_difference, merge, parse_override

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


def test_an_entry_of_a_list_is_overridden_by_its_number():
    from mape import load

    config = load("gridworld_goals", overrides=["monitor.detectors.0.threshold=50.0"])
    (detector,), (before,) = config.monitor.detectors, load("gridworld_goals").monitor.detectors
    assert detector.options == {**before.options, "threshold": 50.0}
    for number in ("1", "-1", "00", "x"):
        with pytest.raises(ConfigError, match=r"monitor\.detectors: .*a table"):
            load("gridworld_goals", overrides=[f"monitor.detectors.{number}.threshold=50.0"])


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
            try:
                assert load(path, profile=profile, agent=agent).system.id == config.system.id
            except ConfigError as error:
                # An agent of the file that is extended may lack the part that is swapped.
                assert path.stem == "swaps"
                assert "swap at pass 700: unknown part 'monitor'" in str(error)  # noqa: PT017


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


@pytest.mark.parametrize(
    ("one", "other", "found"),
    [
        ({"a": {"b": None}}, {"a": {}}, ("a.b", None, NOTHING)),
        ({"a": {}}, {"a": {"b": None}}, ("a.b", NOTHING, None)),
        ({"a": 1, "b": {"c": 2}}, {"a": 1}, ("b", {"c": 2}, NOTHING)),
        ({"a": {"b": [1, 2]}, "c": 3}, {"a": {"b": [1, 3]}, "c": 4}, ("a.b", [1, 2], [1, 3])),
    ],
)
def test_the_first_difference_of_two_tables_is_named_where_one_has_nothing_too(one, other, found):
    assert first_difference(one, other) == found


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


def test_a_file_has_the_overlays_of_the_file_that_it_extends(file, tmp_path):
    file(RUN, "base.toml")
    (tmp_path / "sub").mkdir()
    path = file('extends = "../base.toml"\nepisodes = 9\n[profiles.own]\nseed = 4', "sub/top.toml")
    base = tmp_path / "base.toml"
    assert (load(path).episodes, load(path).plan.options) == (9, {"alpha": 0.2})
    assert load(path, profile="own").seed == 4
    assert overlays_of(path, "agent") == overlays_of(base, "agent")
    for kind in ("agent", "profile"):
        for name in overlays_of(base, kind):
            of_base, of_top = load(base, **{kind: name}), load(path, **{kind: name})
            assert of_top == of_base.model_copy(update={"episodes": of_top.episodes})
    with pytest.raises(UnknownName, match=r"unknown profile 'slow'.*fast"):
        load(path, profile="slow")


def test_an_overlay_is_laid_over_that_of_the_same_name_in_the_file_that_is_extended(file):
    file(RUN + "[agents.one]\nepisodes = 3\nseed = 8\n", "base.toml")
    file('extends = "base.toml"\n[agents.one]\nepisodes = 4\n', "middle.toml")
    path = file('extends = "middle.toml"\n[agents.one.plan]\nalpha = 0.6\n', "top.toml")
    one = load(path, agent="one")
    assert (one.episodes, one.seed, one.plan.options["alpha"]) == (4, 8, 0.6)


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


@pytest.mark.parametrize("depth", [250, 600, 3000])
def test_what_is_nested_deeper_than_can_be_read_is_refused(file, depth):
    lists = "[" * depth + "]" * depth
    for name, text in (
        ("run.toml", f'episodes = 5\nsystem = {{ id = "x", options = {{ a = {lists} }} }}'),
        ("run.json", f'{{"episodes": 5, "system": {{"id": "x", "options": {{"a": {lists}}}}}}}'),
    ):
        with pytest.raises(ConfigError, match="holds tables or lists within one another"):
            load(file(text, name))
    for override in (f"system.options.a={lists}", "system.options" + ".a" * depth + "=1"):
        with pytest.raises(ConfigError, match="holds tables or lists within one another"):
            load(file(RUN), overrides=[override])


def test_overlays_of_what_is_nested_too_deeply_are_refused(file):
    with pytest.raises(ConfigError, match=r"run\.toml holds tables or lists within one another"):
        overlays_of(file("a = " + "[" * 3000 + "]" * 3000), "agent")


@pytest.mark.parametrize("kind", ["profile", "agent"])
@pytest.mark.parametrize("value", ["3", "true", '"morphin"', "[1]"])
def test_overlays_that_are_no_table_of_tables_are_refused(file, kind, value):
    path = file(f"episodes = 5\n{kind}s = {value}\n")
    with pytest.raises(ConfigError, match=rf"{kind}s is a table of tables, \[{kind}s\.NAME\]"):
        overlays_of(path, kind)


def test_what_is_wrong_says_which_profile_and_agent_are_laid_over(file):
    path = file(RUN + "[agents.wrong.plan]\nbogus = 1\n")
    for chosen, said in (
        ({"agent": "wrong"}, f"{path}, agent wrong: plan.bogus: no such option"),
        ({"agent": "wrong", "profile": "fast"}, f"{path}, profile fast, agent wrong: plan.bogus: no such option"),
        ({"agent": "decay", "overrides": ["plan.bogus=2"]}, f"{path}, agent decay: plan.bogus: no such option"),
        ({"overrides": ["episodes=0"]}, f"{path}: episodes: "),
        ({"agent": "decay", "overrides": ["episodes=0"]}, f"{path}, agent decay: episodes: "),
    ):
        with pytest.raises(ConfigError, match=re.escape(said)):
            load(path, **chosen)


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
        (changed(execute={"engine": "fast"}), "unknown engine 'fast'. Known: auto, compiled, python"),
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


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize(
    ("table", "named"),
    [
        (lambda bad: changed(system={"options": {"goal_reward": bad}}), "system.options.goal_reward"),
        (lambda bad: changed(system={"options": {"of": [1, {"x": bad}]}}), "system.options.of[1].x"),
        (
            lambda bad: changed(monitor={"detectors": [{"name": "swap_detector:Failures", "floor": bad}]}),
            "monitor.detectors[0].floor",
        ),
        (
            lambda bad: changed(
                swap=[{"pass": 2, "part": "monitor", "to": {"name": "swap_detector:Failures", "floor": bad}}]
            ),
            "swap[0].to.floor",
        ),
    ],
)
def test_a_number_that_is_not_finite_is_refused_where_no_model_of_the_options_looks_at_it(
    table, named, bad, monkeypatch
):
    monkeypatch.syspath_prepend(EXAMPLES)
    with pytest.raises(ConfigError, match=re.escape(f"the file: {named} = {bad} is no finite number, and JSON")):
        from_table(table(bad), "the file")


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


SWAPPING = """
episodes = 9
[system]
id = "x"
[[swap]]
pass = 6
part = "plan"
to = { name = "morphin", alpha = 0.3, schedule = { name = "constant", epsilon = 0.2 } }
[[swap]]
pass = 2
part = "learner"
to = "expected_sarsa"
[[swap]]
pass = 6
part = "plan.schedule"
to = { decay = 0.5, name = "exponential" }
"""


def test_swaps_are_tables_in_any_order_and_stand_in_order_of_their_pass(file):
    chosen = load(file(SWAPPING))
    assert [(swap.pass_no, swap.part, swap.to.name) for swap in chosen.swap] == [
        (2, "learner", "expected_sarsa"),
        (6, "plan", "morphin"),
        (6, "plan.schedule", "exponential"),
    ]
    assert chosen.swap[1].to.options == {"alpha": 0.3, "schedule": {"name": "constant", "epsilon": 0.2}}


def test_swaps_loops_and_the_mode_come_back_from_json_as_they_were(file):
    chosen = load(file(SWAPPING), overrides=["loops=4", "execute={mode='free', rate=2.5, backlog=7}"])
    again = from_table(json.loads(chosen.to_json()))
    assert again == chosen
    assert again.to_json() == chosen.to_json()
    assert json.loads(chosen.to_json())["swap"][0] == {"pass": 2, "part": "learner", "to": {"name": "expected_sarsa"}}
    assert (again.loops, again.execute.mode, again.execute.rate, again.execute.backlog) == (4, "free", 2.5, 7)


def test_a_swap_can_be_set_from_the_command_line(file):
    line = 'swap=[{pass=3, part="monitor.0", to="two_window"}]'
    (swap,) = load(file(RUN), overrides=[line]).swap
    assert swap == SwapConfig.model_validate({"pass": 3, "part": "monitor.0", "to": "two_window"})


def one_swap(number=3, part="plan", to="morphin", **over):
    return changed(swap=[{"pass": number, "part": part, "to": to}], **over)


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        (one_swap(number=0), r"swap\.0\.pass: .*greater than or equal to 1, got 0"),
        (one_swap(number="3"), r"swap\.0\.pass: .*got '3'"),
        (one_swap(number=11), "a swap of plan at pass 11 is never made in a run of 10 episodes"),
        (changed(swap=[{"part": "plan", "to": "morphin"}]), r"swap\.0\.pass: is needed and missing"),
        (changed(swap=[{"pass": 1, "part": "plan"}]), r"swap\.0\.to: is needed and missing"),
        (
            changed(swap=[{"pas": 1, "part": "plan", "to": "morphin"}]),
            r"swap\.0\.pas: no such option; did you mean 'pass'\? Legal: pass, part, to",
        ),
        (
            changed(swap=[{"pass_no": 1, "pass": 1, "part": "plan", "to": "morphin"}]),
            r"swap\.0\.pass_no: no such option; did you mean 'pass'",
        ),
        (one_swap(part="planner"), "unknown part 'planner'; did you mean 'plan'.*Known: analyze, learner, monitor"),
        (one_swap(part="monitor.1"), r"swap at pass 3: unknown part 'monitor\.1'.*The run has 1 detectors"),
        (one_swap(part="monitor", monitor={"detectors": []}), "unknown part 'monitor'"),
        (
            one_swap(part="monitor", monitor={"detectors": ["two_window", "two_window"]}),
            r"unknown part 'monitor'; did you mean 'monitor\.[01]'",
        ),
        (one_swap(to="morfin"), "unknown planner 'morfin'; did you mean 'morphin'"),
        (one_swap(to={"name": "morphin", "alpah": 0.1}), r"swap\(pass 3\)\.to\.alpah: no such option; .*'alpha'"),
        (
            one_swap(to={"name": "morphin", "schedule": {"name": "constant", "epsilon": 7}}),
            r"swap\(pass 3\)\.to\.schedule\.epsilon: .*got 7",
        ),
        (one_swap(to={"name": "morphin", "schedule": 3}), r"planner 'morphin' for plan: schedule: .*got 3"),
        (one_swap(part="monitor", to={"name": "two_window", "signal": 3}), r"signal: .*valid string, got 3"),
        (one_swap(part="plan.schedule", to="morphin"), "unknown schedule 'morphin'"),
        (one_swap(part="learner", to="q_learn"), "unknown learner 'q_learn'; did you mean 'q_learning'"),
        (
            changed(swap=[{"pass": 3, "part": "plan", "to": name} for name in ("morphin", "q_learning")]),
            "two swaps of plan at pass 3; leave one of them",
        ),
        (
            changed(swap=[{"pass": 3, "part": part, "to": "two_window"} for part in ("monitor", "monitor.0")]),
            r"two swaps of monitor\.0 at pass 3",
        ),
        (changed(loops=0), "loops: .*greater than or equal to 1"),
        (changed(loops=4097), "loops: .*less than or equal to 4096"),
        (changed(execute={"mode": "fast"}), "unknown mode 'fast'. Known: free, lockstep"),
        (changed(execute={"mode": "free"}), "mode 'free' needs a rate: .*episodes per second"),
        (changed(execute={"mode": "free", "rate": 0.0}), "greater than 0"),
        (changed(execute={"rate": 3.0}), "rate = 3.0 paces a free-running system; in lockstep each episode waits"),
        (changed(execute={"backlog": 0}), "backlog: .*greater than or equal to 1"),
        (changed(system={"redrivable": "no"}), r"system\.redrivable"),
    ],
)
def test_a_swap_a_number_of_loops_or_a_mode_that_is_not_legal_says_what_is(table, reason):
    with pytest.raises(ConfigError, match=reason):
        from_table(table, "the file")


def test_a_swap_may_follow_another_of_the_same_part(file):
    chosen = from_table(
        changed(swap=[{"pass": n, "part": "plan", "to": name} for n, name in ((4, "morphin"), (2, "q_learning"))])
    )
    assert [(kind, spec.name) for kind, _, spec in parts_of(chosen)][-4:] == [
        ("planner", "q_learning"),
        ("schedule", "exponential"),
        ("planner", "morphin"),
        ("schedule", "exponential"),
    ]


def test_units_count_the_loops_of_all_trials():
    chosen = from_table(changed(trials=3, loops=4))
    assert chosen.units == 12
    assert [chosen.unit(trial, loop) for trial in range(3) for loop in range(4)] == list(range(12))
    for loop in (-1, 4):
        with pytest.raises(ConfigError, match=f"loop {loop} is not one of the 4 loops of a trial"):
            chosen.unit(0, loop)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Config(monitor={"detectors": ["page_hinkley"]}), r"Config: monitor\.detectors: .*from_table"),
        (lambda: Config(episodes=0, system={"id": "x"}), "Config: episodes: .*greater than or equal to 1, got 0"),
        (lambda: Config(episodes=1, system={"id": "x"}, epsodes=2), "epsodes: no such option; did you mean 'episodes'"),
        (lambda: SystemConfig(id=3), "SystemConfig: id: .*string, got 3"),
        (lambda: PageHinkleyConfig(threshold=-1.0), "PageHinkleyConfig: threshold: .*greater than 0"),
        (lambda: DetectorSpec(name=""), "DetectorSpec: name: "),
        (lambda: SystemConfig("x"), "takes 1 positional argument"),
    ],
)
def test_a_config_that_is_made_by_hand_is_refused_in_a_sentence(make, says):
    with pytest.raises((ConfigError, TypeError), match=says):
        make()


def test_what_is_needed_to_make_a_config_of_a_table_is_exported():
    import mape

    table = {"episodes": 3, "system": {"id": "x"}, "monitor": {"detectors": ["page_hinkley"]}}
    assert mape.from_table(table).monitor.detectors[0].name == "page_hinkley"


@pytest.mark.parametrize(
    ("overrides", "blamed"),
    [
        (["system.max_steps=0"], "--set system.max_steps=0, over "),
        (["seed=4", "plan.alhpa=0.3", "episodes=5"], "--set plan.alhpa=0.3, over "),
        (["episodes=5", "episodes=none"], "--set episodes=none, over "),
        (
            ["episodes=9", "swap=[{pass = 7, part = 'plan', to = 'q_learning'}]", "episodes=6"],
            "--set episodes=6, over ",
        ),
    ],
)
def test_an_override_that_is_not_legal_is_named_and_not_the_file(file, overrides, blamed):
    with pytest.raises(ConfigError, match=re.escape(blamed)):
        load(file(RUN), overrides=overrides)


def test_a_file_that_is_not_legal_is_named_and_not_the_override(file):
    path = file(RUN.replace("alpha = 0.2", "alhpa = 0.2"))
    with pytest.raises(ConfigError, match=f"^{re.escape(str(path))}: plan"):
        load(path, overrides=["episodes=3"])


def test_an_override_that_mends_a_file_is_enough(file):
    path = file(RUN.replace("episodes = ", "episodes = -"))
    assert load(path, overrides=["episodes=3"]).episodes == 3
