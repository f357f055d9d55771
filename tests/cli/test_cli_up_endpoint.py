"""Where `mapek up` lets its processes meet when nobody says where, and what is said when that cannot be."""

import tempfile

import pytest
from command_line import EXAMPLES

SHORT = ("--set", "episodes=20", "--set", "system.options.switch_at=[11]", "--no-figures", "-q")


def test_up_with_keys_asks_for_a_place_on_the_network(mapek, here):
    outcome = mapek("up", EXAMPLES / "gridworld_goals.toml", *SHORT, "--tls", "keys", "--out", "run")
    assert (outcome.code, outcome.out) == (2, "")
    assert "--listen tcp/127.0.0.1:7447" in outcome.err
    assert "unixsock-stream" not in outcome.err
    assert not (here / "run").exists()


@pytest.mark.parametrize("folder", ["x" * 110, pytest.param("a#b", marks=pytest.mark.long)])
def test_up_meets_elsewhere_where_the_temporary_folder_can_hold_no_socket(mapek, here, monkeypatch, folder):
    (here / folder).mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(here / folder))
    outcome = mapek("up", EXAMPLES / "gridworld_goals.toml", *SHORT, "--out", "run")
    assert outcome.code == 0, outcome.err
    assert (here / "run" / "result.json").exists()
    assert list((here / folder).iterdir()) == []
