"""The AsyncAPI document says what the code does."""

import json

import pytest

from adapters.buses import Wire
from adapters.buses.asyncapi import document
from adapters.buses.messages import MESSAGES
from adapters.cli.main import main
from adapters.roles import ROLES
from knowledge.records import json_schemas


def references(part):
    if isinstance(part, dict):
        for key, value in part.items():
            if key == "$ref":
                yield value
            else:
                yield from references(value)
    elif isinstance(part, list):
        for value in part:
            yield from references(value)


def test_every_reference_leads_somewhere_within_the_document():
    whole = document()
    for reference in references(whole):
        assert reference.startswith("#/"), reference
        found = whole
        for step in reference.removeprefix("#/").split("/"):
            assert step in found, reference
            found = found[step]


def test_an_answer_is_one_of_the_messages_of_the_channel_that_it_comes_by():
    for name, operation in document()["operations"].items():
        if "reply" in operation:
            assert operation["reply"]["channel"] == operation["channel"], name


def test_every_record_and_message_is_described_with_its_tag():
    told = {message["name"] for message in document()["components"]["messages"].values()}
    assert told == {*json_schemas(), *(kind.tag() for kind in MESSAGES)}


def test_no_message_takes_an_unknown_field():
    for message in document()["components"]["messages"].values():
        assert message["payload"]["additionalProperties"] is False, message["name"]


@pytest.mark.parametrize("role", ROLES)
def test_the_keys_are_those_that_the_processes_use(role):
    wire, channels = Wire("tcp/127.0.0.1:7447", "s"), document()["channels"]

    def address(name):
        return channels[name]["address"].format(system="s", loop=3, epoch=7)

    assert address(role) == wire.stream(role, 3)
    assert address(f"append-{role}") == wire.append(role, 3)
    assert address(f"control-{role}") == wire.control(role)
    assert address(f"beat-{role}") == wire.beat(role)
    assert address(f"alive-{role}") == wire.alive(role, 7)
    assert address("since") == wire.ask("since")


def test_the_command_writes_the_document(tmp_path, capsys):
    assert main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == document()
    assert main(["schema", "--out", str(tmp_path / "wire.json")]) == 0
    assert json.loads((tmp_path / "wire.json").read_text()) == document()


@pytest.mark.parametrize(("out", "says"), [("nodir/s.json", "there is no folder"), (".", "is a folder")])
def test_a_document_that_has_no_place_is_a_matter_of_usage(tmp_path, monkeypatch, capsys, out, says):
    monkeypatch.chdir(tmp_path)
    assert main(["schema", "--out", out]) == 2
    told = capsys.readouterr().err
    assert f"--out {out!r}" in told
    assert says in told
    assert "finished before" not in told


def test_a_document_that_cannot_be_written_speaks_of_no_run(tmp_path, capsys):
    place = tmp_path / ("long" * 80)
    assert main(["schema", "--out", str(place)]) == 1
    told = capsys.readouterr().err
    assert f"{place} cannot be written" in told
    assert "finished before" not in told
