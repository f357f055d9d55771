"""What --json promises: its fields, numbers that are numbers, and hashes that depend on config and seed alone."""

import re

import pytest
from command_line import EXAMPLES, Mapek, strict_json

import adapters.experiments.runner

GOALS = EXAMPLES / "gridworld_goals.toml"
SHA256 = re.compile(r"[0-9a-f]{64}")
PIPED = ("--no-figures", "-q", "--json", "-")


def test_run_says_passes_trials_and_hashes(mapek: Mapek) -> None:
    found = mapek("run", GOALS, "--set", "episodes=350", "--trials", 2, "--workers", 1, *PIPED).json

    assert set(found) == {"name", "passes", "seed", "trials", "log_sha256", "q_table_sha256"}
    assert (found["name"], found["passes"], found["seed"]) == ("gridworld_goals", 350, 0)
    assert [trial["trial"] for trial in found["trials"]] == [0, 1]
    for trial in found["trials"]:
        assert set(trial) == {"trial", "alarms", "total_steps", "log_sha256", "q_table_sha256"}
        # The goal has moved before episode 301; no alarm can be later than the last episode.
        assert trial["alarms"] == sorted(trial["alarms"])
        assert [alarm for alarm in trial["alarms"] if 301 <= alarm <= 310] != []
        assert trial["alarms"][-1] <= 350
        assert 350 * 8 < trial["total_steps"] <= 350 * 37
        assert SHA256.fullmatch(trial["log_sha256"])
        assert SHA256.fullmatch(trial["q_table_sha256"])
    assert SHA256.fullmatch(found["log_sha256"])
    assert SHA256.fullmatch(found["q_table_sha256"])
    assert found["log_sha256"] != found["trials"][0]["log_sha256"]


@pytest.mark.parametrize(("trials", "episodes"), [(1, 1500), (3, 5), (1, 1)])
def test_reproduce_table1_says_stages_and_detection_with_null_where_there_is_no_number(
    mapek: Mapek, trials: int, episodes: int
) -> None:
    found = mapek(
        "reproduce", "table1", "--trials", trials, "--set", f"episodes={episodes}", "--workers", 1, *PIPED
    ).json

    stages = 5 if episodes == 1500 else 1
    assert (found["profile"], found["trials"]) == ("reference", trials)
    assert set(found["agents"]) == {"morphin", "q_learning"}
    for agent in found["agents"].values():
        assert agent["total_steps"]["mean"] >= 8 * episodes
        assert (agent["total_steps"]["sd"] is None) == (trials == 1)
        assert len(agent["stages"]) == stages
        for stage in agent["stages"]:
            assert 0 <= stage["share"] <= 1
            assert (stage["mean"] is None) == (stage["share"] == 0)
            assert stage["sd"] is None or trials > 1
    assert found["agents"]["q_learning"]["stages"][-1]["share"] == 0
    assert found["ratio"] == pytest.approx(
        found["agents"]["q_learning"]["total_steps"]["mean"] / found["agents"]["morphin"]["total_steps"]["mean"]
    )
    assert len(found["detection"]) == stages - 1
    for drift in found["detection"]:
        assert set(drift) >= {"recall", "delay_mean", "false_alarms"}
        assert (drift["recall"], drift["false_alarms"] >= 0) == (1, True)
        assert 1 <= drift["delay_mean"] <= 20
    assert found["detection_initial"] >= 0
    assert SHA256.fullmatch(found["log_sha256"])
    assert SHA256.fullmatch(found["q_table_sha256"])


def test_reproduce_table1_in_the_profile_paper_says_so_and_finds_something_else(mapek: Mapek) -> None:
    options = ("--trials", 1, "--set", "episodes=400", "--workers", 1, *PIPED)
    reference = mapek("reproduce", "table1", *options).json
    paper = mapek("reproduce", "table1", "--profile", "paper", *options)

    assert paper.json["profile"] == "paper"
    assert paper.json["log_sha256"] != reference["log_sha256"]
    assert "Algorithm 1 as printed" in paper.err


def test_reproduce_traffic_says_a_curve_by_episode_and_the_detection_of_both_drifts(mapek: Mapek) -> None:
    found = mapek(
        "reproduce", "traffic", "--trials", 1, "--workers", 1, *PIPED,
        # A tenth of the paper's length: the first drift is met before the second comes.
        "--set", "episodes=1000", "--set", "system.options.switch_at=[301, 801]",
    ).json  # fmt: skip

    assert set(found["agents"]) == {"morphin", "q_learning", "same_actions", "three_actions"}
    for agent in found["agents"].values():
        assert set(agent["curve"]) == {"500"}
        assert -1000 < agent["curve"]["500"] < -200
        assert len(agent["detection"]) == 2
    assert (
        found["agents"]["q_learning"]["detection"]
        == [{"recall": 0, "delay_mean": None, "delay_median": None, "false_alarms": 0}] * 2
    )
    assert found["agents"]["morphin"]["detection"][0]["recall"] == 1


@pytest.mark.parametrize(
    ("more", "trials"), [(("--set", "trials=3"), 3), (("--set", "trials=3", "--trials", 2), 2), (("--trials", 1), 1)]
)
def test_reproduce_has_its_own_number_of_trials_only_where_none_is_given(
    mapek: Mapek, more: tuple[object, ...], trials: int
) -> None:
    found = mapek("reproduce", "jump", "--set", "episodes=2", *more, "--workers", 1, "--no-statistics", *PIPED)

    assert found.json["trials"] == trials


@pytest.mark.parametrize("experiment", ["traffic", "jump"])
def test_numbers_found_before_are_said_to_be_of_unchanged_settings(mapek: Mapek, experiment: str) -> None:
    some = ("reproduce", experiment, "--trials", 1, "--workers", 1, "--no-figures", "-q", "--json", "-")
    changed = mapek(*some, "--set", "episodes=20", "--set", "learner.discount=0.1").err

    assert "before: found earlier with these settings" not in changed
    assert "before: found earlier with the experiment's own settings, not these, over" in changed
    assert "nan" not in changed


def test_reproduce_jump_says_steps_before_and_after_and_the_share_of_optimal_paths(mapek: Mapek) -> None:
    found = mapek("reproduce", "jump", "--trials", 2, "--workers", 1, *PIPED).json

    assert set(found["agents"]) == {"morphin", "success_rule", "fixed_alpha", "q_learning"}
    for agent in found["agents"].values():
        assert set(agent) == {"steps_before", "steps_after", "optimal_share"}
        assert 16 <= agent["steps_before"] < 30
        assert 5 <= agent["steps_after"] < 30
    assert found["agents"]["morphin"]["steps_after"] < 10 < found["agents"]["q_learning"]["steps_after"]
    assert found["agents"]["q_learning"]["optimal_share"] == 0
    assert found["shortest_path"] == 5


@pytest.mark.parametrize("episodes", [1, 310])
def test_reproduce_jump_of_another_length_still_gives_numbers(mapek: Mapek, episodes: int) -> None:
    outcome = mapek("reproduce", "jump", "--trials", 1, "--set", f"episodes={episodes}", "--workers", 1, *PIPED)

    assert outcome.code == 0, outcome.err
    for agent in outcome.json["agents"].values():
        assert agent["steps_after"] >= 5
        assert agent["steps_before"] is None or agent["steps_before"] >= 5
        assert 0 <= agent["optimal_share"] <= 1


@pytest.mark.parametrize("trials", [1, 2])
def test_compare_gives_null_for_what_a_sample_cannot_say(mapek: Mapek, trials: int) -> None:
    found = mapek("compare", GOALS, "--set", "episodes=30", "--trials", trials, "--workers", 1, *PIPED).json

    assert found["first"] == "morphin"
    assert list(found["agents"]) == [
        "morphin", "q_learning", "tuned_q_learning", "q_learning_alpha_09", "fixed_alpha", "fixed_alpha_09",
        "no_detector", "oracle_detector",
    ]  # fmt: skip
    assert "against_first" not in found["agents"]["morphin"]
    tuned = found["agents"]["tuned_q_learning"]
    assert tuned["against_first"]["difference"] == pytest.approx(
        tuned["total_return"]["mean"] - found["agents"]["morphin"]["total_return"]["mean"]
    )
    assert (tuned["against_first"]["p"] is None) == (trials == 1)
    # Without an alarm in thirty episodes a detector changes nothing, and two equal samples have no ratio to speak of.
    assert found["agents"]["no_detector"]["log_sha256"] != found["agents"]["morphin"]["log_sha256"]
    assert found["agents"]["no_detector"]["q_table_sha256"] == found["agents"]["morphin"]["q_table_sha256"]
    assert found["agents"]["no_detector"]["against_first"]["difference"] == 0


@pytest.mark.parametrize("command", [("run", GOALS), ("reproduce", "table1"), ("compare", GOALS)])
def test_a_file_gets_the_same_json_as_standard_output_and_as_the_folder(
    mapek: Mapek, command: tuple[object, ...]
) -> None:
    small = ("--set", "episodes=4", "--trials", 2, "--workers", 1, "--no-figures", "-q")
    to_file = mapek(*command, *small, "--json", "found.json", "--out", "out")
    piped = mapek(*command, *small, "--json", "-").json

    with open("found.json", encoding="utf-8") as file, open("out/result.json", encoding="utf-8") as kept:
        written, inside = strict_json(file.read()), strict_json(kept.read())
    assert written == piped
    assert {key: inside[key] for key in written} == written
    assert {"command", "versions", "files", "sha256"} == set(inside) - set(written)
    assert "results:  out" in to_file.out


def test_hashes_are_the_same_however_the_trials_are_divided(mapek: Mapek, monkeypatch: pytest.MonkeyPatch) -> None:
    def hashes(workers: int, chunk_seconds: float) -> object:
        monkeypatch.setattr(adapters.experiments.runner, "CHUNK_SECONDS", chunk_seconds)
        found = mapek("run", GOALS, "--set", "episodes=40", "--trials", 5, "--workers", workers, *PIPED).json
        return found["log_sha256"], found["q_table_sha256"], found["trials"]

    together = hashes(workers=1, chunk_seconds=60)
    assert hashes(workers=1, chunk_seconds=1e-9) == together
    assert hashes(workers=2, chunk_seconds=40 * 20e-6 * 2) == together


def test_trials_do_not_depend_on_how_many_there_are(mapek: Mapek) -> None:
    few, more = (
        mapek("run", GOALS, "--set", "episodes=20", "--trials", trials, "--workers", 1, *PIPED).json
        for trials in (2, 4)
    )

    assert more["trials"][:2] == few["trials"]
    assert len({trial["log_sha256"] for trial in more["trials"]}) == 4


# FrozenLake's reward is rare; its Q-table is all zeros for some time.
@pytest.mark.parametrize(
    ("example", "episodes"), [("gridworld_goals", 30), ("traffic", 30), ("frozen_lake", 150), ("taxi", 10)]
)
def test_the_same_seed_gives_the_same_hashes_and_another_seed_others(mapek: Mapek, example: str, episodes: int) -> None:
    def hashes(seed: int) -> tuple[str, str]:
        found = mapek("run", EXAMPLES / f"{example}.toml", "--set", f"episodes={episodes}", "--seed", seed, *PIPED).json
        return found["log_sha256"], found["q_table_sha256"]

    first = hashes(7)
    assert hashes(7) == first
    assert not set(hashes(8)) & set(first)


def test_the_config_beside_a_result_gives_the_same_result_again(mapek: Mapek) -> None:
    first = mapek(
        "run", GOALS, "--agent", "fixed_alpha", "--set", "episodes=30", "--seed", 5, "--out", "first", *PIPED
    ).json
    again = mapek("run", "first/config-fixed_alpha.json", *PIPED).json

    assert again == first
