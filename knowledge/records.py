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
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast

if TYPE_CHECKING:
    from pydantic import TypeAdapter

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


@functools.cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    # pydantic costs a tenth of a second to import and is needed only where records leave the process.
    from pydantic import ConfigDict, TypeAdapter

    return TypeAdapter(kind, config=ConfigDict(strict=True, allow_inf_nan=False))


def to_json(record: Record) -> bytes:
    """Write a record as one JSON object: ``schema``, its version, and the record's fields by name.

    >>> to_json(ChangePlan(0, 1, 0.5, (0.1,), (), (), (), False, None))  # doctest: +ELLIPSIS
    b'{"schema":"ChangePlan/1","loop":0,"pass":1,"epsilon":0.5,"learning_rate":[0.1],...
    """
    fields = record._asdict()
    fields["pass"] = fields.pop("pass_no")
    if "readings" in fields:
        fields["readings"] = [reading._asdict() for reading in fields["readings"]]
    if "drifts" in fields:
        fields["drifts"] = [drift._asdict() for drift in fields["drifts"]]
    body = {"schema": f"{type(record).__name__}/{WIRE_VERSION}", "loop": fields.pop("loop"), "pass": fields.pop("pass")}
    try:
        return json.dumps(body | fields, separators=(",", ":"), allow_nan=False).encode()
    except ValueError as error:
        raise MalformedRecord(f"{type(record).__name__} {record.pass_no} holds a number that is not finite") from error


def from_json(data: bytes | str) -> Record:
    """Read what `to_json` wrote; strict: no coercion, no unknown or missing field, no NaN, no other version.

    Raises
    ------
    MalformedRecord
        Says what is wrong and where.
    """
    try:
        fields = json.loads(data, parse_constant=_refuse_constant, object_pairs_hook=_unique)
    except (ValueError, RecursionError) as error:
        raise MalformedRecord(f"not a JSON record: {error}") from error
    if not isinstance(fields, dict):
        raise MalformedRecord(f"a record is a JSON object, not {type(fields).__name__}")
    schema = fields.pop("schema", None)
    kinds = {f"{kind.__name__}/{WIRE_VERSION}": kind for kind in STAGES}
    if not isinstance(schema, str) or schema not in kinds:
        raise MalformedRecord(f"schema {schema!r} is not one of {', '.join(kinds)}")
    if "pass_no" in fields or "pass" not in fields:
        raise MalformedRecord("the number of the pass belongs under 'pass'")
    fields["pass_no"] = fields.pop("pass")
    try:
        # Validated from JSON text, where a list may stand for a tuple even in strict mode.
        record: Record = _adapter(cast(Any, kinds[schema])).validate_json(json.dumps(fields))
    except ValueError as error:
        first = error.errors()[0] if hasattr(error, "errors") else {"loc": (), "msg": str(error)}
        where = ".".join(str(part) for part in first["loc"]) or "record"
        raise MalformedRecord(f"{schema}: {where}: {first['msg']}") from error
    return record


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) != len(pairs):
        raise ValueError("a name stands twice in one object")
    return fields
