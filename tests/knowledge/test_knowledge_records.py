import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from knowledge_strategies import one_pass, plan, records

from knowledge import STAGES, MalformedRecord, from_json, to_json

OBSERVATION, SYMPTOM, REQUEST, PLAN = one_pass(3, alarm=True)


def changed(record, **fields):
    return json.dumps(json.loads(to_json(record)) | fields)


@given(records)
def test_every_record_comes_back_from_the_wire_as_it_was(record):
    again = from_json(to_json(record))
    assert again == record
    assert type(again) is type(record)


@given(records)
def test_what_comes_from_the_wire_is_sent_on_with_the_same_bytes(record):
    assert to_json(from_json(to_json(record))) == to_json(record)


def test_the_wire_form_is_one_json_object_that_names_its_schema_and_version():
    assert json.loads(to_json(plan(7))) == {
        "schema": "ChangePlan/1",
        "loop": 0,
        "pass": 7,
        "epsilon": 0.5,
        "learning_rate": [0.1, 0.9, 5.0],
        "add": [],
        "drop": [],
        "enable": [],
        "reset_detector": False,
        "adopt": None,
    }


def test_readings_and_drifts_travel_by_the_names_of_their_fields():
    assert json.loads(to_json(SYMPTOM))["readings"] == [
        {"signal": "return", "value": -3.0, "statistic": None, "alarm": True, "direction": "down"}
    ]
    assert json.loads(to_json(REQUEST))["drifts"] == [{"signal": "return", "direction": "down"}]


def test_the_order_of_the_signals_survives_the_wire():
    seen = OBSERVATION._replace(signals={"return": 1.0, "b": 2.0, "a": 3.0})
    assert list(from_json(to_json(seen)).signals) == ["return", "b", "a"]


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
def test_a_number_that_is_not_finite_is_not_sent(bad):
    with pytest.raises(MalformedRecord, match="ChangePlan 3 holds a number that is not finite"):
        to_json(PLAN._replace(epsilon=bad))
    with pytest.raises(MalformedRecord, match="Observation 3"):
        to_json(OBSERVATION._replace(signals={"return": bad}))


@pytest.mark.parametrize("bad", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_a_number_that_is_not_finite_is_not_taken(bad):
    text = to_json(plan(1)).decode().replace('"epsilon":0.5', f'"epsilon":{bad}')
    assert bad in text
    with pytest.raises(MalformedRecord):
        from_json(text)


@pytest.mark.parametrize(
    ("record", "fields", "where"),
    [
        (PLAN, {"epsilon": "0.5"}, "epsilon"),
        (PLAN, {"epsilon": True}, "epsilon"),
        (PLAN, {"epsilon": None}, "epsilon"),
        (PLAN, {"learning_rate": 0.1}, "learning_rate"),
        (PLAN, {"learning_rate": ["0.1"]}, "learning_rate.0"),
        (PLAN, {"add": [1.5]}, "add.0"),
        (PLAN, {"reset_detector": 1}, "reset_detector"),
        (PLAN, {"adopt": 7}, "adopt"),
        (PLAN, {"loop": 0.0}, "loop"),
        (PLAN, {"pass": "3"}, "pass_no"),
        (OBSERVATION, {"signals": {"return": "1"}}, "signals.return"),
        (OBSERVATION, {"signals": [1.0]}, "signals"),
        (OBSERVATION, {"steps": 1.5}, "steps"),
        (SYMPTOM, {"readings": {}}, "readings"),
        (SYMPTOM, {"readings": [{"signal": "return"}]}, "readings.0.value"),
        (REQUEST, {"drifts": [{"signal": "return", "direction": "sideways"}]}, "drifts.0.direction"),
    ],
)
def test_a_value_of_the_wrong_type_is_refused_and_not_converted(record, fields, where):
    with pytest.raises(MalformedRecord) as refused:
        from_json(changed(record, **fields))
    assert f"/1: {where}: " in str(refused.value)


@pytest.mark.parametrize("record", one_pass(3, alarm=True), ids=lambda record: type(record).__name__)
def test_each_missing_field_is_refused_by_name(record):
    fields = json.loads(to_json(record))
    for name in fields:
        text = json.dumps({key: value for key, value in fields.items() if key != name})
        with pytest.raises(MalformedRecord, match=name):
            from_json(text)


@pytest.mark.parametrize("record", one_pass(3, alarm=True), ids=lambda record: type(record).__name__)
def test_an_unknown_field_is_refused_by_name(record):
    with pytest.raises(MalformedRecord, match="surprise"):
        from_json(changed(record, surprise=1))


def test_an_unknown_field_within_a_reading_is_refused():
    reading = SYMPTOM.readings[0]._asdict() | {"surprise": 1}
    with pytest.raises(MalformedRecord, match="surprise"):
        from_json(changed(SYMPTOM, readings=[reading]))


def test_the_number_of_the_pass_has_one_name_on_the_wire():
    with pytest.raises(MalformedRecord, match="under 'pass'"):
        from_json(changed(PLAN, pass_no=3))


def test_a_name_that_stands_twice_is_refused():
    text = to_json(plan(1)).decode()
    with pytest.raises(MalformedRecord, match="stands twice"):
        from_json(text[:-1] + ',"epsilon":0.5}')
    nested = to_json(OBSERVATION).decode().replace('{"return":', '{"return":1.0,"return":')
    with pytest.raises(MalformedRecord, match="stands twice"):
        from_json(nested)


@pytest.mark.parametrize("schema", ["ChangePlan/2", "ChangePlan", "changeplan/1", "", None, 1, ["ChangePlan/1"]])
def test_another_version_or_schema_is_refused_and_the_legal_ones_are_named(schema):
    with pytest.raises(MalformedRecord) as refused:
        from_json(changed(PLAN, schema=schema))
    assert all(f"{kind.__name__}/1" in str(refused.value) for kind in STAGES)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "7", '"ChangePlan/1"', b"\xff\xfe", "[" * 100_000])
def test_what_is_no_json_object_is_refused(text):
    with pytest.raises(MalformedRecord):
        from_json(text)


@given(records, st.data())
def test_a_damaged_message_is_refused_or_is_another_valid_record(record, data):
    text = bytearray(to_json(record))
    at = data.draw(st.integers(0, len(text) - 1))
    text[at] = data.draw(st.integers(0, 255))
    try:
        again = from_json(bytes(text))
    except MalformedRecord:
        return
    assert from_json(to_json(again)) == again
