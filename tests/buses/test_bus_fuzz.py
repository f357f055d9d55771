"""Junk on every key: no crash, no hang, no change of state, and each piece that is refused is counted.

`seeded` pieces are random bytes, and messages that are right but for one thing. What is right in all things, though a
stranger said it, is none of them.
"""

import json
import random
import sqlite3
from contextlib import closing

import numpy as np
import pytest
from bus_peers import Site, ask, eventually
from bus_records import TOLD, run_of
from hypothesis import given, settings
from hypothesis import strategies as st

from adapters.buses import Wire
from adapters.buses.messages import (
    MESSAGES,
    Beat,
    Control,
    Dropped,
    Happened,
    Join,
    State,
    Swapped,
    Table,
)
from adapters.buses.wire import ORDERED
from adapters.roles import ROLES
from knowledge import MalformedRecord, QTable, from_json, to_json

pytestmark = pytest.mark.timeout(240)

QUICK, LONG = 1_000, 100_000
AT_ONCE = 50


def a_table():
    table = QTable((0, 3), 2)
    table.values[:] = np.arange(4).reshape(2, 2) / 3
    return table


RIGHT = [
    *map(to_json, run_of(3)),
    Join(role="plan", config={"a": 1}, versions={"wire": "1"}, pid=1, host="h", layout=None).pack(),
    Join(role="execute", config={}, versions={}, pid=1, host="h", layout=TOLD).pack(),
    State(loop=0, pass_no=2, state={"n": [1, 2.5, None, "x"]}).pack(),
    State(loop=0, pass_no=2, state={}, final=True).pack(a_table()),
    Swapped(loop=0, pass_no=3, part="plan", to={"name": "constant"}).pack(),
    Happened(kind="begun", text="", loop=0, pass_no=3).pack(),
    Happened(kind="aborted", text="it was", loop=0, pass_no=3).pack(),
    Dropped(loop=0, first=4, last=9).pack(),
    Table(loop=None, pass_no=None).pack(a_table()),
    Beat(epoch=1, pid=1, passes=3, refused=0, waiting=False).pack(),
    Control(what="swap", part="plan", to={"name": "constant"}).pack(),
    Control(what="q_table", loop=0, pass_no=3).pack(),
]

NASTY = [
    "NaN", "-Infinity", "1e999", "-1", "0.5", "1" * 30, "1" * 5000, "null", "true", "[]", "{}", '""', r'"\ud800"',
    r'"\u0000"', '"' + "x" * 5000 + '"', "[" * 3000 + "]" * 3000, '{"a":1,"a":2}', '{"' + r"\udc00" + '":1}', "'", "",
]  # fmt: skip

SELECTORS = [
    "", "?", "?loop=0", "?loop=-1", "?loop=9", "?loop=x;from=0:1", "?loop=0;from=0:x", "?loop=0;from=5:1",
    "?loop=0;from=,,", "?loop=0;from=0:1" + ",0:1" * 50, "?sha256=", "?sha256=" + "0" * 64, "?sha256='; DROP--",
    "?loop=0;pass=x", "?loop=9;pass=1", "?" + "loop=0;" * 500, "?loop=%00", "?ü=ü", "?loop=" + "9" * 400,
]  # fmt: skip

BROUGHT = ("join", "snapshot", "swapped", "event", "remember")

QUESTIONS = [
    *[f"{what}/{role}" for what in BROUGHT for role in (*ROLES, "operator")],
    "since", "table", "snapshot", "remember", "nonsense", "join/plan/x", "_", "event/" + "x" * 300,
]  # fmt: skip


def is_right(payload):
    """Whether something would be taken, by whomever."""
    for read in (from_json, *[kind.unpack for kind in MESSAGES]):
        try:
            read(payload)
        except MalformedRecord:
            continue
        return True
    return False


def piece(draw):
    """Make something that is wrong."""
    while True:
        payload = draw.choice([at_random, flipped, cut, spliced, misvalued])(draw)
        if not is_right(payload):
            return payload


def at_random(draw):
    return draw.randbytes(draw.choice([0, 1, 3, 20, 300, 5000]))


def flipped(draw):
    data = bytearray(draw.choice(RIGHT))
    for _ in range(draw.choice([1, 1, 1, 2, 8])):
        data[draw.randrange(len(data))] = draw.randrange(256)
    return bytes(data)


def cut(draw):
    data = draw.choice(RIGHT)
    at = draw.randrange(len(data))
    return draw.choice([data[:at], data[at:], data + data[:at], data[:at] + draw.randbytes(5) + data[at:]])


def spliced(draw):
    one, two = draw.choice(RIGHT), draw.choice(RIGHT)
    return one[: draw.randrange(len(one))] + two[draw.randrange(len(two)) :]


def misvalued(draw):
    line, newline, behind = draw.choice(RIGHT).partition(b"\n")
    fields = json.loads(line)
    where = fields
    if draw.random() < 0.3 and isinstance(fields.get("q_table"), dict):
        where = fields["q_table"]
    name = draw.choice([*where, "surplus"])
    where[name] = "\x01here"
    text = json.dumps(fields).replace(json.dumps("\x01here"), draw.choice(NASTY))
    return text.encode(errors="surrogatepass") + newline + behind


class Target(Site):
    """Knowledge with three passes in its log, and its four members, at whom things are thrown."""

    def __init__(self, wire, path):
        super().__init__(wire, path)
        self.everybody()
        self.send(*run_of(3))
        for role in ROLES:
            self.members[role].watch(0, 5 if role != "execute" else 4)
        self.members["execute"].keep_surely(State(loop=0, pass_no=3, state={"n": 1}), a_table())
        self.members["plan"].remember(a_table())
        self.raw = self.session()
        self.expected = 0  # refusals of Knowledge
        self.expected_of = dict.fromkeys(ROLES, 0)
        self.before = self.state()

    def state(self):
        """All that must not change: what is in the file beside the events, and what is in memory."""
        names = ("run", "records", "dropped", "snapshots", "q_tables", "versions", "swaps", "roles")
        with closing(sqlite3.connect(self.path)) as db:
            rows = {name: db.execute(f"SELECT * FROM {name}").fetchall() for name in names}
        return rows, self.ledger.last(0), self.ledger.sha256(0), self.ledger.complete

    def poll(self):
        for member in self.members.values():
            assert member.receive(0.0) is None

    def throw(self, pieces):
        """Throw pieces, given as (kind, key or selector, payload, attachment), and see what becomes of them."""
        answers = []
        for kind, key, payload, attachment in pieces:
            if kind == "put":
                self.raw.put(key, payload, attachment=attachment, **ORDERED)
                role = key.split("/")[-1]
                if "/beat/" in key:
                    self.expected += 1
                else:
                    self.expected_of[ROLES[(ROLES.index(role) + 1) % 4]] += 1
            else:
                asked = self.raw.get(key, payload=payload, attachment=attachment, timeout=60, **ORDERED)
                answers.append((kind, key, payload, asked))
                if kind == "control":
                    self.expected_of[key.split("/")[-1]] += 1
        eventually(self.all_refused, within=60)
        for kind, key, payload, asked in answers:
            (answer,) = list(asked)
            if kind == "read" and answer.ok is not None:
                continue
            assert answer.ok is None, (key, payload, answer.ok.payload.to_bytes())
            said = answer.err.payload.to_string()
            assert said
            assert said != "Timeout", (key, payload)
            assert "failed with" not in said, (key, payload, said)
            self.expected += kind != "control" and not said.startswith("later: ")
        reply, _ = ask(self.raw, self.wire.ask("status"))
        assert json.loads(reply)["refused"] == self.ledger.refused == self.expected
        assert self.state() == self.before

    def all_refused(self):
        self.poll()
        return {role: member.refused for role, member in self.members.items()} == self.expected_of


def throw_at(target, draw):
    """Choose where a piece goes, and make it."""
    wire, kind = target.wire, draw.choice(["append", "bring", "bring", "read", "control", "stream", "beat"])
    role, loop = draw.choice(ROLES), draw.choice([0, 0, 0, 1, 10**9])
    attachment = draw.choice([None, b"1", b"1", b"1\n" + piece(draw), draw.randbytes(6)])
    if kind == "append":
        return "append", wire.append(draw.choice([*ROLES, "operator"]), loop), piece(draw), attachment
    if kind == "bring":
        key = draw.choice(QUESTIONS)
        payload = None if draw.random() < 0.05 and not key.startswith("snapshot/") else piece(draw)
        if key in ("since", "table"):
            return "read", wire.ask(key) + draw.choice(SELECTORS), payload, attachment
        return "bring", wire.ask(key), payload, attachment
    if kind == "read":
        key = draw.choice(["since", "table", "status", f"snapshot/{role}"])
        return "read", wire.ask(key) + draw.choice(SELECTORS), None, attachment
    if kind == "control":
        return "control", wire.control(role), piece(draw), draw.choice([None, target.hub._seal])
    key = wire.stream(role, loop) if kind == "stream" else wire.beat(draw.choice([*ROLES, "nobody"]))
    return "put", key, piece(draw), attachment


@pytest.fixture
def target(wire, tmp_path):
    with Target(wire, tmp_path / "log.sqlite") as target:
        yield target
        # After all that it does what it did before.
        target.send(*run_of(5)[13:])
        assert target.ledger.last(0) == (5, 5, 5, 5)


def bombard(target, seed, pieces):
    draw = random.Random(seed)
    for _ in range(pieces // AT_ONCE):
        target.throw([throw_at(target, draw) for _ in range(AT_ONCE)])


def test_junk_is_refused_counted_and_changes_nothing(target):
    bombard(target, 20260114, QUICK)


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("seed", range(4))
def test_a_lot_of_junk_is_refused_counted_and_changes_nothing(target, seed):
    bombard(target, seed, LONG // 4)


@pytest.fixture(scope="module")
def lasting(tmp_path_factory):
    folder = tmp_path_factory.mktemp("z")
    with Target(Wire(f"unixsock-stream/{folder}/k.sock", "example"), folder / "log.sqlite") as target:
        yield target


keys = st.sampled_from([f"{what}/{role}" for what in ("join", "swapped", "event", "remember") for role in ROLES])


@settings(max_examples=40)
@given(keys, st.binary(max_size=60) | st.text(max_size=20).map(str.encode), st.none() | st.binary(max_size=9))
def test_any_bytes_brought_to_knowledge_are_refused(lasting, key, payload, attachment):
    lasting.throw([("bring", lasting.wire.ask(key), payload, attachment)])


@settings(max_examples=40)
@given(st.sampled_from(ROLES), st.binary(max_size=60), st.none() | st.binary(max_size=9))
def test_any_bytes_on_the_other_keys_are_refused(lasting, role, payload, attachment):
    wire = lasting.wire
    lasting.throw(
        [
            ("append", wire.append(role, 0), payload, attachment),
            ("append", wire.append(role, 0), payload, b"1"),
            ("control", wire.control(role), payload, lasting.hub._seal),
            ("put", wire.stream(role, 0), payload, attachment),
            ("put", wire.beat(role), payload, attachment),
        ]
    )
