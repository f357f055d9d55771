"""A log is derived again record by record; what differs is named, what is missing too."""

import json
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from replay_logs import change, edited, places, reseal, small, write_free_log, write_log

from adapters.cli.main import main
from adapters.replay.records import LogReplay, Replayed
from adapters.stores import Store
from adapters.stores.mark import mark_path
from adapters.systems import make_system
from knowledge import STAGES
from mape.config import Config
from mape.errors import ConfigError, ResultsError
from mape.loop import Loop

CONFIG = small()
PLACES = places(CONFIG)
FREE = small(execute={"engine": "python", "mode": "free", "rate": 100.0})
ONCE = small(system={**json.loads(CONFIG.to_json())["system"], "redrivable": False})


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "log.sqlite"
    write_log(path, CONFIG)
    return path


def copied(log: Path, folder: Path) -> Path:
    path = folder / "changed.sqlite"
    path.unlink(missing_ok=True)
    source, target = sqlite3.connect(log), sqlite3.connect(path)
    source.backup(target)
    source.close()
    target.close()
    shutil.copy(mark_path(log), mark_path(path))
    return path


def replayed(path: Path, loop: int = 0, to: int | None = None) -> Replayed:
    with Store(path, readonly=True) as store:
        return LogReplay(store).replay(loop, to=to)


def run_again(config: Config, unit: int = 0, passes: int | None = None) -> Loop:
    loop = Loop(config, make_system(config.system), *divmod(unit, config.loops))
    loop.run(config.episodes if passes is None else passes)
    return loop


def test_a_log_is_the_run_of_its_config(log: Path) -> None:
    loop = run_again(CONFIG)

    found = replayed(log)

    assert found.difference is None
    assert (found.records, found.passes, found.ended, found.fed) == (49, 12, True, False)
    assert (found.log_sha256, found.q_table_sha256) == (loop.log.sha256(), loop.execute.q_table.sha256())


@given(place=st.sampled_from(PLACES))
def test_a_record_that_was_changed_is_named_with_its_field_and_both_values(
    log: Path, tmp_path_factory: pytest.TempPathFactory, place: tuple[int, int]
) -> None:
    number, stage = place
    path = copied(log, tmp_path_factory.getbasetemp())
    with Store(path, readonly=True) as store:
        body = json.loads(str(store.body(0, number, stage)))
    field, value = [("steps", 7777), ("available", [0, 1]), ("added", [9]), ("epsilon", 0.123)][stage]
    where = "loop = 0 AND pass = ? AND stage = ?"
    changed = json.dumps({**body, field: value}, separators=(",", ":"))
    change(path, f"UPDATE records SET body = ? WHERE {where}", changed, number, stage)

    found = replayed(path)

    assert found.difference is not None
    assert found.difference[:3] == (0, number, STAGES[stage].__name__)
    assert found.difference.text == f": {field} is {json.dumps(value)} there, and {json.dumps(body[field])} here"
    assert found.records == PLACES.index(place)


@given(length=st.integers(1, len(PLACES)))
def test_a_log_that_ends_early_is_compared_as_far_as_it_goes(
    log: Path, tmp_path_factory: pytest.TempPathFactory, length: int
) -> None:
    path = copied(log, tmp_path_factory.getbasetemp())
    db = sqlite3.connect(path)
    with db:
        for place in PLACES[length:]:
            db.execute("DELETE FROM records WHERE loop = 0 AND pass = ? AND stage = ?", place)
    db.close()
    reseal(path)

    found = replayed(path)

    assert found.difference is None
    assert found.records == length
    assert found.passes == (length - 1) // 4
    assert found.ended == (length == len(PLACES))
    assert found.log_sha256 == run_again(CONFIG, passes=found.passes).log.sha256()
    assert (found.q_table_sha256 is not None) == found.ended


@given(place=st.sampled_from(PLACES[:-4]))
def test_a_record_that_is_missing_on_the_way_is_noticed_at_the_next_one(
    log: Path, tmp_path_factory: pytest.TempPathFactory, place: tuple[int, int]
) -> None:
    path = copied(log, tmp_path_factory.getbasetemp())
    change(path, "DELETE FROM records WHERE loop = 0 AND pass = ? AND stage = ?", *place)

    found = replayed(path)

    assert found.difference is not None
    number, stage = PLACES[PLACES.index(place) + 1]
    assert found.difference[1:3] == (number, STAGES[stage].__name__)
    assert found.difference.text == ": does not come next in its log; records before it are missing"


@pytest.mark.parametrize("body", ["", "{", '{"schema":"Symptom/1"}', "[]"])
def test_what_is_no_record_is_a_difference(log: Path, tmp_path: Path, body: str) -> None:
    path = copied(log, tmp_path)
    change(path, "UPDATE records SET body = ? WHERE pass = 5 AND stage = 1", body)

    found = replayed(path)

    assert found.difference is not None
    assert found.difference[:3] == (0, 5, "Symptom")


def test_a_packed_row_that_was_changed_is_noticed(log: Path, tmp_path: Path) -> None:
    path = copied(log, tmp_path)
    change(path, "UPDATE records SET row = zeroblob(length(row)) WHERE pass = 5 AND stage = 3")

    found = replayed(path)

    assert found.difference is not None
    assert found.difference.text.startswith("the packed rows hash to ")


def test_a_q_table_of_the_end_that_was_changed_is_noticed(log: Path, tmp_path: Path) -> None:
    path = copied(log, tmp_path)
    longer = tmp_path / "longer.sqlite"
    write_log(longer, small(seed=1))
    db = sqlite3.connect(path)
    with db:
        db.execute("ATTACH ? AS other", (str(longer),))
        db.execute("INSERT INTO q_tables SELECT * FROM other.q_tables")
        db.execute("UPDATE snapshots SET q_table = (SELECT q_table FROM other.snapshots WHERE role = 'execute')")
    db.close()
    reseal(path)

    found = replayed(path)

    assert found.difference is not None
    assert found.difference.text.startswith("the Q-table of the end hashes to ")


LIVE: list[tuple[int, str, dict[str, Any]]] = [
    (3, "plan", {"name": "morphin", "alpha": 0.3}),
    (4, "monitor", {"name": "page_hinkley", "threshold": 1.0}),
    (5, "plan.schedule", {"name": "constant", "epsilon": 0.4}),
    (7, "learner", {"name": "q_learning", "discount": 0.5}),
    (9, "plan", {"name": "q_learning", "alpha": 0.6}),
]


@pytest.mark.parametrize("redrivable", [True, False])
def test_parts_that_were_replaced_live_are_replaced_again(tmp_path: Path, redrivable: bool) -> None:
    planned = [{"pass": 2, "part": "plan", "to": {"name": "morphin", "alpha": 0.2}}]
    config = small(swap=planned, system={**json.loads(CONFIG.to_json())["system"], "redrivable": redrivable})
    path = tmp_path / "log.sqlite"
    write_log(path, config, LIVE)

    found = replayed(path)
    assert found.difference is None
    assert (found.records, found.fed) == (49, not redrivable)

    change(path, "DELETE FROM swaps WHERE part = 'plan.schedule'")
    without = replayed(path)
    assert without.difference is not None
    assert without.difference[:3] == (0, 5, "ChangePlan")


def test_each_loop_of_each_trial_is_a_log_of_its_own(tmp_path: Path) -> None:
    config = small(trials=2, loops=2, episodes=5)
    write_log(tmp_path / "log.sqlite", config)

    found = [replayed(tmp_path / "log.sqlite", unit) for unit in range(4)]

    assert [one.difference for one in found] == [None] * 4
    assert [one.log_sha256 for one in found] == [run_again(config, unit).log.sha256() for unit in range(4)]


@given(passes=st.integers(1, CONFIG.episodes))
def test_the_moment_after_a_pass_is_what_the_loop_held_then(log: Path, passes: int) -> None:
    loop = run_again(CONFIG, passes=passes)
    table = loop.execute.q_table

    moment = replayed(log, to=passes).moment

    assert moment is not None
    assert moment.seen == loop.log.window[-1].observation
    assert moment.plan == loop.log.window[-1].plan == loop.execute.plan
    assert moment.known == table.actions
    assert [one["state"] for one in moment.detectors] == loop.monitor.state()
    assert moment.planner == {"name": "morphin", "state": loop.plan.state()}
    assert moment.q_table is not None
    assert moment.q_table["values"] == table.values.tolist()
    assert moment.q_table["sha256"] == table.sha256()
    assert moment.q_table["row_max"] == table.values.max(axis=1).tolist()


def test_a_pass_that_the_log_does_not_reach_is_refused(log: Path) -> None:
    with pytest.raises(ConfigError, match="--to 13: the log of loop 0 ends with pass 12"):
        replayed(log, to=13)


def test_a_system_that_cannot_be_driven_again_is_not_even_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "log.sqlite"
    write_log(path, ONCE)
    monkeypatch.setattr("adapters.replay.records.make_system", None)

    found = replayed(path)

    assert found.difference is None
    assert found.fed
    assert found.records == 49
    assert found.log_sha256 == run_again(CONFIG).log.sha256()
    assert found.q_table_sha256 is None


def test_what_monitor_makes_of_a_changed_observation_is_another_symptom(tmp_path: Path) -> None:
    path = tmp_path / "log.sqlite"
    write_log(path, ONCE)
    change(path, "UPDATE records SET body = json_set(body, '$.signals.return', -1234.5) WHERE pass = 6 AND stage = 0")

    found = replayed(path)

    assert found.difference is not None
    assert found.difference[:3] == (0, 6, "Symptom")
    assert '"return": -1234.5' in found.difference.text


@given(lag=st.integers(0, 5))
def test_a_free_running_log_is_derived_under_the_plans_that_its_observations_name(
    tmp_path_factory: pytest.TempPathFactory, lag: int
) -> None:
    path = tmp_path_factory.mktemp("free") / "log.sqlite"
    write_free_log(path, FREE, lag)

    found = replayed(path)

    assert found.difference is None
    assert (found.records, found.fed, found.log_sha256) == (49, False, None)
    assert found.q_table_sha256 is not None


@given(dropped=st.sets(st.integers(1, FREE.episodes - 1), min_size=1))
def test_where_episodes_were_dropped_the_parts_are_fed_with_what_is_there(
    tmp_path_factory: pytest.TempPathFactory, dropped: set[int]
) -> None:
    path = tmp_path_factory.mktemp("dropped") / "log.sqlite"
    write_free_log(path, FREE, lag=2, dropped=dropped)

    found = replayed(path)
    assert found.difference is None
    assert (found.records, found.fed, found.q_table_sha256) == (49 - 4 * len(dropped), True, None)

    change(path, "UPDATE records SET body = json_set(body, '$.epsilon', 0.123) WHERE pass = 12 AND stage = 3")
    changed = replayed(path)
    assert changed.difference is not None
    assert changed.difference[:3] == (0, 12, "ChangePlan")


def test_a_free_running_observation_that_was_changed_is_named(tmp_path: Path) -> None:
    path = tmp_path / "log.sqlite"
    write_free_log(path, FREE, lag=1)
    change(path, "UPDATE records SET body = json_set(body, '$.steps', 3) WHERE pass = 4 AND stage = 0")

    found = replayed(path)

    assert found.difference is not None
    assert found.difference[:3] == (0, 4, "Observation")


def test_a_file_that_is_no_log_and_one_without_records_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.sqlite").write_text("dear diary, " * 100)
    Store(tmp_path / "empty.sqlite").close()

    with pytest.raises(ResultsError, match=r"text\.sqlite"):
        replayed(tmp_path / "text.sqlite")
    with pytest.raises(ResultsError, match="holds no record yet"):
        replayed(tmp_path / "empty.sqlite")


# The command.


@pytest.fixture
def folder(log: Path, tmp_path: Path) -> Path:
    """The folder of a run, with what the run said of itself."""
    path = tmp_path / "out"
    path.mkdir()
    copied(log, tmp_path).rename(path / "log.sqlite")
    (tmp_path / "changed.mark").rename(path / "log.mark")
    assert main(["run", write_config(tmp_path), "--no-figures", "-q", "--out", str(tmp_path / "run")]) == 0
    (tmp_path / "run" / "result.json").rename(path / "result.json")
    return path


def write_config(folder: Path) -> str:
    (folder / "small.json").write_text(CONFIG.to_json())
    return str(folder / "small.json")


def test_replay_says_that_nothing_differs_and_the_hashes(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["replay", str(folder)]) == 0

    loop = run_again(CONFIG)
    assert capsys.readouterr().out.splitlines() == [
        f"{folder}/log.sqlite: small, lockstep",
        "49 records derived again: no difference",
        f"log:      {loop.log.sha256()}",
        f"Q-table:  {loop.execute.q_table.sha256()}",
        "result.json says the same",
    ]


def test_replay_ends_with_1_at_a_difference(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change(folder / "log.sqlite", "UPDATE records SET body = json_set(body, '$.steps', 3) WHERE pass = 4 AND stage = 0")
    capsys.readouterr()

    assert main(["replay", str(folder)]) == 1
    assert "13 records are equal; the first difference: Observation 4 of loop 0: steps is 3" in capsys.readouterr().out
    assert main(["replay", str(folder), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert (found["equal"], found["records"]) == (False, 13)
    assert (found["difference"]["pass_no"], found["difference"]["stage"]) == (4, "Observation")


@pytest.mark.parametrize("name", ["log_sha256", "q_table_sha256"])
@pytest.mark.parametrize("whole", [True, False])
def test_a_result_that_says_another_hash_is_a_difference(
    folder: Path, capsys: pytest.CaptureFixture[str], name: str, whole: bool
) -> None:
    with edited(folder / "result.json") as result:
        (result if whole else result["trials"][0])[name] = "0" * 64
    capsys.readouterr()

    assert main(["replay", str(folder)]) == 1
    assert f"{name} is {'0' * 64} in {folder}/result.json" in capsys.readouterr().out


def test_replay_to_a_pass_shows_what_knowledge_held(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["replay", str(folder), "--to", "6"]) == 0

    loop = run_again(CONFIG, passes=6)
    said = capsys.readouterr().out
    assert "25 records derived again: no difference\n--- after pass 6\n" in said
    assert "plan:        plan 6: epsilon " in said
    assert "detector 0:  page_hinkley on return, state {" in said
    assert f"Q-table:     4 actions x 9 states, largest value {loop.execute.q_table.values.max():.6g}, " in said
    assert main(["replay", str(folder), "--to", "6", "--json"]) == 0
    held = json.loads(capsys.readouterr().out)["loops"][0]["knowledge"]
    assert held["q_table"]["values"] == loop.execute.q_table.values.tolist()
    assert held["plan"]["pass"] == held["pass"] == 6


def test_a_loop_that_there_is_not_and_a_folder_that_there_is_not_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(folder), "--loop", "1"]) == 2
    assert "--loop 1: the run has loops 0 to 0" in capsys.readouterr().err
    assert main(["replay", str(folder / "nothing")]) == 1
    assert "there is no folder or file" in capsys.readouterr().err
