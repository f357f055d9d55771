"""What `mapek compare` says: which agent is wrong, how many trials run, and numbers with the decimals they need."""

import re
from pathlib import Path

import pytest
from command_line import EXAMPLES, Mapek, strict_json

GOALS = EXAMPLES / "gridworld_goals.toml"
TRAFFIC = EXAMPLES / "traffic.toml"
QUIETLY = ("-q", "--workers", 1, "--no-figures")
PAIR = ("--agents", "morphin,q_learning")
SHORT = (*PAIR, "--set", "episodes=5")
CELL = re.compile(r"\S+(?: \S+)*")


def rewarded(here: Path, reward: float) -> Path:
    """A config of two agents in a world whose rewards are of this size."""
    path = here / "small.toml"
    path.write_text(
        'name = "small"\nepisodes = 9\n[system]\nid = "mapek/Gridworld-v0"\n[system.options]\nsize = [3, 3]\n'
        f"start = [0, 0]\ngoals = [[0, 2]]\nstep_reward = {-reward / 10}\ngoal_reward = {reward}\nmax_steps = 20\n"
        "[agents.a]\n[agents.b.plan.schedule]\nname = 'constant'\nepsilon = 0.9\n"
    )
    return path


def tables(said: str) -> list[list[str]]:
    """The two tables of numbers, line by line with their headings."""
    found, lines = [], said.splitlines()
    for at, line in enumerate(lines):
        if "95 % interval" in line:
            stop = next(i for i in range(at, len(lines)) if not lines[i].strip())
            found.append(lines[at:stop])
    return found


@pytest.mark.parametrize(("value", "said"), [("3", "agents is a table of tables"), ("true", r"[agents.NAME]")])
def test_agents_that_are_no_tables_are_refused_in_a_sentence(mapek: Mapek, here: Path, value: str, said: str) -> None:
    (here / "bad.toml").write_text(f"agents = {value}\nepisodes = 5\n[system]\nid = 'mapek/Gridworld-v0'\n")
    outcome = mapek("compare", "bad.toml", *QUIETLY)

    assert outcome.code == 2
    assert said in outcome.err


def test_an_option_that_one_agent_does_not_have_names_the_agent(mapek: Mapek) -> None:
    outcome = mapek("compare", GOALS, *PAIR, "--set", "plan.k=3.0", *QUIETLY)

    assert outcome.code == 2
    assert "agent q_learning: plan.k: no such option" in outcome.err


@pytest.mark.parametrize(
    ("options", "trials"),
    [
        ((), "30 trials"),
        (("--set", "trials=1"), "1 trial"),
        (("--set", "trials=3"), "3 trials"),
        (("--set", "trials=3", "--trials", 2), "2 trials"),
    ],
)
def test_the_number_of_trials_that_is_set_is_run(mapek: Mapek, options: tuple[object, ...], trials: str) -> None:
    outcome = mapek("compare", GOALS, *SHORT, *options, *QUIETLY)

    assert outcome.code == 0, outcome.err
    assert f"2 agents, {trials} of 5 episodes each, seed 0\n" in outcome.out


def test_the_number_of_trials_of_a_file_is_run_if_it_says_one(mapek: Mapek, here: Path) -> None:
    for number in (1, 2):
        (here / "own.toml").write_text(
            f"extends = '{GOALS}'\ntrials = {number}\nepisodes = 1\n[agents.a]\n[agents.b]\nplan = 'q_learning'\n"
        )
        outcome = mapek("compare", "own.toml", "--agents", "a,b", *QUIETLY)
        assert outcome.code == 0, outcome.err
        said = {1: "1 trial of 1 episode each", 2: "2 trials of 1 episode each"}[number]
        assert f"2 agents, {said}, seed 0\n" in outcome.out


def test_columns_do_not_touch_however_large_the_numbers_are(mapek: Mapek, here: Path) -> None:
    for config in (("compare", rewarded(here, 1e15)), ("compare", TRAFFIC, "--set", "episodes=600")):
        outcome = mapek(*config, "--trials", 3, *QUIETLY)
        assert outcome.code == 0, outcome.err
        for heading, *rows in tables(outcome.out):
            ends = [match.end() for match in CELL.finditer(heading)]
            for row in rows:
                assert len(row) == len(heading)
                # Under each heading one number, and between two of them at least a space more than within one.
                starts = [match.start() for match in re.finditer(r"(?<=  )\S", row)]
                assert len(starts) == len(ends), row
                assert all(row[end - 1] != " " and row[end : end + 2] in ("", "  ") for end in ends), row


@pytest.mark.parametrize("reward", [5.0, 0.05, 5e-9])
def test_small_numbers_are_rounded_to_less_than_what_is_known_of_them(mapek: Mapek, here: Path, reward: float) -> None:
    outcome = mapek("compare", rewarded(here, reward), "--trials", 5, "--json", "found.json", *QUIETLY)

    assert outcome.code == 0, outcome.err
    returns, against = tables(outcome.out)
    found = strict_json((here / "found.json").read_text())["agents"]
    for row in returns[1:]:
        agent, mean, _, sd, low, high = re.sub(r"[][,]", " ", row).split()[:6]
        total = found[agent]["total_return"]
        rounding = (total["interval"][1] - total["interval"][0]) / 4
        assert [float(mean), float(sd)] == pytest.approx([total["mean"], total["sd"]], abs=rounding, rel=0.0)
        assert [float(low), float(high)] == pytest.approx(total["interval"], abs=rounding, rel=0.0)
    difference, low, high = re.sub(r"[][,]", " ", against[1]).split()[1:4]
    found = found["b"]["against_first"]
    rounding = (found["interval"][1] - found["interval"][0]) / 4
    assert float(difference) == pytest.approx(found["difference"], abs=rounding, rel=0.0)
    assert [float(low), float(high)] == pytest.approx(found["interval"], abs=rounding, rel=0.0)


def test_equal_agents_differ_by_nothing_and_not_by_minus_nothing(mapek: Mapek, here: Path) -> None:
    text = rewarded(here, 0.5).read_text().split("[agents.a]")[0]
    (here / "equal.toml").write_text(f"{text}[agents.a]\n[agents.b]\n")
    outcome = mapek("compare", "equal.toml", "--trials", 5, *QUIETLY)

    assert outcome.code == 0, outcome.err
    assert tables(outcome.out)[1][1].split()[:3] == ["b", "+0", "-"]
