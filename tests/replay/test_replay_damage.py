"""A log that is damaged is told in a sentence by whoever reads it."""

import re
from pathlib import Path

import pytest
from replay_logs import change, damage, small, write_log

from adapters.cli.main import main
from adapters.stores import Store


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "out").mkdir()
    write_log(tmp_path / "out" / "log.sqlite", small(episodes=4))
    return tmp_path / "out"


DAMAGES = {
    "the Q-table of the end": "UPDATE q_tables SET body = zeroblob(length(body) - 8)",
    "its values": "UPDATE q_tables SET body = zeroblob(length(body))",
    "the config": "UPDATE run SET value = json_set(value, '$.seed', 5) WHERE name = 'config'",
    "the state": "UPDATE snapshots SET state = '{}'",
}


@pytest.mark.parametrize("what", DAMAGES)
def test_replay_names_what_is_damaged(folder: Path, capsys: pytest.CaptureFixture[str], what: str) -> None:
    damage(folder / "log.sqlite", DAMAGES[what])

    assert main(["replay", str(folder)]) == 1
    table = DAMAGES[what].split()[1]
    told = capsys.readouterr().err
    assert re.search(rf"mapek: .*log\.sqlite cannot be read: in its table {table} the row of ", told), told


def test_replay_names_a_layout_that_is_none(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change(folder / "log.sqlite", "UPDATE run SET value = '{}' WHERE name = 'layout'")
    assert main(["replay", str(folder)]) == 1
    assert "the layout of the run's rows" in capsys.readouterr().err


@pytest.mark.parametrize("table", ["run", "records", "dropped", "snapshots", "q_tables", "swaps"])
def test_replay_names_a_table_that_is_missing(folder: Path, capsys: pytest.CaptureFixture[str], table: str) -> None:
    with Store(folder / "log.sqlite") as store:
        store._db.execute(f"DROP TABLE {table}")

    assert main(["replay", str(folder)]) == 1
    assert f"log.sqlite cannot be read: no such table: {table}" in capsys.readouterr().err
