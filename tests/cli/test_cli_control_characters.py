"""Nothing that was written elsewhere reaches the terminal as a command to it."""

import json
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adapters.buses.messages import RoleStatus
from adapters.cli.main import main
from adapters.cli.terminal import cleaned
from adapters.stores import LOG_NAME, Store

WINDOW = "\x1b]0;owned\x07"
EVIL = f"{WINDOW}\x1b[2J\x9b31m\u202egone\rall is well\u2028\x7f"


def harmless(text):
    return not any(unicodedata.category(c) in ("Cc", "Zl", "Zp") and c not in "\n\t" for c in text) and not any(
        unicodedata.bidirectional(c) in ("RLO", "LRO", "RLE", "LRE", "PDF", "LRI", "RLI", "FSI", "PDI") for c in text
    )


@given(st.text(st.characters(blacklist_categories=["Cs"])))
def test_what_is_cleaned_moves_no_cursor_and_stays_the_same_json(text):
    assert harmless(cleaned(text))
    raw = json.dumps(text, ensure_ascii=False)
    assert json.loads(cleaned(raw)) == text


@given(st.text(st.characters(whitelist_categories=["L", "N", "P", "S", "Zs"])))
def test_what_is_no_control_character_stays_as_it_is(text):
    assert cleaned(text) == text


@pytest.fixture
def told(tmp_path):
    """A log whose events were told by somebody who means ill."""
    from mape.config import from_table

    config = from_table({"episodes": 5, "system": {"id": "any"}})
    with Store(tmp_path / LOG_NAME) as store:
        store.set_facts(config=json.loads(config.to_json()), versions={})
        store.event("monitor", "swap refused", EVIL)
        store.event(f"plan{WINDOW}", "refused", "x")
        store.commit()
    return tmp_path


@pytest.mark.parametrize("options", [["--events"], ["--events", "--json"]], ids=["text", "json"])
def test_the_text_of_an_event_is_printed_without_its_escape_sequences(told, capsys, options):
    assert main(["log", str(told), *options]) == 0
    said = capsys.readouterr().out
    assert "gone" in said
    assert harmless(said)


def test_the_name_of_a_host_and_the_words_of_an_error_are_cleaned(monkeypatch, capsys):
    from adapters.cli import status
    from mape.errors import BusError

    def fails(chosen):
        raise BusError(f"no Knowledge: {EVIL}")

    monkeypatch.setattr(status, "execute", fails)
    assert main(["status", "--connect", "tcp/127.0.0.1:1"]) == 1
    assert harmless(capsys.readouterr().err)


def test_a_name_that_was_typed_is_cleaned_in_what_is_said_of_it(capsys):
    assert main(["check", f"nothing{EVIL}"]) == 2
    assert main(["run", f"nowhere{EVIL}.toml"]) == 2
    assert main([f"{EVIL}"]) == 2
    assert harmless(capsys.readouterr().err)


def test_a_role_says_its_host_in_its_status(capsys, monkeypatch):
    """What a role calls its machine is any text of up to 255 characters."""
    from adapters.buses.messages import Status
    from adapters.cli import status as command

    role = RoleStatus(
        alive=True, epoch=1, pid=1, host=EVIL[:15], passes=0, last_pass=0, beat_age=None, refused=0
    )  # fmt: skip
    whole = Status(
        system="s", name=EVIL, mode="lockstep", episodes=1, units=1, passes=0, last=("", "", "", ""),
        roles={"monitor": role}, refused=0, dropped=0, complete=False, pid=1,
    )  # fmt: skip
    monkeypatch.setattr(command, "execute", lambda chosen: command._print(whole) or 0)
    assert main(["status", "--connect", "tcp/127.0.0.1:1"]) == 0
    assert harmless(capsys.readouterr().out)
