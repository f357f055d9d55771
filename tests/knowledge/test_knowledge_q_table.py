import hashlib
import json
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knowledge import MalformedRecord, QTable

ids = st.lists(st.integers(0, 100), unique=True, min_size=1, max_size=6)


def table(actions=(3, 1, 7), n_states=4):
    made = QTable(actions, n_states)
    made.values[:] = np.arange(made.values.size).reshape(made.values.shape) + 0.5
    return made


def test_a_fresh_table_is_zero_in_every_state_of_every_action():
    made = QTable((4, 2), 3)
    assert made.actions == (4, 2)
    assert made.values.tolist() == [[0.0] * 3] * 2
    assert made.n_states == 3


@pytest.mark.parametrize("actions", [(1, 1), (-1,), (0, -3)])
def test_actions_are_distinct_and_not_negative(actions):
    with pytest.raises(ValueError, match="distinct and not negative"):
        QTable(actions, 3)


def test_a_table_has_at_least_one_state():
    with pytest.raises(ValueError, match="at least one state"):
        QTable((0,), 0)


@given(ids, ids)
def test_new_actions_get_rows_of_zeros_and_the_old_rows_are_kept(old, new):
    made = table(old)
    before = made.values.copy()
    made.add(new)
    fresh = [a for a in new if a not in old]
    assert made.actions == (*old, *fresh)
    np.testing.assert_array_equal(made.values[: len(old)], before)
    assert not made.values[len(old) :].any()
    assert made.values.flags.f_contiguous


@given(ids, st.data())
def test_dropped_actions_lose_their_rows_and_the_others_keep_theirs(actions, data):
    gone = data.draw(st.sets(st.sampled_from(actions)))
    made = table(actions)
    rows = dict(zip(made.actions, made.values.tolist(), strict=True))
    made.drop(gone)
    assert made.actions == tuple(a for a in actions if a not in gone)
    assert dict(zip(made.actions, made.values.tolist(), strict=True)) == {a: rows[a] for a in made.actions}
    assert made.values.shape == (len(made.actions), 4)
    assert made.values.flags.f_contiguous


def test_dropping_an_unknown_action_says_so_and_drops_nothing():
    made = table()
    with pytest.raises(ValueError, match=r"actions \[9\] have no row; the table knows \(3, 1, 7\)"):
        made.drop((1, 9))
    assert made.actions == (3, 1, 7)


def test_a_dropped_action_that_comes_back_starts_from_zero():
    made = table()
    made.drop((1,))
    made.add((1,))
    assert made.actions == (3, 7, 1)
    assert made.values[2].tolist() == [0.0] * 4


def test_a_copy_is_equal_and_independent():
    made = table()
    twin = made.copy()
    assert twin.sha256() == made.sha256()
    twin.values[0, 0] = -1.0
    twin.drop((1,))
    assert made.sha256() == table().sha256()


def test_the_hash_is_that_of_shape_ids_and_row_major_little_endian_values():
    made = table()
    text = struct.pack("<5q", 3, 4, 3, 1, 7) + struct.pack("<12d", *(i + 0.5 for i in range(12)))
    assert made.sha256() == hashlib.sha256(text).hexdigest()


def test_the_hash_sees_the_shape():
    hashes = {QTable((0, 1), 6).sha256(), QTable((0, 1), 3).sha256(), QTable((0, 1, 2), 4).sha256()}
    assert len(hashes) == 3


def test_the_hash_sees_the_ids_and_their_order():
    assert len({table(actions).sha256() for actions in ((3, 1, 7), (1, 3, 7), (3, 1, 8))}) == 3


@given(st.integers(0, 11))
def test_the_hash_sees_the_last_bit_of_every_value(at):
    made = table()
    made.values.flat[at] = np.nextafter(made.values.flat[at], np.inf)
    assert made.sha256() != table().sha256()


@pytest.mark.parametrize(
    "layout",
    [
        np.asfortranarray,
        lambda v: np.repeat(v, 2, axis=1)[:, ::2],
        lambda v: v.astype(">f8"),
        lambda v: v[::-1].copy()[::-1],
    ],
    ids=["column-major", "strided", "big-endian", "reversed"],
)
def test_the_hash_does_not_see_how_the_values_lie_in_memory(layout):
    made = table()
    before = made.sha256()
    made.values = layout(made.values)
    assert made.sha256() == before


finite = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def tables(draw):
    actions, n_states = draw(st.lists(st.integers(0, 2**63 - 1), unique=True, max_size=4)), draw(st.integers(1, 5))
    made = QTable(actions, n_states)
    for at in range(made.values.size):
        made.values.flat[at] = draw(finite)
    return made


@given(tables())
def test_a_table_comes_back_from_the_wire_bit_by_bit(made):
    header, data = made.to_bytes()
    again = QTable.from_bytes(json.loads(json.dumps(header)), data)
    assert again.actions == made.actions
    assert again.values.shape == made.values.shape
    assert again.values.tobytes() == made.values.tobytes()  # the sign of zero too
    again.values[:] = 1.0  # a table of one's own, which can be written
    assert again.to_bytes() == again.copy().to_bytes()


def test_the_wire_form_of_a_table_names_its_schema_shape_and_hash():
    made = table()
    header, data = made.to_bytes()
    assert header == {
        "schema": "QTable/1",
        "actions": [3, 1, 7],
        "shape": [3, 4],
        "dtype": "<f8",
        "sha256": made.sha256(),
    }
    assert data == struct.pack("<12d", *(i + 0.5 for i in range(12)))


def test_the_wire_form_does_not_see_how_the_values_lie_in_memory():
    made = table()
    before = made.to_bytes()
    made.values = np.asfortranarray(made.values)
    assert made.to_bytes() == before


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_table_with_a_value_that_is_not_finite_is_neither_sent_nor_taken(bad):
    made = table()
    made.values[1, 2] = bad
    with pytest.raises(MalformedRecord, match="not finite"):
        made.to_bytes()
    header = table().to_bytes()[0] | {"sha256": made.sha256()}
    with pytest.raises(MalformedRecord, match="not finite"):
        QTable.from_bytes(header, made.values.tobytes())


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"schema": "QTable/2"}, "with the schema QTable/1"),
        ({"schema": ["QTable/1"]}, "with the schema QTable/1"),
        ({"surprise": 1}, "and not .*surprise"),
        ({"actions": [3, 1, True]}, "list of integers"),
        ({"actions": [3, 1, 7.0]}, "list of integers"),
        ({"actions": "317"}, "list of integers"),
        ({"actions": [3, 1, 3]}, "distinct and not negative"),
        ({"actions": [3, 1, -7]}, "distinct and not negative"),
        ({"actions": [3, 1, 2**63]}, "QTable/1: "),
        ({"actions": [3, 1]}, "2 actions and 96 bytes are no table of shape"),
        ({"actions": [3, 1, 7, 8]}, "4 actions and 96 bytes are no table of shape"),
        ({"actions": [1, 3, 7]}, "the hash of the table is"),
        ({"shape": [3, 4, 1]}, "list of integers, and shape one of two"),
        ({"shape": [3, 4.0]}, "list of integers, and shape one of two"),
        ({"shape": [True, 4]}, "list of integers, and shape one of two"),
        ({"shape": [3, 10**30]}, "no table of shape"),
        ({"shape": [3, -4]}, "no table of shape"),
        ({"shape": [4, 3]}, "no table of shape"),
        ({"dtype": ">f8"}, "and dtype <f8"),
        ({"dtype": "<f4"}, "and dtype <f8"),
        ({"sha256": "0" * 64}, "the hash of the table is"),
        ({"sha256": None}, "the hash of the table is"),
    ],
)
def test_a_header_that_is_wrong_in_one_place_is_refused_with_the_reason(changes, why):
    header, data = table().to_bytes()
    with pytest.raises(MalformedRecord, match=why):
        QTable.from_bytes(header | changes, data)


@pytest.mark.parametrize("name", ["schema", "actions", "shape", "dtype", "sha256"])
def test_a_header_with_a_missing_key_is_refused(name):
    header, data = table().to_bytes()
    del header[name]
    with pytest.raises(MalformedRecord, match="QTable/1"):
        QTable.from_bytes(header, data)


@pytest.mark.parametrize("states", [0, -1, 2**62, 10**30])
def test_a_table_without_rows_still_has_states_that_can_be(states):
    header, data = QTable((), 3).to_bytes()
    with pytest.raises(MalformedRecord, match="QTable/1: "):
        QTable.from_bytes(header | {"shape": [0, states]}, data)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=5,
)


@given(tables(), st.data())
def test_a_damaged_table_is_refused_and_never_taken(made, data):
    header, values = made.to_bytes()
    names = st.sampled_from(sorted(header)) | st.text(max_size=8)
    changes = data.draw(st.dictionaries(names, json_values, max_size=2))
    damaged = bytearray(values)
    if damaged and data.draw(st.booleans()):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(0, 255))
    for name in data.draw(st.sets(st.sampled_from(sorted(header)), max_size=1)):
        header.pop(name)
    try:
        again = QTable.from_bytes(header | changes, bytes(damaged))
    except MalformedRecord:
        return
    assert again.to_bytes() == made.to_bytes()


@given(json_values, st.binary(max_size=64))
def test_what_is_no_header_is_refused(header, data):
    with pytest.raises(MalformedRecord):
        QTable.from_bytes(header, data)


@given(tables(), st.binary(max_size=64))
def test_other_bytes_under_a_header_are_refused(made, data):
    header, values = made.to_bytes()
    if data != values:
        with pytest.raises(MalformedRecord):
            QTable.from_bytes(header, data)
