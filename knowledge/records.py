"""The four records of a MAPE-K pass, and their wire form.

    sensors -> Observation -> Monitor -> Symptom -> Analyze -> ChangeRequest -> Plan -> ChangePlan -> Execute

The words are those of IBM's blueprint for autonomic computing (Kephart & Chess 2003; Weyns 2020). Pass `n` holds
Observation `n` (episode `n`, driven under plan `n - 1`), Symptom `n`, ChangeRequest `n` and ChangePlan `n`. Plan 0
starts a run.

Records are named tuples: on the hot path they cost half of what a frozen dataclass does.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from operator import itemgetter
from types import GenericAlias
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Union, get_type_hints

if TYPE_CHECKING:
    from pydantic_core import SchemaSerializer

Direction = Literal["down", "up", "unknown"]


class Observation(NamedTuple):
    """What the sensors saw of one episode.

    Attributes
    ----------
    loop : number of the loop, from 0.
    pass_no : number of the pass, from 1; also the number of the episode.
    plan : number of the plan in force during the episode; ``pass_no - 1`` in lockstep.
    epsilon : exploration rate of that plan.
    reset_detector : whether that plan wants the detectors reset before they see this observation.
    steps : length of the episode.
    available : ids of the actions that the managed system offered.
    known : ids of the actions that have a row in the Q-table.
    signals : name -> value; the names, and their order, are fixed for the run.
    """

    loop: int
    pass_no: int
    plan: int
    epsilon: float
    reset_detector: bool
    steps: int
    available: tuple[int, ...]
    known: tuple[int, ...]
    signals: dict[str, float]

    @property
    def age(self) -> int:
        """Passes since the plan in force was made: 1 in lockstep, more where the system did not wait for a newer one.

        >>> Observation(0, 7, 4, 0.5, False, 10, (0,), (0,), {}).age
        3
        """
        return self.pass_no - self.plan


class Reading(NamedTuple):
    """What one detector says of one observation; `direction` is the side that the detector watches."""

    signal: str
    value: float
    statistic: float | None
    alarm: bool
    direction: Direction


class Symptom(NamedTuple):
    """Monitor's word: the signals, the action sets, and one reading per detector."""

    loop: int
    pass_no: int
    signals: dict[str, float]
    available: tuple[int, ...]
    known: tuple[int, ...]
    readings: tuple[Reading, ...]


class Drift(NamedTuple):
    """A signal whose distribution changed, and to which side."""

    signal: str
    direction: Direction


class ChangeRequest(NamedTuple):
    """Analyze's word: what changed; all three tuples are empty when nothing did."""

    loop: int
    pass_no: int
    drifts: tuple[Drift, ...]
    added: tuple[int, ...]
    removed: tuple[int, ...]
    signals: dict[str, float]


class ChangePlan(NamedTuple):
    """Plan's word: how the next episode is to be driven.

    Attributes
    ----------
    epsilon : exploration rate of the next episode, in [0, 1].
    learning_rate : parameters of the learner's step size; for the TD-error-driven one (alpha, alpha_max, k).
    add, drop : ids of actions that get a row of zeros in the Q-table, or lose theirs.
    enable : ids of reserve actions that the managed system is asked to switch on.
    reset_detector : whether Monitor resets its detectors before the next update.
    adopt : SHA-256 of a remembered Q-table that takes the place of the present one, or None.
    """

    loop: int
    pass_no: int
    epsilon: float
    learning_rate: tuple[float, ...]
    add: tuple[int, ...]
    drop: tuple[int, ...]
    enable: tuple[int, ...]
    reset_detector: bool
    adopt: str | None


Record = Observation | Symptom | ChangeRequest | ChangePlan
STAGES: tuple[type[Record], ...] = (Observation, Symptom, ChangeRequest, ChangePlan)
"""The record types in the order of a pass."""

WIRE_VERSION = 1


class MalformedRecord(ValueError):
    """A message that is no valid record of this version."""


# The fields whose items are objects on the wire too.
_PARTS: dict[str, type[Reading | Drift]] = {"readings": Reading, "drifts": Drift}


def to_json(record: Record) -> bytes:
    """Write a record as one JSON object: ``schema``, its version, and the record's fields by name.

    Equal records have equal bytes, but for the sign of a zero and the order of the signals: a number that equals one of
    the field's type is written as that one, such as an integer where a float belongs. A value of a wrong type is
    written in the form that JSON has for it, and is for `from_json` to refuse.

    Raises
    ------
    MalformedRecord
        The record holds a number that is not finite, or what JSON has no form for.

    Examples
    --------
    >>> to_json(ChangePlan(0, 1, 0.5, (0.1,), (), (), (), False, None))  # doctest: +ELLIPSIS
    b'{"schema":"ChangePlan/1","loop":0,"pass":1,"epsilon":0.5,"learning_rate":[0.1],...
    """
    kind = type(record)
    form = _wire().by_kind.get(kind)
    if form is None:
        raise MalformedRecord(f"{kind.__name__} is not one of {', '.join(_SCHEMAS)}")
    fields = dict(zip(form.names, (form.schema, *record), strict=True))
    try:
        for name in form.parts:
            fields[name] = tuple([part._asdict() for part in fields[name]])
        data = form.serializer.to_json(fields, by_alias=True, warnings=False)
    except (ValueError, AttributeError, TypeError) as error:
        raise MalformedRecord(f"{kind.__name__} {record.pass_no} holds what JSON has no form for: {error}") from error
    # NaN and Infinity have these letters, and what is no Unicode was replaced by a sign that is not ASCII. A name may
    # have them too; reading tells.
    if (b"N" in data or b"I" in data or not data.isascii()) and not _comes_back(data, record):
        raise MalformedRecord(
            f"{kind.__name__} {record.pass_no} holds a number that is not finite, or a name that is no Unicode"
        )
    return data


def _comes_back(data: bytes, record: Record) -> bool:
    try:
        return from_json(data) == record
    except MalformedRecord:
        return False


def from_json(data: bytes | str) -> Record:
    """Read what `to_json` wrote; strict: no coercion, no unknown or missing field, no NaN, no other version.

    An integer where a float belongs is read as that float.

    Raises
    ------
    MalformedRecord
        Says what is wrong and where.
    """
    if isinstance(data, str):
        data = data.encode(errors="surrogatepass")
    wire = _wire()
    try:
        fields = wire.validate(data)
    except ValueError as error:
        raise _fault(data, error) from error
    form = wire.by_schema[fields["schema"]]
    names = len(fields) + len(fields.get("signals", ()))
    for name in form.parts:
        part = _PARTS[name]
        names += len(part._fields) * len(fields[name])
        fields[name] = tuple([part(**item) for item in fields[name]])
    # Of a name that stands twice pydantic takes the last. Each name has its colon, so where there are no more colons
    # than names none does; where there are, a text may hold one.
    if data.count(b":") != names:
        _parse(data)
    return form.make(form.values(fields))


def json_schemas() -> dict[str, dict[str, Any]]:
    """Return the JSON Schema (draft 2020-12) of each record's wire form, by the name and version it travels under.

    >>> list(json_schemas())
    ['Observation/1', 'Symptom/1', 'ChangeRequest/1', 'ChangePlan/1']
    """
    from pydantic import TypeAdapter

    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return {schema: dialect | TypeAdapter(_wire_type(kind, schema)).json_schema() for schema, kind in _SCHEMAS.items()}


_SCHEMAS = {f"{kind.__name__}/{WIRE_VERSION}": kind for kind in STAGES}


class _Form(NamedTuple):
    # What is known of one kind of record before one comes.
    schema: str
    names: tuple[str, ...]
    parts: tuple[str, ...]
    serializer: SchemaSerializer
    values: Callable[[dict[str, Any]], tuple[Any, ...]]
    make: Callable[[tuple[Any, ...]], Record]


class _Wire(NamedTuple):
    validate: Callable[[bytes], dict[str, Any]]
    by_schema: dict[str, _Form]
    by_kind: dict[type[Record], _Form]


@functools.cache
def _wire() -> _Wire:
    # pydantic costs a tenth of a second to import and is needed only where records leave the process.
    from pydantic import Field, TypeAdapter
    from pydantic_core import CoreConfig, SchemaSerializer

    types = {schema: _wire_type(kind, schema) for schema, kind in _SCHEMAS.items()}
    forms = {}
    for schema, kind in _SCHEMAS.items():
        names = kind._fields
        parts = tuple(name for name in names if name in _PARTS)
        # By default a number that is not finite becomes null, which may be legal in its place.
        serializer = SchemaSerializer(TypeAdapter(types[schema]).core_schema, CoreConfig(ser_json_inf_nan="constants"))
        forms[schema] = _Form(schema, ("schema", *names), parts, serializer, itemgetter(*names), kind._make)
    # The bytes are gone through once; the schema says which record they are.
    any_of_them: Any = Union[tuple(types.values())]  # noqa: UP007 - X | Y takes no tuple
    adapter: TypeAdapter[Any] = TypeAdapter(Annotated[any_of_them, Field(discriminator="schema")])
    by_kind = {kind: forms[schema] for schema, kind in _SCHEMAS.items()}
    return _Wire(adapter.validator.validate_json, forms, by_kind)


def _wire_type(kind: Any, schema: str | None = None) -> Any:
    # The JSON object that a named tuple is on the wire.
    from pydantic import ConfigDict, Field
    from typing_extensions import TypedDict  # pydantic takes the one of typing only from Python 3.12 on

    fields: dict[str, Any] = {} if schema is None else {"schema": Literal[schema]}
    for name, hint in get_type_hints(kind).items():
        fields[name] = hint
        if name in _PARTS:
            fields[name] = GenericAlias(tuple, (_wire_type(_PARTS[name]), ...))
    if "pass_no" in fields:
        fields["pass_no"] = Annotated[int, Field(alias="pass")]  # a word of Python's own
    typed_dict: Any = TypedDict  # made of a list of fields, which mypy does not know
    made = typed_dict(kind.__name__, fields)
    made.__doc__ = kind.__doc__.partition("\n")[0]
    made.__pydantic_config__ = ConfigDict(strict=True, allow_inf_nan=False, extra="forbid", loc_by_alias=False)
    return made


def _fault(data: bytes, refused: Any) -> MalformedRecord:
    # Say what is wrong with a message that pydantic refused.
    try:
        fields = _parse(data)
    except MalformedRecord as error:
        return error
    if not isinstance(fields, dict):
        return MalformedRecord(f"a record is a JSON object, not {type(fields).__name__}")
    schema = fields.get("schema")
    if not isinstance(schema, str) or schema not in _SCHEMAS:
        return MalformedRecord(f"schema {schema!r} is not one of {', '.join(_SCHEMAS)}")
    if "pass_no" in fields or "pass" not in fields:
        return MalformedRecord("the number of the pass belongs under 'pass'")
    first = refused.errors()[0]
    where = ".".join(str(part) for part in first["loc"][1:]) or "record"
    return MalformedRecord(f"{schema}: {where}: {first['msg']}")


def _parse(data: bytes) -> Any:
    try:
        return json.loads(data, parse_constant=_refuse_constant, object_pairs_hook=unique_names)
    except (ValueError, RecursionError) as error:
        raise MalformedRecord(f"not a JSON record: {error}") from error


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")


def unique_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make a JSON object of its pairs: what `json.loads` takes as `object_pairs_hook`.

    Raises
    ------
    ValueError
        A name stands twice, of which the standard library would take the last.
    """
    fields = dict(pairs)
    if len(fields) != len(pairs):
        raise ValueError("a name stands twice in one object")
    return fields
