import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from knowledge_masks import actions_of
from knowledge_strategies import direction, number, one_pass, plan, sha

from knowledge import ChangePlan, ChangeRequest, Drift, Observation, Reading, RowLayout, Symptom
from knowledge.rows import DIRECTIONS

MAX = 130


@st.composite
def layouts_and_passes(draw):
    names = tuple(f"signal_{i}" for i in range(draw(st.integers(1, 4))))
    detectors, rates = draw(st.integers(0, 3)), draw(st.integers(0, 4))
    ids = st.lists(st.integers(0, MAX - 1), unique=True, max_size=5).map(tuple)
    index, flag = st.integers(0, 2**62), st.booleans()
    signals = {name: draw(number) for name in names}
    available, known = draw(ids), draw(ids)
    readings = tuple(
        Reading(draw(st.sampled_from(names)), draw(number), draw(st.none() | number), draw(flag), draw(direction))
        for _ in range(detectors)
    )
    drifts = tuple(Drift(name, draw(direction)) for name in names if draw(flag))
    n = draw(index)
    records = (
        Observation(0, n, draw(index), draw(number), draw(flag), draw(index), available, known, signals),
        Symptom(0, n, signals, available, known, readings),
        ChangeRequest(0, n, drifts, draw(ids), draw(ids), signals),
        ChangePlan(
            0,
            n,
            draw(number),
            tuple(draw(number) for _ in range(rates)),
            draw(ids),
            draw(ids),
            draw(ids),
            draw(flag),
            draw(st.none() | sha),
        ),
    )
    return RowLayout(names, detectors, rates, MAX), records


@given(st.lists(layouts_and_passes(), min_size=1, max_size=3))
def test_numpy_reads_from_a_row_what_was_packed_field_by_field(cases):
    for layout, (seen, symptom, request, chosen) in cases:
        buffer = bytearray(layout.struct.size + 3)
        layout.pack_into(buffer, 3, seen, symptom, request, chosen)
        row = np.frombuffer(buffer, layout.dtype, offset=3)[0]
        readings, drifts = symptom.readings, dict(request.drifts)
        assert (row["pass"], row["plan"], row["steps"]) == (seen.pass_no, seen.plan, seen.steps)
        assert (row["epsilon"], row["next_epsilon"]) == (seen.epsilon, chosen.epsilon)
        assert row["signals"].tolist() == list(seen.signals.values())
        assert row["value"].tolist() == [r.value for r in readings]
        assert [None if np.isnan(s) else s for s in row["statistic"]] == [r.statistic for r in readings]
        assert row["alarm"].tolist() == [r.alarm for r in readings]
        assert row["direction"].tolist() == [DIRECTIONS[r.direction] for r in readings]
        assert row["drift"].tolist() == [DIRECTIONS[drifts[s]] if s in drifts else 0 for s in layout.signals]
        assert (row["reset_detector"], row["next_reset_detector"]) == (seen.reset_detector, chosen.reset_detector)
        for column, actions in (
            ("available", seen.available),
            ("known", seen.known),
            ("added", request.added),
            ("removed", request.removed),
            ("add", chosen.add),
            ("drop", chosen.drop),
            ("enable", chosen.enable),
        ):
            assert actions_of(row[column]) == tuple(sorted(actions)), column
        assert row["learning_rate"].tolist() == list(chosen.learning_rate)
        assert bytes(row["adopt"]) == (bytes(32) if chosen.adopt is None else bytes.fromhex(chosen.adopt))


@given(layouts_and_passes(), layouts_and_passes())
def test_a_row_does_not_depend_on_what_the_layout_packed_before(one, other):
    layout, records = one
    alone, after = bytearray(layout.struct.size), bytearray(layout.struct.size)
    layout.pack_into(alone, 0, *records)
    used = RowLayout(layout.signals, layout.detectors, layout.rates, MAX)
    if (other[0].signals, other[0].detectors, other[0].rates) == (layout.signals, layout.detectors, layout.rates):
        used.pack_into(after, 0, *other[1])
    used.pack_into(after, 0, *records[:3], records[3]._replace(enable=(1,)))
    used.pack_into(after, 0, *records)
    assert after == alone


@pytest.mark.parametrize("max_actions", [1, 63, 64, 65, 128, 129, 4096])
def test_the_struct_and_the_dtype_have_one_size_and_enough_words(max_actions):
    layout = RowLayout(("return", "steps"), 2, 3, max_actions)
    assert layout.struct.size == layout.dtype.itemsize
    assert layout.dtype["available"].shape == (-(-max_actions // 64),)


def test_rows_are_little_endian():
    layout = RowLayout(("return",), 1, 3)
    buffer = bytearray(layout.struct.size)
    layout.pack_into(buffer, 0, *one_pass(3))
    assert struct.unpack_from("<q", buffer)[0] == 3
    assert layout.dtype["pass"].str == "<i8"
    assert layout.dtype["signals"].base.str == "<f8"


def test_actions_beyond_64_have_their_bits_in_further_words():
    layout = RowLayout(("return",), 1, 3, max_actions=200)
    buffer = bytearray(layout.struct.size)
    seen, symptom, request, chosen = one_pass(1)
    layout.pack_into(buffer, 0, seen._replace(available=(0, 63, 64, 199)), symptom, request, chosen)
    mask = np.frombuffer(buffer, layout.dtype)[0]["available"]
    assert mask.tolist() == [1 | 1 << 63, 1, 0, 1 << (199 - 192)]
    assert actions_of(mask) == (0, 63, 64, 199)


@pytest.mark.parametrize("action", [-1, 64, 1000])
def test_an_action_that_no_mask_holds_is_refused_with_the_way_out(action):
    layout = RowLayout(("return",), 1, 3)
    seen, symptom, request, chosen = one_pass(1)
    with pytest.raises(ValueError, match=rf"action id {action} is outside 0 \.\. 63; raise system.max_actions"):
        layout.pack_into(bytearray(layout.struct.size), 0, seen._replace(known=(action,)), symptom, request, chosen)


@pytest.mark.parametrize("detectors", [0, 1, 2])
@pytest.mark.parametrize("given", [0, 1, 2, 3])
def test_a_pass_of_another_width_is_refused_with_the_layout_in_the_message(detectors, given):
    layout = RowLayout(("return",), detectors, 3)
    seen, symptom, request, chosen = one_pass(7)
    symptom = symptom._replace(readings=symptom.readings * given)
    buffer = bytearray(layout.struct.size)
    if given == detectors:
        layout.pack_into(buffer, 0, seen, symptom, request, chosen)
        assert any(buffer)
        return
    with pytest.raises(ValueError, match=f"pass 7 does not fit the run's layout of 1 signals, {detectors} detectors"):
        layout.pack_into(buffer, 0, seen, symptom, request, chosen)
    assert not any(buffer)


def test_other_learning_rate_parameters_or_signals_are_refused():
    layout = RowLayout(("return",), 1, 3)
    seen, symptom, request, chosen = one_pass(1)
    buffer = bytearray(layout.struct.size)
    with pytest.raises(ValueError, match="3 learning-rate parameters"):
        layout.pack_into(buffer, 0, seen, symptom, request, chosen._replace(learning_rate=(0.1,)))
    with pytest.raises(ValueError, match="1 signals"):
        layout.pack_into(buffer, 0, seen._replace(signals={"return": 1.0, "steps": 1.0}), symptom, request, chosen)


def test_a_drift_of_no_signal_or_said_twice_is_refused():
    layout = RowLayout(("return",), 1, 3)
    seen, symptom, request, chosen = one_pass(1)
    buffer = bytearray(layout.struct.size)
    with pytest.raises(ValueError, match="drift of signal 'noise'; the run's signals are return"):
        layout.pack_into(buffer, 0, seen, symptom, request._replace(drifts=(Drift("noise", "up"),)), chosen)
    with pytest.raises(ValueError, match="two drifts of signal 'return'"):
        layout.pack_into(buffer, 0, seen, symptom, request._replace(drifts=(Drift("return", "up"),) * 2), chosen)


@pytest.mark.parametrize(
    ("record", "field", "value"),
    [
        (2, "added", [1]),
        (2, "drifts", [Drift("return", "up")]),
        (2, "drifts", None),
        (3, "add", (np.int64(63),)),
        (3, "drop", None),
        (3, "learning_rate", (0.1, None, 0.0)),
        (3, "adopt", 12),
        (3, "adopt", []),
    ],
)
def test_a_value_of_another_type_is_refused_with_the_pass_and_what_is_legal(record, field, value):
    layout = RowLayout(("return",), 1, 3)
    records = list(one_pass(7))
    records[record] = records[record]._replace(**{field: value})
    buffer = bytearray(layout.struct.size)
    with pytest.raises(ValueError, match=r"pass 7 does not fit .*sets of actions are tuples of ints"):
        layout.pack_into(buffer, 0, *records)
    assert not any(buffer)


def test_a_direction_that_there_is_not_is_refused_with_those_that_there_are():
    layout = RowLayout(("return",), 1, 3)
    seen, symptom, request, chosen = one_pass(1)
    sideways = symptom._replace(readings=(symptom.readings[0]._replace(direction="sideways"),))
    for records in (
        (seen, symptom, request._replace(drifts=(Drift("return", "sideways"),)), chosen),
        (seen, sideways, request, chosen),
    ):
        with pytest.raises(ValueError, match="'sideways' of a reading or drift is not one of down, up, unknown"):
            layout.pack_into(bytearray(layout.struct.size), 0, *records)


def test_no_statistic_is_nan_in_a_row_and_a_statistic_of_zero_is_not():
    layout = RowLayout(("return",), 1, 3)
    buffer = bytearray(layout.struct.size)
    seen, symptom, request, chosen = one_pass(1)
    for statistic, is_nan in ((None, True), (0.0, False)):
        readings = (symptom.readings[0]._replace(statistic=statistic),)
        layout.pack_into(buffer, 0, seen, symptom._replace(readings=readings), request, chosen)
        assert np.isnan(np.frombuffer(buffer, layout.dtype)[0]["statistic"][0]) == is_nan


def test_plan_0_is_packed_as_a_pass_in_which_nothing_else_happened():
    layout = RowLayout(("return", "steps"), 2, 3)
    row = np.frombuffer(layout.pack_start(plan(0, epsilon=1.0, enable=(5,))), layout.dtype)[0]
    assert (row["pass"], row["epsilon"], row["next_epsilon"]) == (0, 0.0, 1.0)
    assert actions_of(row["enable"]) == (5,)
    assert not row["alarm"].any()
    assert row["signals"].tolist() == [0.0, 0.0]


def test_the_schema_tells_layouts_apart():
    layouts = [
        RowLayout(("return",), 1, 3), RowLayout(("steps",), 1, 3), RowLayout(("return", "steps"), 1, 3),
        RowLayout(("return",), 2, 3), RowLayout(("return",), 1, 2), RowLayout(("return",), 1, 3, 65),
    ]  # fmt: skip
    assert len({layout.schema for layout in layouts}) == len(layouts)
    assert RowLayout(("return",), 1, 3).schema == layouts[0].schema


@given(st.sets(st.integers(0, 191)))
def test_a_mask_reads_back_as_its_actions_in_rising_order(actions):
    bits = sum(1 << a for a in actions)
    assert actions_of([bits >> 64 * w & (1 << 64) - 1 for w in range(3)]) == tuple(sorted(actions))
