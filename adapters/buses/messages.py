"""What travels beside the records: strict JSON messages with a schema tag and version, some with a Q-table behind.

A message is one line of JSON; where it brings a Q-table, the raw bytes of that follow the line. Nothing is ever
unpickled.
"""

from __future__ import annotations

import json
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from knowledge import MalformedRecord, QTable
from knowledge.records import unique_names

Number = Annotated[int, Field(ge=0, lt=2**63)]
Name = Annotated[str, Field(min_length=1, max_length=64)]


class Message(BaseModel):
    """Base of all messages: strict, frozen, no unknown field, no NaN or infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, populate_by_name=True)
    version: ClassVar[int] = 1

    @classmethod
    def tag(cls) -> str:
        """Return the schema tag, such as ``"Join/1"``."""
        return f"{cls.__name__}/{cls.version}"

    def pack(self, table: QTable | None = None) -> bytes:
        """Write the message, and behind it the table where there is one."""
        body = {"schema": self.tag(), **self.model_dump(mode="json")}
        if table is None:
            return json.dumps(body, separators=(",", ":"), allow_nan=False).encode()
        header, data = table.to_bytes()
        return json.dumps({**body, "q_table": header}, separators=(",", ":"), allow_nan=False).encode() + b"\n" + data

    @classmethod
    def unpack(cls, data: bytes) -> tuple[Self, QTable | None]:
        """Read what `pack` wrote.

        Raises
        ------
        MalformedRecord
            Says what is wrong and where.
        """
        line, newline, rest = data.partition(b"\n")
        try:
            fields = json.loads(line, object_pairs_hook=unique_names)
        except (ValueError, RecursionError) as error:
            raise MalformedRecord(f"not a {cls.tag()} message: {error}") from error
        if not isinstance(fields, dict) or fields.pop("schema", None) != cls.tag():
            raise MalformedRecord(f"not a message of schema {cls.tag()}, which alone is taken here")
        header = fields.pop("q_table", None)
        if (header is None) == bool(newline):
            raise MalformedRecord(
                f"{cls.tag()}: a Q-table has a header in the message and its bytes behind it, or none"
            )
        table = None
        if header is not None:
            # The names that are no Unicode could not even be told.
            if not isinstance(header, dict) or not all(name.isascii() for name in header):
                raise MalformedRecord(f"{cls.tag()}: q_table is {header!r}, not the header of a Q-table")
            table = QTable.from_bytes(header, rest)
        try:
            # From JSON text, where a list may stand for a tuple even in strict mode.
            return cls.model_validate_json(json.dumps(fields, allow_nan=False)), table
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"]) or "message"
            raise MalformedRecord(f"{cls.tag()}: {where}: {first['msg']}") from error
        except (ValueError, RecursionError) as error:  # NaN or infinity where any value may stand
            raise MalformedRecord(f"{cls.tag()}: {error}") from error


class Layout(Message):
    """What the rows of a run hold; only Execute, which has the system, can tell."""

    signals: Annotated[tuple[Name, ...], Field(max_length=4096)]
    detectors: Annotated[int, Field(ge=0, le=4096)]
    rates: Annotated[int, Field(ge=0, le=4096)]
    max_actions: Annotated[int, Field(ge=1, le=4096)]


class Join(Message):
    """A role introduces itself. Who has another config or other versions is refused.

    `challenge` is what Knowledge is to answer, to show that it has the run's token.
    """

    role: Name
    config: dict[str, Any]
    versions: dict[str, str]
    pid: Number
    host: Annotated[str, Field(max_length=255)]
    layout: Layout | None
    challenge: Annotated[str, Field(max_length=64)] = ""


class Swapped(Message):
    """From pass `pass_no` on, `part` of a loop is another one; also how a role is told of it when it joins.

    Either the config has `planned` it, or it answers the `question` that Knowledge handed on.
    """

    loop: Number
    pass_no: Number
    part: Name
    to: dict[str, Any]
    handed_over: bool = False
    planned: bool = False
    question: Name | None = None


class Joined(Message):
    """Knowledge's answer to Join; `layout` is None as long as no Execute has told it: then the role asks again.

    Attributes
    ----------
    seal : what Knowledge attaches to all that it publishes, and to what it asks a role.
    proof : that it has the run's token, see `Wire.proof`; empty with keys.
    last : per loop, the number of the last record of each stage; -1 where there is no plan 0.
    begun : per loop, the last episode that was begun and not broken off since, of systems that cannot be driven again.
    failed : per loop, how many attempts at its next episode were broken off.
    snapshot_every : passes from one state that is kept to the next.
    """

    epoch: Number
    seal: str
    units: Number
    layout: Layout | None
    last: tuple[tuple[int, int, int, int], ...]
    swaps: tuple[Swapped, ...]
    proof: str = ""
    begun: tuple[int, ...] = ()
    failed: tuple[int, ...] = ()
    snapshot_every: Annotated[int, Field(ge=1)] = 100


class Acknowledged(Message):
    """What became of records, or of a snapshot: `last` is the number of the last record of that stage in the log."""

    ack: Literal["ok", "duplicate", "gap"]
    last: int


class State(Message):
    """A role's state after the record of pass `pass_no` that it sent; Execute's has its Q-table behind it."""

    loop: Number
    pass_no: Number
    state: Any
    final: bool = False


class Dropped(Message):
    """Episodes of a free-running loop that were driven and could not be logged."""

    loop: Number
    first: Number
    last: Number


class Happened(Message):
    """Something to be noted beside the records."""

    kind: Annotated[str, Field(pattern=r"^[a-z][a-z -]{0,31}$")]
    text: Annotated[str, Field(max_length=2000)]
    loop: Number | None = None
    pass_no: Number | None = None


class Table(Message):
    """A Q-table, which stands behind it, and the episode at whose end it was; None for a remembered one."""

    loop: Number | None
    pass_no: Number | None


class Piece(Message):
    """A part of a message too large for one: `size` bytes with the hash `whole`, of which those from `at` on follow."""

    whole: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    size: Number
    at: Number


class Beat(Message):
    """The thread that does a role's work is alive; `passes` are those of all its loops together."""

    epoch: Number
    pid: Number
    passes: Number
    refused: Number
    waiting: bool


class Control(Message):
    """A question to a role: replace a part by another (`part`, `to`), or hand out the Q-table of an episode.

    Roles are asked by Knowledge alone. It keeps who of the operators wants which part, and hands the question on.

    One whose answer was lost is asked again with the same `question`, any text of its own, and is not answered anew.
    Of a Q-table too large for one message each further piece is asked for by `whole` and `at`, as `Piece` names them.
    """

    what: Literal["swap", "q_table"]
    part: Name | None = None
    to: dict[str, Any] | None = None
    question: Name | None = None
    loop: Number | None = None
    pass_no: Number | None = None
    whole: Name | None = None
    at: Number | None = None


class Replaced(Message):
    """A role's answer: from which pass on each loop has the new part, and whether it took over the old one's state."""

    part: Name
    passes: tuple[int, ...]
    handed_over: bool


class RoleStatus(Message):
    """How a role is."""

    alive: bool
    epoch: Number
    pid: Number
    host: str
    passes: Number
    last_pass: int
    beat_age: float | None
    refused: Annotated[int, Field(ge=0)]  # a sum


class Status(Message):
    """Who is there, and how far the run is."""

    system: str
    name: str
    mode: str
    episodes: Number
    units: Number
    passes: Number
    last: tuple[str, str, str, str]
    roles: dict[str, RoleStatus]
    refused: Number
    dropped: Number
    complete: bool
    pid: Number


MESSAGES: tuple[type[Message], ...] = (
    Acknowledged, Beat, Control, Dropped, Happened, Join, Joined, Piece, Replaced, State, Status, Swapped, Table,
)  # fmt: skip
