"""A log that is damaged is told in a sentence by whoever reads it."""

import re
from pathlib import Path

import pytest
from replay_logs import change, small, write_log

from adapters.cli.main import main
from adapters.stores import Store


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "out").mkdir()
    write_log(tmp_path / "out" / "log.sqlite", small(episodes=4))
    return tmp_path / "out"


DAMAGES = {
    "the Q-table of the end": ("UPDATE q_tables SET body = zeroblob(length(body) - 8)", "the Q-table .* is damaged"),
    "its values": ("UPDATE q_tables SET body = zeroblob(length(body))", "the Q-table .* is damaged"),
    "the config": ("UPDATE run SET value = '{' WHERE name = 'config'", "the config in value of run is no JSON"),
    "the layout": ("UPDATE run SET value = '{}' WHERE name = 'layout'", "the layout of the run's rows"),
    "the state": ("UPDATE snapshots SET state = '{'", "state of snapshots is no JSON"),
}


@pytest.mark.parametrize("what", DAMAGES)
def test_replay_names_what_is_damaged(folder: Path, capsys: pytest.CaptureFixture[str], what: str) -> None:
    statement, says = DAMAGES[what]
    change(folder / "log.sqlite", statement)

    assert main(["replay", str(folder)]) == 1
    told = capsys.readouterr().err
    assert told.startswith("mapek: ")
    assert re.search(says, told), told


@pytest.mark.parametrize("table", ["run", "records", "dropped", "snapshots", "q_tables", "swaps"])
def test_replay_names_a_table_that_is_missing(folder: Path, capsys: pytest.CaptureFixture[str], table: str) -> None:
    with Store(folder / "log.sqlite") as store:
        store._db.execute(f"DROP TABLE {table}")

    assert main(["replay", str(folder)]) == 1
    assert f"log.sqlite cannot be read: no such table: {table}" in capsys.readouterr().err
