"""`mapek compare` holds against one another what can be: by trial, as samples, or not at all; and says which."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from command_line import EXAMPLES, Mapek
from scipy import stats

from adapters.experiments.statistics import compare
from adapters.results import read_episodes

GOALS = EXAMPLES / "gridworld_goals.toml"
QUIETLY = ("-q", "--workers", 1, "--no-figures", "--trials", 4)
WORDS = re.compile(r"same seeds|paired by|paired p")

WORLD = """\
name = "NAME"
episodes = 3
[system]
id = "mapek/Gridworld-v0"
max_steps = 20
[system.options]
size = [3, 3]
start = [0, 0]
goals = [[0, 2]]
slip = 0.1
"""


def files(here: Path, **edits: tuple[str, str]) -> list[str]:
    """Two configs or more, each with one line in the place of another."""
    for name, (old, new) in {"one": ("", ""), **edits}.items():
        (here / f"{name}.toml").write_text(WORLD.replace("NAME", name).replace(old, new, 1))
    return [f"{name}.toml" for name in ("one", *edits)]


def compared(here: Path, mapek: Mapek, *arguments: object) -> tuple[str, dict]:
    outcome = mapek("compare", *arguments, *QUIETLY, "--json", "found.json", "--out", "out")
    assert outcome.code == 0, outcome.err
    return outcome.out, json.loads((here / "found.json").read_text())["agents"]


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (("slip = 0.1", "slip = 0.2"), "system.options.slip is 0.1 of the first and 0.2 of this one"),
        (("max_steps = 20", "max_steps = 10"), "system.max_steps is 20 of the first and 10 of this one"),
        (("[[0, 2]]", "[[2, 2]]"), "system.options.goals"),
        (('id = "mapek/Gridworld-v0"', 'id = "mapek/TrafficJunction-v0"\n[other]'), "system.id"),
    ],
)
def test_agents_of_two_systems_have_no_statistics_across_them(
    edit: tuple[str, str], says: str, here: Path, mapek: Mapek
) -> None:
    paths = files(here, two=edit, same=("", ""))
    if "Traffic" in edit[1]:
        text = (here / "two.toml").read_text().partition("[other]")[0]
        (here / "two.toml").write_text(text)
    out, found = compared(here, mapek, *paths)

    assert "against_first" not in found["two"]
    assert found["two"]["pairing"]["kind"] == "apart"
    assert says in out
    # The third one is of the first one's system, and is held against it as ever.
    assert found["same"]["pairing"]["kind"] == "paired"
    assert found["same"]["against_first"]["difference"] == 0.0


def test_of_two_systems_alone_no_p_is_printed_at_all(here: Path, mapek: Mapek) -> None:
    out, _ = compared(here, mapek, *files(here, two=("slip = 0.1", "slip = 0.2")))

    assert not WORDS.search(out)
    assert "Welch" not in out


@pytest.mark.parametrize("redrivable", [None, "system.redrivable=false"])
def test_a_plant_that_no_seed_reaches_is_not_said_to_be_paired(
    redrivable: str | None, here: Path, mapek: Mapek
) -> None:
    (here / "plant.py").write_text(
        "import random\n\nimport gymnasium\nfrom gymnasium.spaces import Discrete\n\n\n"
        "class Plant(gymnasium.Env):\n"
        "    observation_space, action_space = Discrete(1), Discrete(2)\n"
        f"    redrivable = {redrivable is not None}\n\n"
        "    def reset(self, *, seed=None, options=None):\n"
        "        super().reset(seed=seed)\n"
        "        return 0, {}\n\n"
        "    def step(self, action):\n"
        "        return 0, random.random() + action, True, False, {}\n\n\n"
        "gymnasium.register('Plant-v0', Plant, max_episode_steps=1)\n"
    )
    (here / "plant.toml").write_text("episodes = 4\nsystem.id = 'plant:Plant-v0'\n[agents.a]\n[agents.b]\n")
    settings = () if redrivable is None else ("--set", redrivable)
    out, found = compared(here, mapek, "plant.toml", *settings)

    assert not WORDS.search(out)
    assert "no seed reaches its luck" in out
    against = found["b"]["against_first"]
    assert (found["b"]["pairing"]["kind"], against["paired_p"]) == ("independent", None)
    a, b = (read_episodes(here / "out" / f"episodes-{x}.npz", ["return"])["return"].sum(axis=1) for x in "ab")
    assert against["p"] == pytest.approx(stats.ttest_ind(b, a, equal_var=False).pvalue)
    assert against["p_holm"] == pytest.approx(against["p"])
    assert f"{against['p']:.2g}" in out


def test_a_table_that_is_played_and_an_environment_share_no_luck(here: Path, mapek: Mapek) -> None:
    for name in ("plain", "table"):
        tabulated = str(name == "table").lower()
        (here / f"{name}.toml").write_text(
            f"name = '{name}'\nepisodes = 3\nsystem = {{ id = 'FrozenLake-v1', tabulated = {tabulated} }}\n"
        )
    _, found = compared(here, mapek, "plain.toml", "table.toml")

    assert found["table"]["pairing"]["kind"] == "independent"


def test_two_seeds_are_not_compared_at_all(here: Path, mapek: Mapek) -> None:
    outcome = mapek("compare", *files(here, two=("episodes = 3", "episodes = 3\nseed = 1")), *QUIETLY)

    assert outcome.code == 2
    assert "one 0, two 1. Give --seed N." in outcome.err


def test_an_interval_of_independent_samples_is_that_of_scipy() -> None:
    first, second = np.array([10.0, 12.0, 9.0, 11.0, 13.0, 10.5]), np.array([15.0, 14.0, 18.0, 16.5, 13.5, 30.0])
    found = compare(first, second, paired=False)
    expected = stats.bootstrap(
        (first, second),
        lambda x, y, axis: y.mean(axis=axis) - x.mean(axis=axis),
        n_resamples=4999,
        rng=np.random.default_rng(0),
        batch=500,
    ).confidence_interval

    assert found.interval == pytest.approx((expected.low, expected.high))
    assert (found.paired_effect, found.paired_t, found.paired_df, found.paired_p) == (None,) * 4


@pytest.mark.parametrize(("trials", "few"), [(2, True), (9, True), (10, False)])
def test_statistics_of_few_trials_say_so(trials: int, few: bool, mapek: Mapek) -> None:
    for command in (("compare", GOALS, "--agents", "morphin,q_learning"), ("reproduce", "table1")):
        outcome = mapek(*command, "--set", "episodes=5", "--trials", trials, "-q", "--workers", 1, "--no-figures")
        assert outcome.code == 0, outcome.err
        assert (f"{trials} trials are few" in outcome.out) == few


def test_what_stands_behind_the_plus_and_minus_is_named(mapek: Mapek) -> None:
    for command in (("compare", GOALS, "--agents", "morphin,q_learning"), ("run", GOALS), ("reproduce", "table1")):
        outcome = mapek(*command, "--set", "episodes=5", *QUIETLY)
        assert outcome.code == 0, outcome.err
        assert outcome.out.index("± standard deviation over the trials") > outcome.out.index(" ± ")


def test_a_file_compares_the_agents_of_the_file_that_it_extends(here: Path, mapek: Mapek) -> None:
    (here / "more.toml").write_text(f'extends = "{GOALS}"\nepisodes = 3\n')
    _, found = compared(here, mapek, "more.toml", "--agents", "morphin,tuned_q_learning")

    assert list(found) == ["morphin", "tuned_q_learning"]
