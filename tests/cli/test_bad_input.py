"""Everything that can be given wrongly: the exit code, what the message must say, and what must stay as it was.

A message names what was given, and what is legal or the way out. Exit code 2 is for usage and configs, of which
nothing is begun; 1 for what fails under way, of which nothing half-done is left.
"""

from pathlib import Path
from typing import NamedTuple

import bad_worlds  # registers its environments
import pytest
from command_line import EXAMPLES, Mapek, contents

CONFIG = """\
episodes = 6

[system]
id = "mapek/Gridworld-v0"
options = { size = [3, 3], start = [0, 0], goals = [[2, 2], [0, 2]], switch_at = [4], max_steps = 10 }

[monitor]
detectors = [{ name = "page_hinkley", threshold = 3.0 }]

[plan]
name = "morphin"

[execute]
engine = "python"

[agents.one]

[agents.two]
plan = "q_learning"

[agents.broken]
plan = "q_lurning"

[profiles.fast]
episodes = 3
"""

# What a command needs at least besides the case's own arguments.
QUIETLY = ("--no-figures", "-q", "--workers", "1")


class Case(NamedTuple):
    """One thing given wrongly."""

    name: str
    code: int
    says: tuple[str, ...]
    arguments: tuple[str, ...]
    config: str = CONFIG
    command: str = "run"


def sets(name: str, code: int, override: str | tuple[str, ...], *says: str) -> Case:
    """Return the case of one or several --set on the config above."""
    overrides = (override,) if isinstance(override, str) else override
    arguments = tuple(word for one in overrides for word in ("--set", one))
    return Case(name, code, says, ("config.toml", *arguments))


def usage(name: str, *says: str, arguments: tuple[str, ...]) -> Case:
    return Case(name, 2, says, ("config.toml", *arguments))


def files(name: str, config: str, *says: str) -> Case:
    return Case(name, 2, says, ("config.toml",), config)


def world(name: str, code: int, *says: str, kind: str = "") -> Case:
    told = says[0].removesuffix("-v0")
    kind = kind or (told if told != says[0] else "".join(word.capitalize() for word in name.split()))
    return sets(f"a system with {name}", code, (f'system={{id="bad_worlds:{kind}-v0"}}',), *says)


def detector(name: str, code: int, kind: str, *says: str) -> Case:
    return sets(name, code, f'monitor.detectors=["bad_parts:{kind}"]', *says)


def planner(name: str, code: int, kind: str, *says: str) -> Case:
    return sets(name, code, f"plan=bad_parts:{kind}", *says)


def other(name: str, code: int, *says: str, command: str, arguments: tuple[str, ...]) -> Case:
    return Case(name, code, says, arguments, command=command)


GRID = "system.options."
TRAFFIC = 'system={id="mapek/TrafficJunction-v0", options={%s}}'

CASES = [
    # the config file
    Case("a config that is not there", 2, ("'nowhere.toml'", "examples"), ("nowhere.toml",)),
    Case("a folder as config", 2, ("'folder'", "directory"), ("folder",)),
    Case("a config that is not UTF-8", 2, ("'latin.toml'", "utf-8"), ("latin.toml",)),
    files("bad TOML", "episodes = = 3", "config.toml", "not valid TOML", "line 1"),
    Case("bad JSON", 2, ("bad.json", "not valid JSON", "line 1"), ("bad.json",)),
    Case("JSON that is no table", 2, ("list.json", "no table"), ("list.json",)),
    Case("JSON with a NaN", 2, ("nan.json", "nan", "finite"), ("nan.json",)),
    files("an empty config", "", "config.toml", "episodes", "needed and missing", "system"),
    files("a config that extends itself", 'extends = "config.toml"\n', "config.toml", "extends itself"),
    files("a config that extends a missing file", 'extends = "gone.toml"\n', "gone.toml"),
    files("a config that extends a number", "extends = 3\n", "extends = 3", "path"),
    files("a date in the config", CONFIG + "\n[x]\ny = 2020-01-01\n", "2020", "config.toml"),
    files("agents that are no tables", "agents = 3\n" + CONFIG.split("[agents.one]")[0], "agents", "[agents.NAME]"),
    # keys
    sets("an unknown top-level key", 2, "episods=3", "episods", "no such option", "did you mean 'episodes'"),
    sets("an unknown nested key", 2, "system.max_step=3", "system.max_step", "did you mean 'max_steps'"),
    sets("an unknown key with no likeness", 2, "execute.zzz=1", "execute.zzz", "engine", "mask_greedy"),
    sets(
        "an unknown option of a detector",
        2,
        'monitor.detectors=[{name="page_hinkley", treshold=3.0}]',
        "treshold",
        "did you mean 'threshold'",
    ),
    sets("an unknown option of a planner", 2, "plan.alfa=0.1", "alfa", "did you mean 'alpha'"),
    sets("an unknown option of a schedule", 2, 'plan.schedule={name="exponential", eps=0.1}', "eps", "eps_min"),
    sets("an unknown key of a swap", 2, 'swap=[{pas=1, part="plan", to="morphin"}]', "pas", "did you mean 'pass'"),
    sets("an unknown part in a swap", 2, 'swap=[{pass=1, part="plam", to="morphin"}]', "'plam'", "did you mean 'plan'"),
    # types and values
    sets("a swap after the last episode", 2, 'swap=[{pass=999, part="plan", to="morphin"}]', "pass 999", "episodes"),
    sets("loops below one", 2, "loops=0", "loops", "0", "greater than or equal to 1"),
    sets("more loops than there may be", 2, "loops=4097", "loops", "4097", "less than or equal to 4096"),
    sets("an unknown mode", 2, "execute.mode=fast", "'fast'", "free, lockstep"),
    sets("free-running without a rate", 2, "execute.mode=free", "rate", "episodes per second"),
    sets("a rate in lockstep", 2, "execute.rate=3.0", "rate", "lockstep", "Leave rate out"),
    sets("free-running in one process", 2, 'execute={mode="free", rate=3.0}', "mapek up"),
    sets("text for a number", 2, 'episodes="5"', "episodes", "'5'", "integer"),
    sets("a float for an integer", 2, "episodes=5.0", "episodes", "5.0", "integer"),
    sets("a bool for an integer", 2, "trials=true", "trials", "True", "integer"),
    sets("a number for text", 2, "system.id=3", "system.id", "3", "string"),
    sets("a number for a table", 2, "monitor=3", "monitor", "3"),
    sets("a NaN", 2, "plan.alpha=nan", "alpha", "nan", "finite"),
    sets("an infinity of a system", 2, "system.options.goal_reward=inf", "system.options.goal_reward = inf", "JSON"),
    sets("an infinity", 2, 'monitor.detectors=[{name="page_hinkley", threshold=inf}]', "threshold", "inf", "finite"),
    sets("no episodes", 2, "episodes=0", "episodes", "0", "greater than or equal to 1"),
    sets("negative episodes", 2, "episodes=-3", "episodes", "-3", "greater than or equal to 1"),
    sets("no trials in the config", 2, "trials=0", "trials", "0", "greater than or equal to 1"),
    sets("a negative seed in the config", 2, "seed=-1", "seed", "-1", "greater than or equal to 0"),
    sets("a name that is no file name", 2, 'name="a/b"', "name", "'a/b'"),
    sets("an engine that is none", 2, "execute.engine=gpu", "'gpu'", "auto, compiled, python"),
    # parts
    sets("an unknown detector", 2, 'monitor.detectors=["page_hinkly"]', "'page_hinkly'", "did you mean 'page_hinkley'"),
    sets(
        "a schedule for a planner that takes none",
        2,
        'plan={name="bad_parts:Unscheduled", schedule={name="constant", epsilon=0.1}}',
        "'bad_parts:Unscheduled'",
        "no schedule",
        "'constant'",
        "Leave it out",
    ),
    sets("an unknown planner", 2, "plan=morfin", "'morfin'", "did you mean 'morphin'"),
    sets("an unknown schedule", 2, "plan.schedule=exponentail", "'exponentail'", "did you mean 'exponential'"),
    sets("an unknown learner", 2, "learner=sarsa", "'sarsa'", "expected_sarsa", "module:Class"),
    sets("an unknown analyzer", 2, "analyze=change", "'change'", "did you mean 'changes'"),
    sets("alpha_max below alpha", 2, ("plan.alpha=0.5", "plan.alpha_max=0.4"), "alpha_max = 0.4", "alpha = 0.5"),
    sets("an alpha above 1", 2, "plan.alpha=1.5", "alpha", "1.5", "less than or equal to 1"),
    sets(
        "a negative decay",
        2,
        'plan.schedule={name="exponential", decay=-0.1}',
        "decay",
        "-0.1",
        "greater than or equal to 0",
    ),
    sets(
        "a Page-Hinkley threshold of 0",
        2,
        'monitor.detectors=[{name="page_hinkley", threshold=0.0}]',
        "threshold",
        "0",
        "greater than 0",
    ),
    sets(
        "a detector on an unknown signal",
        2,
        'monitor.detectors=[{name="page_hinkley", signal="arrivals_1"}]',
        "'arrivals_1'",
        "return, steps, td_error, q_change",
    ),
    sets("an oracle out of order", 2, 'monitor.detectors=[{name="oracle", episodes=[5, 3]}]', "[5, 3]", "increasing"),
    sets(
        "a River detector that does not exist",
        2,
        'monitor.detectors=[{name="river", detector="ADWINN"}]',
        "'ADWINN'",
        "did you mean 'ADWIN'",
    ),
    sets("an enabled action that cannot be", 2, "plan.enable_on_drift=[3, 3]", "[3, 3]", "distinct"),
    # parts of one's own
    detector("a missing class", 2, "Gone", "'Gone'", "RaisingDetector"),
    sets("a missing module", 2, 'monitor.detectors=["no_such_module:Thing"]', "'no_such_module'", "no module"),
    sets("a module that raises on import", 2, "plan=explodes:Thing", "explodes:Thing", "RuntimeError", "boom"),
    sets("a module with a syntax error", 2, "plan=garbled:Thing", "garbled:Thing", "SyntaxError"),
    sets("a module that needs another", 2, "plan=needy:Thing", "needy:Thing", "'no_such_dependency'", "not installed"),
    sets("a part without a class", 2, "plan=bad_parts:", "'bad_parts:'", "module:Class"),
    sets(
        "a constructor that raises",
        2,
        'monitor.detectors=[{name="bad_parts:Picky", size=3}]',
        "bad_parts:Picky",
        "size 3 is odd",
    ),
    sets(
        "a constructor of other options",
        2,
        'monitor.detectors=[{name="bad_parts:Picky", weight=3}]',
        "bad_parts:Picky",
        "weight",
    ),
    detector(
        "a detector without methods",
        2,
        "Nothing",
        "bad_parts:Nothing",
        "direction, statistic, update, reset",
        "Detector in mape.ports",
    ),
    planner("a planner without methods", 2, "Nothing", "bad_parts:Nothing", "start, plan", "Planner in mape.ports"),
    sets("a learner without rules", 2, "learner=bad_parts:Nothing", "bad_parts:Nothing", "rate_names"),
    sets(
        "a schedule without methods",
        2,
        "plan.schedule=bad_parts:Nothing",
        "epsilon, advance, reset",
        "bad_parts:Nothing",
    ),
    sets("an analyzer without methods", 2, "analyze=bad_parts:Nothing", "has no analyze", "bad_parts:Nothing"),
    detector(
        "a detector that raises", 1, "RaisingDetector", "RaisingDetector", "ZeroDivisionError", "no variance", "pass 1"
    ),
    detector("a detector with a statistic of NaN", 1, "NanDetector", "NanDetector", "nan", "pass 1"),
    detector(
        "a detector with text as statistic", 1, "TextDetector", "TextDetector", "'high'", "finite number", "pass 1"
    ),
    detector("a detector of a side that is none", 1, "SidewaysDetector", "SidewaysDetector", "'sideways'"),
    planner("a planner with epsilon 2", 1, "EpsilonTwo", "EpsilonTwo", "2.0", "[0, 1]", "pass 2"),
    planner("a planner with epsilon NaN", 1, "EpsilonNan", "EpsilonNan", "nan", "[0, 1]", "pass 2"),
    planner("a planner with two learning rates", 1, "TwoRates", "(0.1, 0.2)", "pass 2", "takes 3 numbers"),
    planner("a planner with a learning rate of NaN", 1, "RateNan", "nan", "plan 2"),
    planner("a planner without a learning rate", 1, "RateNone", "RateNone", "None", "pass 2", "takes 3 numbers"),
    planner("a planner that adds a list of actions", 1, "AddsList", "AddsList", "[1]", "pass 2", "tuple", "int"),
    planner("a planner that drops an unknown action", 1, "DropsUnknown", "plan 2", "[17]", "(0, 1, 2, 3)"),
    planner("a planner that drops every action", 1, "DropsAll", "(0, 1, 2, 3)", "at least one"),
    planner("a planner that enables what is not in reserve", 1, "Enables", "plan 2", "(9,)", "reserve"),
    planner("a planner that adopts an unknown table", 1, "AdoptsUnknown", "plan 2", "abababababab"),
    planner("a planner that returns no plan", 1, "NoPlan", "NoPlan", "None", "ChangePlan", "pass 2"),
    planner("a planner that numbers its plan wrongly", 1, "WrongPass", "ChangePlan", "7"),
    planner("a planner that raises", 1, "RaisingPlanner", "RaisingPlanner", "KeyError", "budget", "pass 2"),
    planner("a planner that starts with a table", 1, "NoStart", "NoStart", "ChangePlan"),
    sets("a schedule with text as epsilon", 1, "plan.schedule=bad_parts:TextSchedule", "'high'", "[0, 1]"),
    sets(
        "an analyzer that raises",
        1,
        "analyze=bad_parts:RaisingAnalyzer",
        "RaisingAnalyzer",
        "LookupError",
        "no baseline",
    ),
    sets(
        "an analyzer that returns nothing",
        1,
        "analyze=bad_parts:SilentAnalyzer",
        "SilentAnalyzer",
        "None",
        "ChangeRequest",
    ),
    # the command line
    usage("a --set without =", "'episodes'", "KEY=VALUE", arguments=("--set", "episodes")),
    usage("a --set to an empty key", "'.alpha=1'", "KEY=VALUE", arguments=("--set", ".alpha=1")),
    usage("a --set below a number", "episodes", "integer", "got a table", arguments=("--set", "episodes.more=1")),
    usage("an unknown agent", "'on'", "did you mean 'one'", "[agents.NAME]", arguments=("--agent", "on")),
    usage("an unknown profile", "'fist'", "did you mean 'fast'", "[profiles.NAME]", arguments=("--profile", "fist")),
    usage("an agent with a mistake", "'q_lurning'", "did you mean 'q_learning'", arguments=("--agent", "broken")),
    usage("a malformed --show", "'x'", "FROM:TO", arguments=("--show", "x")),
    usage("a --show that runs backwards", "'5:3'", "FROM:TO", arguments=("--show", "5:3")),
    usage("a --show from 0", "'0:3'", "FROM:TO", arguments=("--show", "0:3")),
    usage("a --show beyond the run", "--show 2:7", "6 episodes", arguments=("--show", "2:7")),
    usage("a malformed --trace", "'1-5'", "FROM:TO", arguments=("--trace", "1-5")),
    usage("a --trace beyond the run", "--trace 7:7", "6 episodes", arguments=("--trace", "7")),
    usage("--trials 0", "'0'", "at least 1", arguments=("--trials", "0")),
    usage("--trials x", "'1.5'", "whole number", arguments=("--trials", "1.5")),
    usage("--workers 0", "'0'", "at least 1", arguments=("--workers", "0")),
    usage("--workers x", "'x'", "whole number", arguments=("--workers", "x")),
    usage("--seed -1", "'-1'", "at least 0", arguments=("--seed", "-1")),
    usage("a seed beyond 63 bits", "seed", str(2**63), arguments=("--seed", str(2**63))),
    usage("an unknown option", "--frobnicate", "--help", arguments=("--frobnicate",)),
    usage("--json into a missing folder", "'gone/x.json'", "no folder", arguments=("--json", "gone/x.json")),
    usage(
        "--json where nothing can be written",
        "'/proc/self/found.json'",
        "No such",
        "choose",
        arguments=("--json", "/proc/self/found.json"),
    ),
    usage("--json with a name that is too long", "x" * 300, "too long", arguments=("--json", "x" * 300)),
    usage(
        "--json into a folder with a name that is too long",
        "no folder",
        arguments=("--json", "x" * 300 + "/found.json"),
    ),
    Case("--out with a name that is too long", 1, ("x" * 300, "too long"), ("config.toml", "--out", "x" * 300)),
    usage("--json onto a folder", "'folder'", "is a folder", arguments=("--json", "folder")),
    Case(
        "--out below a regular file",
        1,
        ("config.toml/new", "cannot be written", "another place"),
        ("config.toml", "--out", "config.toml/new"),
    ),
    Case(
        "--out onto a regular file",
        2,
        ("config.toml", "is a file; name a folder"),
        ("config.toml", "--out", "config.toml"),
    ),
    other("an unknown command", 2, "'rum'", "did you mean 'run'?", command="rum", arguments=()),
    other(
        "reproduce of an unknown experiment",
        2,
        "'table2'",
        "table1",
        "jump",
        "traffic",
        command="reproduce",
        arguments=("table2",),
    ),
    other(
        "compare of one config without agents",
        2,
        "'run' alone",
        "[agents.NAME]",
        command="compare",
        arguments=("plain.toml",),
    ),
    other(
        "compare over different episodes",
        2,
        "number of episodes",
        "run 6, longer 7",
        "--set episodes=N",
        command="compare",
        arguments=("plain.toml", "longer.toml"),
    ),
    other(
        "compare of two configs of one name",
        2,
        "'plain-run'",
        "another name",
        command="compare",
        arguments=("plain.toml", "plain.toml", "plain.toml"),
    ),
    other(
        "compare with an unknown agent",
        2,
        "'thre'",
        "one",
        "two",
        command="compare",
        arguments=("config.toml", "--agents", "one,thre"),
    ),
    other(
        "compare with one agent",
        2,
        "'one' alone",
        "[agents.NAME]",
        command="compare",
        arguments=("config.toml", "--agents", "one"),
    ),
    other("compare with no agent", 2, "''", command="compare", arguments=("config.toml", "--agents", "")),
    other("compare of agents of which one is broken", 2, "'q_lurning'", command="compare", arguments=("config.toml",)),
    other(
        "compare of an agent that is no file name",
        2,
        "'../up'",
        "letters, digits",
        command="compare",
        arguments=("slash.toml",),
    ),
    # Gymnasium's systems
    sets(
        "an unknown system",
        2,
        'system={id="FrozenLak-v1"}',
        "'FrozenLak-v1'",
        "did you mean 'FrozenLake-v1'",
        "CartPole-v1",
        "registered Gymnasium id",
    ),
    sets("an unknown namespace", 2, 'system={id="mapec/Gridworld-v0"}', "'mapec/Gridworld-v0'", "mapek"),
    sets("an unknown version", 2, 'system={id="FrozenLake-v77"}', "'FrozenLake-v77'", "v1"),
    sets("a malformed id", 2, 'system={id="Frozen Lake!"}', "'Frozen Lake!'"),
    sets(
        "a system in a missing module",
        2,
        'system={id="no_such_module:Env-v0"}',
        "'no_such_module:Env-v0'",
        "'no_such_module'",
    ),
    sets("a system in a module that raises", 2, 'system={id="explodes:Env-v0"}', "explodes:Env-v0", "boom"),
    sets(
        "an option that the system does not have",
        2,
        'system={id="FrozenLake-v1", options={mapname="4x4"}}',
        "mapname",
        "FrozenLake-v1",
    ),
    sets(
        "real observations without bins",
        2,
        'system={id="CartPole-v1"}',
        "CartPole-v1",
        "4 dimensions",
        "system.discretise",
    ),
    sets(
        "bins of the wrong number of dimensions",
        2,
        'system={id="CartPole-v1", discretise={low=[0.0], high=[1.0], bins=[3]}}',
        "1 dimensions",
        "have 4",
    ),
    sets(
        "bins of unequal lists",
        2,
        'system={id="CartPole-v1", discretise={low=[0.0, 1.0], high=[1.0], bins=[3]}}',
        "2, 1 and 1",
    ),
    sets(
        "bins upside down",
        2,
        'system={id="CartPole-v1", discretise={low=[1.0], high=[0.0], bins=[3]}}',
        "low = 1.0",
        "high = 0.0",
    ),
    sets(
        "more states than fit",
        2,
        'system={id="CartPole-v1", discretise={low=[0.0,0.0,0.0,0.0], high=[1.0,1.0,1.0,1.0], bins=[999,999,999,999]}}',
        str(999**4),
        "fewer bins",
    ),
    sets(
        "bins for a table",
        2,
        'system={id="FrozenLake-v1", discretise={low=[0.0], high=[1.0], bins=[3]}}',
        "system.discretise",
        "Leave it out",
    ),
    sets("no step cap", 2, 'system={id="CliffWalking-v1"}', "CliffWalking-v1", "system.max_steps", "200"),
    sets("no step cap of one's own system", 2, 'system={id="bad_worlds:Endless-v0"}', "Endless-v0", "system.max_steps"),
    sets("continuous actions", 2, 'system={id="Pendulum-v1"}', "Pendulum-v1", "Discrete"),
    sets("no action space", 2, 'system={id="bad_worlds:NoSpace-v0"}', "NoSpace-v0", "Discrete"),
    sets(
        "compiled without rules",
        2,
        ('system={id="FrozenLake-v1"}', "execute.engine=compiled"),
        "'compiled'",
        "FrozenLake-v1",
        "'auto' or 'python'",
    ),
    # our own systems
    sets("a start on a wall", 2, GRID + "walls=[[0, 0]]", "(0, 0)", "wall"),
    sets("a start outside", 2, GRID + "start=[3, 0]", "(3, 0)", "outside the grid", "0..2"),
    sets("an unreachable goal", 2, GRID + "walls=[[1, 2], [2, 1], [1, 1]]", "(2, 2)", "cannot be reached"),
    sets("a slip of 1", 2, GRID + "slip=1.0", "slip is 1.0", "below 1"),
    sets("a reward that is text", 2, GRID + 'goal_reward="much"', "'much'", "number"),
    sets("negative rates", 2, TRAFFIC % "rates=[[-1.0, 2.0], [1.0, 1.0], [1.0, 1.0]]", "-1", "rates"),
    sets("fewer rates than switches", 2, TRAFFIC % "rates=[[1.0, 2.0]]", "rates", "switch_at"),
    sets("a service that is none", 2, TRAFFIC % "services=[[1, 2, 3]]", "services", "[1, 2, 3]"),
    sets(
        "an enabled action that is not there",
        1,
        (
            TRAFFIC % "switch_at=[2], rates=[[1.0, 1.0], [9.0, 9.0]]",
            "plan.enable_on_drift=[9]",
            'monitor.detectors=[{name="oracle", episodes=[2]}]',
        ),
        "9",
        "plan 2",
    ),
    # systems that break the contract under way
    world("nan reward", 1, "NanReward-v0", "reward nan", "episode 3", "2 passes"),
    world("infinite reward", 1, "InfiniteReward-v0", "reward -inf", "episode 3"),
    world("huge reward", 1, "episode 1 at step 3", "1.7e+308", "diverge", "Lower discount"),
    world("no actions", 1, "NoActions-v0", "no action", "at least one"),
    world("negative action", 1, "NegativeAction-v0", "action -1", "0 to 63", "begin at 0"),
    world("large action", 1, "LargeAction-v0", "action 64", "system.max_actions"),
    world("double action", 1, "DoubleAction-v0", "(0, 0, 1)"),
    world("other actions", 1, "OtherActions-v0", "(5, 6)", "(0, 1)", "at least one known action"),
    world("vanishing actions", 1, "VanishingActions-v0", "no action", "episode 3"),
    world("a state outside its space", 1, "OffTheMap-v0", "7", "Discrete(3)", "episode 3 at step 2", kind="OffTheMap"),
    world("text state", 1, "TextState-v0", "episode 1 at step 1", "'left'", "Discrete(3)"),
    world("a state between two", 1, "HalfState-v0", "1.5", "Discrete(3)", "episode 1 at step 1"),
    world("text reward", 1, "TextReward-v0", "reward '1.0'", "one real number", "episode 1 at step 1"),
    world("vector reward", 1, "VectorReward-v0", "reward [1.0]", "one real number", "episode 1 at step 1"),
    world("no reward", 1, "NoReward-v0", "reward None", "one real number", "episode 1 at step 1"),
    world("complex reward", 1, "ComplexReward-v0", "reward (1+2j)", "one real number", "episode 1 at step 1"),
    world("an end that is text", 1, "TextEnd-v0", "terminated = 'False'", "True or False", "episode 1 at step 1"),
    world("a mask of text", 1, "TextMask-v0", "info['action_mask']", "0 or 1", "episode 1"),
    world("a mask of zeros", 1, "ZeroMask-v0", "info['action_mask'] of [0, 0]", "info['legal_actions']", "episode 1"),
    world("no legal action", 1, "NoneLegal-v0", "info['legal_actions'] = ()", "one action at least", "episode 1"),
    world("an action between two", 1, "HalfAction-v0", "info['available_actions'] = (0, 1.5)", "0 .. 1", "episode 1"),
    world("text signal", 1, "TextSignal-v0", "signal 'load' = '3'", "real number", "episode 1 at step 1"),
    world("info that is none", 1, "NoInfo-v0", "info", "a dict", "episode 1"),
    world("an unknown action taken", 1, "StrangeGuard-v0", "info['action_taken'] = 7", "0 .. 1", "episode 1 at step 1"),
    world("a reset of the old kind", 1, "OldReset-v0", "from reset()", "(observation, info)", "episode 1", "0.26"),
    world("a strict reset", 1, "StrictReset-v0", "'episode'", "system.reset_takes = ['seed']", "episode 1"),
    sets(
        "a reset without options", 2, 'system={id="bad_worlds:Bare-v0"}', "no options", "system.reset_takes = ['seed']"
    ),
    sets(
        "more steps than there are",
        2,
        'system={id="bad_worlds:Fine-v0", max_steps=200}',
        "system.max_steps = 200",
        "after 20 steps",
        "max_episode_steps",
    ),
    sets("a backlog in lockstep", 2, "execute.backlog=7", "backlog = 7", "mode = 'free'"),
    sets("signal names in one text", 2, 'system={id="bad_worlds:OneName-v0"}', "signal_names = 'load'", "('load',)"),
    sets("a redrivable of text", 2, 'system={id="bad_worlds:SaysNo-v0"}', "redrivable = 'no'", "True or False"),
    sets(
        "bins too far apart",
        2,
        'system={id="CartPole-v1", discretise={low=[-1.7e308], high=[1.7e308], bins=[3]}}',
        "-1.7e+308",
        "too far apart",
    ),
    world(
        "an exception in reset",
        1,
        "RaisesInReset-v0",
        "the valve is stuck",
        "episode 3",
        "2 passes",
        kind="RaisesInReset",
    ),
    world(
        "an exception in step",
        1,
        "RaisesInStep-v0",
        "the valve is stuck",
        "episode 3 at step 2",
        "2 passes",
        kind="RaisesInStep",
    ),
    world("missing signal", 1, "MissingSignal-v0", "'load'", "info['signals']"),
    world("nan signal", 1, "NanSignal-v0", "load = nan", "finite"),
    world("a step of four values", 1, "Fourfold-v0", "episode 1", "terminated, truncated", "0.26", kind="Fourfold"),
    sets(
        "a system with an observation of NaN",
        1,
        'system={id="bad_worlds:NanObservation-v0", discretise={low=[0.0], high=[1.0], bins=[3]}}',
        "NanObservation-v0",
        "[nan]",
        "finite",
    ),
]


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small finished folder, made once."""
    from adapters.cli.main import main

    folder = tmp_path_factory.mktemp("earlier")
    (folder / "config.toml").write_text(CONFIG)
    out = folder / "out"
    assert main(["run", str(folder / "config.toml"), "--out", str(out), *QUIETLY]) == 0
    return out


@pytest.mark.parametrize("case", CASES, ids=[case.name.replace(" ", "-") for case in CASES])
def test_is_refused_in_one_clear_paragraph_and_nothing_earlier_is_touched(
    case: Case, mapek: Mapek, here: Path, earlier: Path
) -> None:
    (here / "config.toml").write_text(case.config)
    for name, text in {
        "explodes.py": "raise RuntimeError('boom')",
        "garbled.py": "def :",
        "needy.py": "import no_such_dependency",
        "bad.json": '{"episodes": 3,}',
        "list.json": "[1]",
        "nan.json": '{"episodes": 3, "system": {"id": "FrozenLake-v1"}, "plan": {"name": "morphin", "alpha": NaN}}',
        "plain.toml": CONFIG.split("[agents.one]")[0],
        "longer.toml": 'name = "longer"\n' + CONFIG.split("[agents.one]")[0].replace("episodes = 6", "episodes = 7"),
        "slash.toml": CONFIG.split("[agents.one]")[0] + '[agents.one]\n[agents."../up"]\n',
        "kept.json": "the result of an earlier run",
    }.items():
        (here / name).write_text(text)
    (here / "latin.toml").write_bytes(b"name = '\xe9'")
    (here / "folder").mkdir()
    arguments = [case.command, *case.arguments]
    if case.command != "rum":
        arguments += [word for word in QUIETLY if word != "--workers"][:2]
        arguments += [] if "--workers" in case.arguments else ["--workers", "1"]
        arguments += [] if "--json" in case.arguments else ["--json", "kept.json"]
        if "--out" not in case.arguments:
            arguments += ["--out", str(earlier) if case.code == 2 else "new"]
    before = contents(here), contents(earlier)

    code, out, err = mapek(*arguments)

    assert code == case.code, err
    assert [part for part in case.says if part not in err] == [], err
    assert "Traceback" not in err
    assert out == ""
    assert len(err) < 1500
    after = {name: digest for name, digest in contents(here).items() if "__pycache__" not in name}
    made = sorted(set(after) - set(before[0]))
    assert {name: after[name] for name in before[0]} == before[0]
    assert contents(earlier) == before[1]
    assert case.code == 1 or made == []
    # All that a failed run may leave of results is what it had of the broken trial, under that name.
    finished = [name for name in made if name.endswith((".part", "result.json", ".npz"))]
    assert [name for name in finished if not name.endswith("/broken-0.npz")] == []


def test_every_example_is_in_the_folder_to_which_the_message_about_a_missing_config_points() -> None:
    assert len(list(EXAMPLES.glob("*.toml"))) >= 7


def test_the_environment_whose_likes_are_refused_is_itself_accepted(mapek: Mapek, here: Path) -> None:
    (here / "config.toml").write_text(CONFIG)
    system = f'system={{id="{bad_worlds.__name__}:Fine-v0"}}'

    assert mapek("run", "config.toml", "--set", system, *QUIETLY).code == 0


@pytest.mark.parametrize("override", ["plan=bad_parts:Planned", 'monitor.detectors=["bad_parts:Quiet"]'])
def test_the_parts_whose_likes_are_refused_are_themselves_accepted(mapek: Mapek, here: Path, override: str) -> None:
    (here / "config.toml").write_text(CONFIG)

    assert mapek("run", "config.toml", "--set", override, *QUIETLY).code == 0
