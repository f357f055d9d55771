"""What `mapek compare` and `mapek reproduce` print and put into JSON beside it."""

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adapters.cli.main import main
from adapters.experiments import paper
from mape.config import load
from mape.config_files import shipped

SMALL = ("--workers", "1", "--no-figures")


def run(tmp_path: Path, capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[str, Any]:
    """Return what a command printed, and its JSON."""
    out = ["--out", str(tmp_path / "out"), "--json", str(tmp_path / "found.json")]
    assert main([*(str(a) for a in arguments), *SMALL, *out]) == 0
    return capsys.readouterr().out, json.loads((tmp_path / "found.json").read_text())


def test_compare_prints_the_paired_interval_effect_and_p_and_keeps_all_in_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    goals = shipped()["gridworld_goals"]
    said, found = run(
        tmp_path, capsys, "compare", goals, "--trials", 5, "--set", "episodes=40", "--agents", "morphin,q_learning"
    )

    against = found["agents"]["q_learning"]["against_first"]
    assert set(against) == {
        "difference", "interval", "ratio", "ratio_interval", "hedges_g", "t", "df", "p", "p_holm",
        "paired_effect", "paired_t", "paired_df", "paired_p", "paired_p_holm",
    }  # fmt: skip
    assert against["paired_df"] == 4
    (header,) = (line for line in said.splitlines() if "difference" in line and "paired p (Holm)" in line)
    (row,) = (line for line in said.split(header)[1].splitlines() if line.startswith("q_learning"))
    assert row.split()[1] == f"{against['difference']:+,.0f}"
    assert row.split()[2:4] == "[{:+,.0f}, {:+,.0f}]".format(*against["interval"]).split()
    assert row.split()[4] == f"{against['paired_effect']:+.2f}"
    assert row.split()[5] == f"{against['t']:.2f}"
    assert row.split()[6] == f"{against['paired_p_holm']:.2g}"
    assert len(row) == len(header)


def test_the_goals_example_has_the_agents_that_the_claims_are_about() -> None:
    goals = shipped()["gridworld_goals"]
    plain, fixed = (load(goals, agent=agent) for agent in ("q_learning_alpha_09", "fixed_alpha_09"))
    tuned, morphin = load(goals, agent="q_learning"), load(goals, agent="morphin")

    assert (plain.plan.name, plain.plan.alpha, plain.monitor.detectors) == ("q_learning", 0.9, tuned.monitor.detectors)
    assert plain.plan.schedule == tuned.plan.schedule
    assert (fixed.plan.name, fixed.plan.alpha, fixed.plan.alpha_max) == ("morphin", 0.9, 0.9)
    assert (fixed.monitor, fixed.plan.schedule) == (morphin.monitor, morphin.plan.schedule)


def test_a_mean_is_held_against_the_paper_in_its_deviations_and_in_our_standard_errors() -> None:
    found = np.array([8.0, 10.0, 12.0, 14.0])

    distance = paper.against(found, paper.Printed(mean=10.0, sd=4.0))
    assert distance["d"] == pytest.approx(0.25)
    assert distance["z"] == pytest.approx(1.0 / (math.sqrt(20 / 3) / 2))


@pytest.mark.parametrize("found", [[], [3.0], [3.0, 3.0]])
def test_a_sample_without_spread_has_no_z(found: list[float]) -> None:
    distance = paper.against(np.array(found), paper.Printed(mean=10.0, sd=4.0))

    assert distance == {"d": -1.75 if found else None, "z": None}
    assert paper.against(np.array(found), None) == {"d": None, "z": None}


@pytest.mark.parametrize(("trials", "episodes"), [(1, 1500), (4, 1500), (2, 8000)])
def test_table1_is_aligned_and_narrow_and_says_d_z_recovery_and_delay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], trials: int, episodes: int
) -> None:
    said, found = run(tmp_path, capsys, "reproduce", "table1", "--trials", trials, "--set", f"episodes={episodes}")

    lines = said.split("log: ")[0].splitlines()
    assert max(len(line) for line in lines) <= 110
    headers = [line for line in lines if line.endswith(f"{'d':>7}{'z':>8}")]
    assert len(headers) == 2
    columns = [match.end() for match in re.finditer(r"\S+(?: \S+)*", headers[0])]
    rows = [line for line in lines if re.match("  (total|stage)", line)]
    assert len(rows) == 12
    for row in rows:
        # A cell ends where its heading does.
        ends = {match.end() for match in re.finditer(r"\S+(?: \S+)*", row)} - {len("  total steps"), len("  stage 1")}
        assert ends <= set(columns), row
    morphin, baseline = found["agents"]["morphin"], found["agents"]["q_learning"]
    for total in (morphin["total_steps"], baseline["total_steps"]):
        assert (total["z"] is None) == (trials == 1)
    total = morphin["total_steps"]
    assert total["d"] == pytest.approx((total["mean"] - 23_292.07) / (0.0633 * 23_292.07))
    if trials > 1:
        assert total["z"] == pytest.approx((total["mean"] - 23_292.07) / (total["sd"] / math.sqrt(trials)))
        assert f"{total['z']:+.1f}" in rows[0]
    for stage in (*morphin["stages"], *baseline["stages"]):
        assert 0 <= stage["performance_share"] <= 1
        assert {"d", "z"} <= set(stage)
    assert [stage["performance_share"] for stage in morphin["stages"]] == [1.0] * 5
    assert found["paired"]["df"] == (None if trials == 1 else trials - 1)
    assert any(re.match("d: .*paper's standard deviations", line) for line in lines)
    assert any(re.match(r"z: .*our standard errors", line) for line in lines)


def test_a_drift_is_named_by_the_last_episode_before_it_so_that_alarm_minus_drift_is_the_delay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said, found = run(tmp_path, capsys, "reproduce", "table1", "--trials", 1)

    table = said.split("drift after episode")[1].splitlines()[2:6]
    assert [line.split()[0] for line in table] == ["300", "600", "900", "1200"]
    assert [float(line.split()[2]) for line in table] == [drift["delay_mean"] for drift in found["detection"]]
    assert "until the alarm, the alarm's own included" in said


def test_traffic_names_a_drift_by_the_last_episode_before_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said, _ = run(
        tmp_path, capsys, "reproduce", "traffic", "--trials", 1, "--set", "episodes=60",
        "--set", "system.options.switch_at=[21, 41]",
    )  # fmt: skip

    assert "agent, drift after" in said
    assert re.findall(r"^(20|21|40|41)\s", said, re.MULTILINE)[:2] == ["20", "40"]
    assert "until the alarm, the alarm's own included" in said
