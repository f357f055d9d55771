"""The wire as an AsyncAPI document: every key expression, who speaks under it, and what is said."""

from __future__ import annotations

from typing import Any

from adapters.buses import messages
from adapters.buses.wire import WIRE_VERSION, Wire, role_of
from knowledge import STAGES
from knowledge.q_table import SCHEMA as Q_TABLE
from knowledge.records import json_schemas

_SYSTEM, _LOOP = "system", "loop"
"""What stands for the parameters while a key expression is made by the same code that the processes use."""

_STATE = (
    "its raw bytes stand behind the line where a Q-table belongs to it; what is larger than a piece comes in pieces"
)


def document() -> dict[str, Any]:
    """Return the AsyncAPI 3.0 document of the wire, generated from the code.

    Examples
    --------
    >>> wire = document()
    >>> wire["channels"]["monitor"]["address"], sorted(wire["channels"]["monitor"]["messages"])
    ('mape/{system}/{loop}/monitor', ['Symptom'])
    """
    wire = Wire("tcp/127.0.0.1:7447", _SYSTEM)
    channels: dict[str, Any] = {}
    operations: dict[str, Any] = {}

    def channel(name: str, key: str, text: str, asked: tuple[str, ...], answered: tuple[str, ...] = ()) -> None:
        address = key.replace(f"/{_SYSTEM}/", "/{system}/", 1).replace(f"/{_LOOP}/", "/{loop}/", 1)
        used = [p for p in ("system", "loop", "epoch") if f"{{{p}}}" in address]
        channels[name] = {
            "address": address,
            "description": text,
            "messages": {
                message: {"$ref": f"#/components/messages/{message}"} for message in dict.fromkeys((*asked, *answered))
            },
            **({"parameters": {p: {"$ref": f"#/components/parameters/{p}"} for p in used}} if used else {}),
        }
        to = {"$ref": f"#/channels/{name}"}
        operations[f"send-{name}"] = {
            "action": "send",
            "channel": to,
            "messages": [{"$ref": f"#/channels/{name}/messages/{message}"} for message in asked],
            **(
                {"reply": {"channel": to, "messages": [{"$ref": f"#/channels/{name}/messages/{m}"} for m in answered]}}
                if answered
                else {}
            ),
        }

    for stage in STAGES:
        role, kind = role_of(stage), stage.__name__
        channel(role, wire.stream(role, _LOOP), f"published by Knowledge: each {kind} that it appended", (kind,))
        sent = (kind, "Dropped") if role == "execute" else (kind,)
        text = f"query by {role}: take this {kind}; refused with an error reply that says why"
        channel(f"append-{role}", wire.append(role, _LOOP), text, sent, ("Acknowledged",))
        for what, said, asked, answered in (
            ("join", "who I am, with which config", ("Join",), ("Joined",)),
            ("snapshot", f"keep my state, or, without a payload, give it back; {_STATE}", ("State",),
             ("Acknowledged", "State", "Piece")),
            ("piece", "a part of a large State or Table; answered with how many bytes there are", ("Piece",), ()),
            ("swapped", "a part was replaced", ("Swapped",), ()),
            ("event", "note this beside the records", ("Happened",), ()),
        ):  # fmt: skip
            channel(f"{what}-{role}", wire.ask(f"{what}/{role}"), f"query by {role}: {said}", asked, answered)
        channel(
            f"control-{role}",
            wire.control(role),
            f"query by Knowledge, answered by {role}",
            ("Control",),
            ("Replaced", "Table", "Piece"),
        )
        channel(f"beat-{role}", wire.beat(role), f"published by {role}: its heartbeat", ("Beat",))
        channel(f"alive-{role}", wire.alive(role, "{epoch}"), f"liveliness token of {role}", ())
    text = "query by an operator: have another part put in; Knowledge hands it on to the role whose part it is"
    channel("swap", wire.ask("swap"), text, ("Control",), ("Replaced",))
    kinds = tuple(stage.__name__ for stage in STAGES)
    text = "query with ?loop=L;from=STAGE:PASS,...: the loop and whether there is more, then records, one a line"
    channel("since", wire.ask("since"), text, (), kinds)
    channel("table", wire.ask("table"), "query with ?sha256=... or ?loop=L;pass=N: a Q-table", (), ("Table", "Piece"))
    text = f"query by plan: keep this Q-table; {_STATE}; answered with its SHA-256"
    channel("remember", wire.ask("remember/plan"), text, ("Table",))
    channel("status", wire.ask("status"), "query: who is there, and how far the run is", (), ("Status",))
    return {
        "asyncapi": "3.0.0",
        "info": {
            "title": "mapek: the loop over Zenoh",
            "version": str(WIRE_VERSION),
            "description": "Knowledge is the router, and the only one that publishes records. A message is one line of "
            f"strict JSON; {_STATE}, as {Q_TABLE} says.",
        },
        "channels": channels,
        "operations": operations,
        "components": {
            **_messages_and_schemas(),
            "parameters": {
                "system": {"description": "the managed system: a-z, 0-9, _ and -"},
                "loop": {"description": "number of the loop, from 0"},
                "epoch": {"description": "how often the role has joined"},
            },
        },
    }


def _messages_and_schemas() -> dict[str, Any]:
    """Return the messages, and what their payloads share under the names by which they refer to it."""
    schemas = {tag.partition("/")[0]: (tag, schema) for tag, schema in json_schemas().items()}
    for kind in messages.MESSAGES:
        schema = kind.model_json_schema(by_alias=True)
        schema["properties"] = {"schema": {"const": kind.tag()}, **schema["properties"]}
        schema["required"] = ["schema", *schema.get("required", [])]
        schemas[kind.__name__] = (kind.tag(), schema)
    found: dict[str, Any] = {}
    shared: dict[str, Any] = {}
    for name, (tag, schema) in schemas.items():
        payload = _pointed(schema)
        shared |= payload.pop("$defs", {})
        found[name] = {"name": tag, "contentType": "application/json", "payload": payload}
    return {"messages": found, "schemas": shared}


def _pointed(part: Any) -> Any:
    """Return a part of a payload whose references lead to the whole document's schemas, not to its own."""
    if isinstance(part, dict):
        return {
            key: value.replace("#/$defs/", "#/components/schemas/") if key == "$ref" else _pointed(value)
            for key, value in part.items()
        }
    return [_pointed(item) for item in part] if isinstance(part, list) else part
