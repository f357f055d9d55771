"""Messages come back as they were written, and nothing else is taken."""

import json
import sys

import numpy as np
import pytest
from bus_records import TOLD
from hypothesis import given
from hypothesis import strategies as st

from adapters.buses.messages import (
    MESSAGES,
    Acknowledged,
    Beat,
    Control,
    Dropped,
    Happened,
    Join,
    Joined,
    Piece,
    Replaced,
    RoleStatus,
    State,
    Status,
    Swapped,
    Table,
)
from knowledge import MalformedRecord, QTable

ROLE = RoleStatus(alive=True, epoch=1, pid=7, host="h", passes=3, last_pass=-1, beat_age=0.25, refused=0)
SWAPPED = Swapped(loop=0, pass_no=4, part="plan", to={"name": "x", "alpha": 0.5}, handed_over=True)
EXAMPLES = [
    Acknowledged(ack="ok", last=-1),
    Beat(epoch=1, pid=2, passes=3, refused=4, waiting=True),
    Control(what="swap", part="plan", to={"name": "x"}),
    Dropped(loop=0, first=1, last=9),
    Happened(kind="swap refused", text="no", loop=0, pass_no=3),
    Join(role="execute", config={"a": [1, None, {"b": 0.5}]}, versions={"wire": "1"}, pid=1, host="h", layout=TOLD),
    Joined(epoch=1, seal="s", units=2, layout=TOLD, last=((0, 0, 0, -1), (1, 1, 1, 1)), swaps=(SWAPPED,), begun=(0, 3)),
    Piece(whole="0" * 64, size=9, at=3),
    State(loop=0, pass_no=3, state={"deep": [1, 2.5, "x"]}, final=True),
    Status(
        system="s", name="n", mode="free", episodes=9, units=1, passes=3, last=("", "", "", "{}"),
        roles={"plan": ROLE}, refused=0, dropped=0, complete=False, pid=1,
    ),
    Replaced(part="plan", passes=(3, 4), handed_over=False),
    SWAPPED,
    Table(loop=None, pass_no=None),
]  # fmt: skip
by_name = pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)


def a_table():
    table = QTable((0, 7), 3)
    table.values[:] = [[-0.0, 5e-324, 1 / 3], [1e308, 10.0, 2.0]]
    return table


def test_there_is_an_example_of_every_message():
    assert {type(message) for message in EXAMPLES} == set(MESSAGES)


@by_name
def test_a_message_comes_back(message):
    assert type(message).unpack(message.pack()) == (message, None)
    assert b"\n" not in message.pack()


@by_name
def test_a_q_table_behind_it_comes_back_as_the_same_bits(message):
    again, table = type(message).unpack(message.pack(a_table()))
    assert again == message
    assert (table.actions, table.values.tobytes()) == ((0, 7), a_table().values.tobytes())


def test_the_bytes_of_a_q_table_may_hold_line_ends():
    table = QTable((0,), 2)
    table.values[:] = np.frombuffer(b"\n" * 16, "<f8")
    assert Table.unpack(Table(loop=0, pass_no=1).pack(table))[1].sha256() == table.sha256()


@by_name
def test_a_field_that_is_unknown_missing_twice_or_of_another_type_is_refused(message):
    kind, fields = type(message), json.loads(message.pack())
    for name in fields:
        for wrong in (object, "x" * 3000, -(2**70), 2**70, [[]], {"x": {}}, 1e999, True):
            changed = {k: v for k, v in fields.items() if k != name}
            if wrong is not object:
                changed[name] = wrong
            text = json.dumps(changed).encode()
            try:
                again, _ = kind.unpack(text)
            except MalformedRecord:
                continue
            # What is taken all the same is another legal value, or has a default.
            assert kind.unpack(again.pack())[0] == again, text
    whole = message.pack()
    for broken in (
        whole[:-1] + b',"surplus":1}',
        whole[:-1] + b',"schema":"' + kind.tag().encode() + b'"}',
        whole.replace(b"/1", b"/2", 1),
        whole + b"\n",
        whole + b"\nleft over",
        whole[:-1],
        b"",
        b"[]",
        b"null",
        b"\xff\xfe",
    ):
        with pytest.raises(MalformedRecord):
            kind.unpack(broken)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "-1e999"])
@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (State, '{"schema":"State/1","loop":0,"pass_no":1,"state":%s,"final":false}'),
        (State, '{"schema":"State/1","loop":0,"pass_no":1,"state":{"x":[%s]},"final":false}'),
        (Swapped, '{"schema":"Swapped/1","loop":0,"pass_no":1,"part":"plan","to":{"x":%s}}'),
    ],
)
def test_a_number_that_is_not_finite_is_refused_however_deep(kind, text, number):
    with pytest.raises(MalformedRecord):
        kind.unpack((text % number).encode())


def test_text_nested_as_deep_as_can_be_read_is_refused_and_nothing_worse():
    for depth in range(sys.getrecursionlimit() - 200, sys.getrecursionlimit() + 2):
        with pytest.raises(MalformedRecord):
            State.unpack(b'{"schema":"State/1","loop":0,"pass_no":1,"state":' + b"[" * depth + b"]" * depth + b"}")


def test_what_is_said_of_a_message_that_is_no_unicode_can_be_said():
    whole = Table(loop=0, pass_no=0).pack(a_table())
    for old, new in [
        (b'"dtype"', rb'"\ud800"'),
        (b'"shape"', rb'"\udfff\ud800"'),
        (b'"<f8"', rb'"\ud800"'),
        (b'"loop"', rb'"\ud800"'),
        (b"Table/1", rb"\ud800"),
        (b'"loop":0', rb'"loop":"\ud800"'),
    ]:
        with pytest.raises(MalformedRecord) as caught:
            Table.unpack(whole.replace(old, new))
        str(caught.value).encode()


BROKEN_HEADERS = [
    ("actions", [0]),
    ("actions", [0, 0]),
    ("actions", [0, -7]),
    ("actions", [0, 7.0]),
    ("actions", [0, 10**30]),
    ("shape", [2, 4]),
    ("shape", [-2, -3]),
    ("shape", [2, 2**70]),
    ("shape", [0, 2**62]),
    ("shape", [2]),
    ("shape", None),
    ("dtype", ">f8"),
    ("dtype", "O"),
    ("sha256", "0" * 64),
    ("sha256", None),
    ("schema", "QTable/2"),
    ("surplus", 1),
]


@pytest.mark.parametrize(("name", "value"), BROKEN_HEADERS)
def test_a_q_table_whose_header_is_not_its_own_is_refused(name, value):
    line, _, data = State(loop=0, pass_no=1, state={}).pack(a_table()).partition(b"\n")
    fields = json.loads(line)
    fields["q_table"][name] = value
    with pytest.raises(MalformedRecord):
        State.unpack(json.dumps(fields).encode() + b"\n" + data)


def test_a_q_table_that_was_cut_or_flipped_is_refused():
    whole = State(loop=0, pass_no=1, state={}).pack(a_table())
    begin = whole.index(b"\n")
    for broken in (whole[:-1], whole[:begin], whole + b"\0", whole[:-1] + b"\1", whole[: begin + 1]):
        with pytest.raises(MalformedRecord):
            State.unpack(broken)


text = st.text(st.characters(codec="utf-8"), max_size=8)
anything = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | text,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(text, inner, max_size=4),
    max_leaves=12,
)


@given(st.sampled_from(EXAMPLES), st.data())
def test_any_value_in_any_place_is_taken_as_it_is_or_refused(message, data):
    fields = json.loads(message.pack(data.draw(st.sampled_from([None, a_table()]))).partition(b"\n")[0])
    fields[data.draw(st.sampled_from(sorted(fields)) | text)] = data.draw(anything)
    behind = data.draw(st.sampled_from([b"", b"\n", b"\n" + a_table().to_bytes()[1]]) | st.binary(max_size=9))
    try:
        again, table = type(message).unpack(json.dumps(fields).encode() + behind)
    except MalformedRecord as error:
        str(error).encode()
        return
    assert type(message).unpack(again.pack(table))[0] == again


@given(st.sampled_from(MESSAGES), st.binary(max_size=60))
def test_any_bytes_are_refused(kind, data):
    with pytest.raises(MalformedRecord):
        kind.unpack(data)
    with pytest.raises(MalformedRecord):
        kind.unpack(b'{"schema":"' + kind.tag().encode() + b'",' + data)
