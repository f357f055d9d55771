import hashlib
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knowledge import QTable

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
    assert made.values.flags.c_contiguous


@given(ids, st.data())
def test_dropped_actions_lose_their_rows_and_the_others_keep_theirs(actions, data):
    gone = data.draw(st.sets(st.sampled_from(actions)))
    made = table(actions)
    rows = dict(zip(made.actions, made.values.tolist(), strict=True))
    made.drop(gone)
    assert made.actions == tuple(a for a in actions if a not in gone)
    assert dict(zip(made.actions, made.values.tolist(), strict=True)) == {a: rows[a] for a in made.actions}
    assert made.values.shape == (len(made.actions), 4)
    assert made.values.flags.c_contiguous


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
