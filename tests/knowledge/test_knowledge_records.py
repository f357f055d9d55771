import json
import struct
from decimal import Decimal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from knowledge_strategies import number, observations, one_pass, plan, records

from knowledge import STAGES, MalformedRecord, Observation, from_json, json_schemas, to_json

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


@given(observations, st.dictionaries(st.text(), number))
def test_any_name_of_a_signal_and_every_bit_of_its_value_survive_the_wire(seen, signals):
    again = from_json(to_json(seen._replace(signals=signals)))
    assert list(again.signals) == list(signals)
    assert [struct.pack("<d", x) for x in again.signals.values()] == [struct.pack("<d", x) for x in signals.values()]


@given(records, st.randoms())
def test_names_may_come_in_any_order_and_with_space_between_them(record, random):
    fields = list(json.loads(to_json(record)).items())
    random.shuffle(fields)
    assert from_json(json.dumps(dict(fields), indent=random.choice([None, 1]))) == record


@given(records, st.data())
def test_a_name_that_stands_twice_is_refused_wherever_it_stands(record, data):
    text = to_json(record).decode()
    starts = [at for at, sign in enumerate(text) if sign == "{" and text[at + 1] == '"']
    at = data.draw(st.sampled_from(starts)) + 1
    end = text.index(":", at)
    name = text[at:end] + " " * data.draw(st.integers(0, 1))
    with pytest.raises(MalformedRecord, match="stands twice"):
        from_json(f"{text[:at]}{name}:1,{text[at:]}")
    with pytest.raises(MalformedRecord, match="stands twice"):
        from_json(f"{text[:at]}{name[:-1].rstrip()[:1]}\\u{ord(name[1]):04x}{name[2:]}:1,{text[at:]}")


@pytest.mark.parametrize("name", ["a:b", ":", "::", '":"', "NaN", "Infinity", "\u00e9", "\u2028", "\n", '"', "\\", ""])
def test_a_signal_may_be_called_what_looks_like_something_else(name):
    seen = OBSERVATION._replace(signals={name: 1.0, "return": 2.0})
    assert from_json(to_json(seen)) == seen
    text = to_json(seen).decode()
    with pytest.raises(MalformedRecord, match="stands twice"):
        from_json(text.replace('"return":2.0', '"return":2.0,"return":2.0'))


def test_an_integer_where_a_float_belongs_is_that_float_on_both_ends():
    whole = PLAN._replace(epsilon=1, learning_rate=(0, 1, 5))
    text = to_json(whole)
    assert text == to_json(PLAN._replace(epsilon=1.0, learning_rate=(0.0, 1.0, 5.0)))
    again = from_json(text.replace(b'"epsilon":1.0', b'"epsilon":1'))
    assert again == whole
    assert type(again.epsilon) is float


def test_the_zeros_stay_apart_on_the_wire():
    assert to_json(PLAN._replace(epsilon=0.0)) != to_json(PLAN._replace(epsilon=-0.0))


@pytest.mark.parametrize(
    ("equal", "record"),
    [
        (PLAN._replace(epsilon=np.float64(0.5)), PLAN._replace(epsilon=0.5)),
        (PLAN._replace(epsilon=Decimal("0.5")), PLAN._replace(epsilon=0.5)),
        (PLAN._replace(epsilon=True), PLAN._replace(epsilon=1.0)),
        (PLAN._replace(add=(np.int64(2), True)), PLAN._replace(add=(2, 1))),
        (PLAN._replace(reset_detector=np.bool_(True)), PLAN._replace(reset_detector=True)),
    ],
)
def test_equal_records_have_equal_bytes(equal, record):
    assert equal == record
    assert to_json(equal) == to_json(record)


@pytest.mark.parametrize(
    "record",
    [
        PLAN._replace(add=(object(),)),
        PLAN._replace(add=np.arange(2)),
        SYMPTOM._replace(readings=(7,)),
        SYMPTOM._replace(readings=None),
        OBSERVATION._replace(signals={"return": object()}),
    ],
    ids=lambda record: type(record).__name__,
)
def test_what_json_has_no_form_for_is_not_sent(record):
    with pytest.raises(MalformedRecord, match=f"^{type(record).__name__} 3 holds what JSON has no form for: "):
        to_json(record)


def test_a_name_that_is_no_unicode_is_not_sent():
    with pytest.raises(MalformedRecord, match="or a name that is no Unicode"):
        to_json(OBSERVATION._replace(signals={"\ud800": 1.0}))


def test_only_a_record_is_sent():
    with pytest.raises(MalformedRecord, match="Drift is not one of Observation/1, Symptom/1"):
        to_json(REQUEST.drifts[0])


@pytest.mark.parametrize(
    "record",
    [
        PLAN._replace(epsilon="0.5"),
        PLAN._replace(epsilon=None),
        PLAN._replace(epsilon=1j),
        PLAN._replace(add=None),
        PLAN._replace(add=(1.5,)),
        PLAN._replace(reset_detector=1),
        SYMPTOM._replace(readings=(SYMPTOM.readings[0]._replace(direction="sideways"),)),
        OBSERVATION._replace(signals={"return": None}),
        OBSERVATION._replace(steps=10**5000),
    ],
    ids=lambda record: type(record).__name__,
)
def test_a_value_of_a_wrong_type_is_refused_by_the_reader(record):
    with pytest.raises(MalformedRecord):
        from_json(to_json(record))


@pytest.mark.parametrize("items", [[["return", "down"]], ["return"], [{}]])
def test_a_drift_is_an_object_and_no_list_of_its_values(items):
    with pytest.raises(MalformedRecord, match=r"ChangeRequest/1: drifts\.0"):
        from_json(changed(REQUEST, drifts=items))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-32-le"])
def test_json_is_utf_8_without_a_mark_in_front(encoding):
    with pytest.raises(MalformedRecord, match="JSON"):
        from_json(to_json(PLAN).decode().encode(encoding))


def test_the_age_of_a_plan_is_1_in_lockstep():
    assert [one_pass(n)[0].age for n in (1, 2, 9)] == [1, 1, 1]
    assert OBSERVATION._replace(pass_no=9, plan=4).age == 5
    assert "age" not in json.loads(to_json(OBSERVATION))


def fits(value, schema, root):
    """Whether a value is valid by the words of JSON Schema that the records' schemas are made of."""
    words = set(schema) - {"$schema", "$defs", "title", "description"}
    if words == {"$ref"}:
        return fits(value, root["$defs"][schema["$ref"].removeprefix("#/$defs/")], root)
    if words == {"anyOf"}:
        return any(fits(value, one, root) for one in schema["anyOf"])
    if words & {"const", "enum"}:
        assert words <= {"type", "const", "enum"}
        return isinstance(value, str) and value in schema.get("enum", [schema.get("const")])
    kind = schema["type"]
    if kind == "array":
        assert words == {"type", "items"}
        return isinstance(value, list) and all(fits(item, schema["items"], root) for item in value)
    if kind == "object":
        assert words in ({"type", "additionalProperties"}, {"type", "additionalProperties", "properties", "required"})
        named, others = schema.get("properties", {}), schema["additionalProperties"]
        if not isinstance(value, dict) or not set(schema.get("required", ())) <= set(value):
            return False
        return all(
            fits(item, named[name], root) if name in named else others and fits(item, others, root)
            for name, item in value.items()
        )
    assert words == {"type"}
    of = {"integer": int, "number": int | float, "string": str, "boolean": bool, "null": type(None)}[kind]
    return isinstance(value, of) and (kind == "boolean" or not isinstance(value, bool))


def valid(fields):
    return [name for name, schema in json_schemas().items() if fits(fields, schema, schema)]


@given(records)
def test_what_is_sent_is_valid_by_the_schema_that_it_names_and_by_no_other(record):
    fields = json.loads(to_json(record))
    assert valid(fields) == [fields["schema"]]


@given(records, st.data())
def test_a_message_is_taken_if_and_only_if_it_is_valid_by_a_schema(record, data):
    fields = json.loads(to_json(record))
    inner = data.draw(st.sampled_from([fields, *(fields.get("readings") or fields.get("drifts") or [])]))
    strays = st.none() | st.booleans() | st.integers(0, 3) | number | st.text(max_size=3) | st.just([]) | st.just({})
    name = data.draw(st.sampled_from(sorted(inner)) | st.text(max_size=3))
    if data.draw(st.booleans()):
        inner[name] = data.draw(strays)
    else:
        inner.pop(name, None)
    try:
        from_json(json.dumps(fields))
        taken = True
    except MalformedRecord:
        taken = False
    assert taken == bool(valid(fields))


def test_the_schemas_are_closed_and_require_every_field():
    schemas = json_schemas()
    assert list(schemas) == [f"{kind.__name__}/1" for kind in STAGES]
    for name, schema in schemas.items():
        assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
        assert schema["properties"]["schema"]["const"] == name
        assert schema["description"].endswith(".")
        for objects in (schema, *schema.get("$defs", {}).values()):
            assert objects["additionalProperties"] is False
            assert objects["required"] == list(objects["properties"])
    names = ["schema", "loop", "pass", *Observation._fields[2:]]
    assert list(schemas["Observation/1"]["properties"]) == names
