"""What Knowledge says to what is sent and asked: taken, given, or refused with a reason."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import zenoh

from adapters.buses import pieces
from adapters.buses.messages import (
    Acknowledged,
    Control,
    Dropped,
    Happened,
    Join,
    Joined,
    Layout,
    State,
    Swapped,
    Table,
)
from adapters.buses.presence import Presence
from adapters.buses.wire import LARGEST_MESSAGE, LARGEST_TABLE, MISSING, OF_CONFIG, SINCE_LIMIT
from adapters.roles import ROLES, STAGE_OF
from adapters.stores.begun import begins, begun, breaks_off, failures
from adapters.stores.ledger import Ledger
from adapters.stores.sqlite_store import Snapshot, Swap
from knowledge import STAGES, Ack, MalformedRecord, QTable, from_json
from mape.errors import BusError
from mape.parts import owner
from mape.specs import PartSpec
from mape.tables import first_difference

TOLD_BY_ROLES = ("begun", "aborted", "carried", "swap refused")
"""Kinds of events that a role may tell; the others are Knowledge's own word."""


class Answer(NamedTuple):
    """What is said once all that was taken is on disk: the reply, and what is published before it.

    `published` is role, loop and record.
    """

    query: zenoh.Query
    payload: bytes
    published: tuple[str, int, bytes] | None = None


_WHOLE = b"whole="


class Relay(NamedTuple):
    """A question that is handed on to a role once it is on disk; what the role says answers it."""

    query: zenoh.Query
    role: str
    control: Control


class Refusal(BusError):
    """An answer that says no, and why; nothing was changed."""


class Answers:
    """Answers one question at a time; what it takes is written by the ledger's next commit.

    Parameters
    ----------
    ledger, presence
        The logs, and who is there.
    config, versions, snapshot_every
        As `KnowledgeHub` takes them.
    seal
        What Knowledge attaches to all that it publishes; told to who joins.
    proof
        Answers the challenge of a role that joins.
    fetch_table
        Asks Execute, in its own time, for the Q-table of a loop's episode, and has the question answered then.
    """

    def __init__(
        self,
        ledger: Ledger,
        presence: Presence,
        *,
        config: Mapping[str, Any] | None,
        versions: Mapping[str, str],
        snapshot_every: int,
        seal: str,
        proof: Callable[[str, str], str],
        fetch_table: Callable[[zenoh.Query, int, int], object],
    ) -> None:
        self.snapshot_every = snapshot_every
        self._ledger = ledger
        self._presence = presence
        self._config = config
        self._versions = versions
        self._seal = seal
        self._proof = proof
        self._fetch_table = fetch_table
        self._given = pieces.Given()
        self._gathered = {role: pieces.Gathered(LARGEST_TABLE) for role in ROLES}

    # What roles send.

    def append(self, query: zenoh.Query) -> Answer:
        """Take a record, or what a free-running loop dropped.

        Raises
        ------
        ValueError, MapekError
            It is not taken, and why. Nothing was changed.
        """
        parts = str(query.key_expr).split("/")
        if len(parts) != 5:
            raise Refusal(f"no records are taken under {query.key_expr}")
        loop, role = _whole(parts[2], "the loop"), parts[4]
        if role not in STAGE_OF:
            raise Refusal(f"role {role!r} sends no records; the roles are {', '.join(ROLES)}")
        stage = STAGE_OF[role]
        data = _payload(query, LARGEST_MESSAGE)
        epoch, _, behind = _attachment(query).partition(b"\n")
        self._check_epoch(role, epoch)
        if data.startswith(b'{"schema":"Dropped/'):
            return self._drop(query, loop, stage, data)
        # Its episode can be driven only once: the state is written together with the record, or neither is.
        state, table = self._behind(role, loop, stage, data, behind)
        ack, last = self._ledger.take(loop, stage, data)
        if ack is Ack.OK and state is not None:
            self._ledger.keep(role, Snapshot(loop, role, state.pass_no, state.state, table), stage)
        said = b'{"schema":"Acknowledged/1","ack":"%s","last":%d}' % (ack.value.encode(), last)
        return Answer(query, said, (role, loop, data) if ack is Ack.OK else None)

    def _behind(
        self, role: str, loop: int, stage: int, data: bytes, behind: bytes
    ) -> tuple[State, QTable | None] | tuple[None, None]:
        """Return the state that is to be written with a record; of one that is written already there is none."""
        if behind.startswith(_WHOLE):
            whole = behind.removeprefix(_WHOLE).decode("ascii", "replace")
            found = self._gathered[role].whole(whole)
            if found is None:
                if from_json(data).pass_no > self._ledger.last(loop)[stage]:
                    raise _missing(whole)
                return None, None
            self._gathered[role].forget(whole)
            behind = found
        return State.unpack(behind) if behind else (None, None)

    def _drop(self, query: zenoh.Query, loop: int, stage: int, data: bytes) -> Answer:
        dropped, _ = Dropped.unpack(data)
        if stage != 0:
            raise Refusal("only Execute says which episodes were dropped")
        ack, last = self._ledger.drop(loop, dropped.first, dropped.last)
        if ack is Ack.OK:
            count = dropped.last - dropped.first + 1
            text = f"{count} episodes were driven while Knowledge could not be reached, and are not in the log"
            self._ledger.note("execute", "dropped", text, loop, dropped.first)
        return Answer(query, Acknowledged(ack=ack.value, last=last).pack())  # type: ignore[arg-type]

    def _check_epoch(self, role: str, text: bytes) -> None:
        epoch = _whole(text.decode("ascii", "replace"), "the epoch")
        newest = self._ledger.epoch(role)
        if epoch < newest:
            raise Refusal(f"another {role} has joined since (epoch {newest}; this one has {epoch})")
        if epoch > newest or epoch == 0:
            raise Refusal(f"no {role} of epoch {epoch} has joined this Knowledge; was its log lost?")

    # What is asked of Knowledge.

    def asked(self, query: zenoh.Query) -> Answer | Relay | None:
        """Answer what is asked under ``knowledge``; None where the answer comes later.

        Raises
        ------
        ValueError, LookupError, MapekError
            The answer is no, and why. Nothing was changed.
        """
        what, _, role = str(query.key_expr).partition("/knowledge/")[2].partition("/")
        if what == "join":
            return self._join(query, role)
        if what == "status":
            return Answer(query, self._presence.status().pack())
        if what == "since":
            return self._since(query)
        if what == "table":
            return self._table(query)
        if what == "snapshot":
            return self._snapshot(query, role)
        if what == "piece" and role in STAGE_OF:
            return self._piece(query, role)
        if what == "remember" and role == "plan":
            return self._remember(query)
        if what == "swap":
            return self._swap(query)
        if what == "swapped" and role in STAGE_OF:
            return self._swapped(query, role)
        if what == "event" and role in STAGE_OF:
            return self._event(query, role)
        raise Refusal(f"nothing is asked under {query.key_expr}")

    def _join(self, query: zenoh.Query, role: str) -> Answer:
        join, _ = Join.unpack(_payload(query, LARGEST_MESSAGE))
        if role not in STAGE_OF or join.role != role:
            raise Refusal(f"role {join.role!r} joined as {role!r}; the roles are {', '.join(ROLES)}")
        for name in ("mapek", "wire"):
            here, there = self._versions.get(name), join.versions.get(name)
            if here != there:
                raise Refusal(
                    f"{role} is of {name} {there}, Knowledge of {name} {here}; run the same version everywhere"
                )
        if self._config is not None and join.config != self._config:
            name, here, there = first_difference(_telling_first(self._config), _telling_first(join.config))
            raise Refusal(
                f"{OF_CONFIG}{role} has another config than Knowledge: {name} is {there!r} in {role}, and {here!r} in "
                "Knowledge. Give both the same file and the same --set"
            )
        if join.layout is not None and role == "execute":
            self._ledger.begin(join.layout.model_dump(mode="json"))
        self._presence.joins(join)
        layout = self._ledger.layout
        if layout is None:  # who waits for Execute asks again and again, and joins once
            proof = self._proof(role, join.challenge)
            return Answer(query, Joined(epoch=0, seal="", units=0, layout=None, last=(), swaps=(), proof=proof).pack())
        epoch = self._ledger.join(role)
        others = {n: v for n, v in join.versions.items() if self._versions.get(n, v) != v}
        if others:
            text = ", ".join(f"{n} {v} there, {self._versions[n]} here" for n, v in others.items())
            self._ledger.note(role, "versions", f"hashes hold for equal versions only: {text}")
        self._ledger.note(role, "joined", f"epoch {epoch}, process {join.pid} on {join.host}")
        told = Layout(
            signals=layout.signals, detectors=layout.detectors, rates=layout.rates, max_actions=layout.max_actions
        )
        store, units = self._ledger.store, range(self._ledger.units)
        joined = Joined(
            epoch=epoch,
            seal=self._seal,
            proof=self._proof(role, join.challenge),
            units=self._ledger.units,
            layout=told,
            last=tuple(self._ledger.last(loop) for loop in range(self._ledger.units)),
            begun=tuple(begun(store, loop) for loop in units),
            failed=tuple(failures(store, loop, self._ledger.last(loop)[0] + 1) for loop in units),
            snapshot_every=self.snapshot_every,
            swaps=tuple(
                Swapped(loop=s.loop, pass_no=s.pass_no, part=s.part, to=s.spec)
                for s in self._ledger.store.swaps()
                if not s.planned
            ),
        )
        return Answer(query, joined.pack())

    def _since(self, query: zenoh.Query) -> Answer:
        loop = _whole(query.parameters.get("loop"), "loop")
        stages = {}
        for pair in str(query.parameters.get("from") or "").split(","):
            stage, _, number = pair.partition(":")
            stages[_whole(stage, "a stage of `from`")] = _whole(number, "a pass of `from`")
        if max(stages) >= len(STAGES):
            raise ValueError(f"stage is {max(stages)}; the stages of a pass are numbered from 0 to {len(STAGES) - 1}")
        found = self._ledger.since(loop, stages, SINCE_LIMIT)
        fits, size = 0, 0
        while fits < len(found) and (fits < len(STAGES) or size + len(found[fits]) < pieces.PIECE):
            size += len(found[fits])
            fits += 1
        more = fits < len(found) or len(found) == SINCE_LIMIT
        return Answer(query, "\n".join([f"{loop} {int(more)}", *found[:fits]]).encode())

    # What may be too large for one message.

    def give(self, query: zenoh.Query, data: bytes) -> Answer:
        """Answer by `data`, or by the first piece of it."""
        return Answer(query, self._given.answer(data))

    def _further(self, query: zenoh.Query) -> Answer | None:
        """Answer who asks for a further piece of what was given before; None where that is to be made anew."""
        whole = query.parameters.get("whole")
        if whole is None or query.parameters.get("at") is None:
            return None
        found = self._given.further(whole, _whole(query.parameters.get("at"), "at"))
        return None if found is None else Answer(query, found)

    def _piece(self, query: zenoh.Query, role: str) -> Answer:
        self._check_epoch(role, _attachment(query))
        return Answer(query, b"%d" % self._gathered[role].take(_payload(query, LARGEST_MESSAGE)))

    def _told(self, query: zenoh.Query, role: str) -> bytes:
        """Return what was told, in this message or in pieces before it."""
        whole = query.parameters.get("whole")
        if whole is None:
            return _payload(query, LARGEST_MESSAGE)
        found = self._gathered[role].whole(whole)
        if found is None:
            raise _missing(whole)
        return found

    def _snapshot(self, query: zenoh.Query, role: str) -> Answer:
        if role not in STAGE_OF:
            raise Refusal(f"role {role!r} has no state; the roles are {', '.join(ROLES)}")
        kept_in_pieces = query.parameters.get("whole") is not None and query.parameters.get("at") is None
        if query.payload is None and not kept_in_pieces:
            if (further := self._further(query)) is not None:
                return further
            found = self._ledger.store.snapshot(_whole(query.parameters.get("loop"), "loop"), role)
            if found is None:
                return Answer(query, b"")
            state = State(loop=found.loop, pass_no=found.pass_no, state=found.state, final=found.final)
            return self.give(query, state.pack(found.table))
        self._check_epoch(role, _attachment(query))
        state, table = State.unpack(self._told(query, role))
        snapshot = Snapshot(self._loop(state.loop), role, state.pass_no, state.state, table, state.final)
        ack, last = self._ledger.keep(role, snapshot, STAGE_OF[role])
        self._gathered[role].forget(query.parameters.get("whole") or "")
        return Answer(query, Acknowledged(ack=ack.value, last=last).pack())  # type: ignore[arg-type]

    def _table(self, query: zenoh.Query) -> Answer | None:
        if (further := self._further(query)) is not None:
            return further
        key = query.parameters.get("sha256")
        if key is not None:
            table = self._ledger.store.table(key)
            if table is None:
                raise LookupError(f"no Q-table {key[:12]}... is remembered")
            return self.give(query, Table(loop=None, pass_no=None).pack(table))
        loop = self._loop(_whole(query.parameters.get("loop"), "loop"))
        number = _whole(query.parameters.get("pass"), "pass")
        table = self._ledger.store.version(loop, number)
        if table is not None:
            return self.give(query, Table(loop=loop, pass_no=number).pack(table))
        self._fetch_table(query, loop, number)
        return None

    def _remember(self, query: zenoh.Query) -> Answer:
        _, table = Table.unpack(self._told(query, "plan"))
        if table is None:
            raise MalformedRecord("a Q-table to remember stands behind its message")
        key = self._ledger.store.keep_table(table, remembered=True)
        self._gathered["plan"].forget(query.parameters.get("whole") or "")
        return Answer(query, key.encode())

    def _swap(self, query: zenoh.Query) -> Relay:
        control, _ = Control.unpack(_payload(query, LARGEST_MESSAGE))
        if control.what != "swap" or control.part is None or control.to is None or control.question is None:
            raise MalformedRecord("who wants a swap names the part, what it is to be, and the question itself")
        role = owner(control.part)
        wanted = {"part": control.part, "to": control.to}
        asked = self._questions()
        known = asked.get(control.question, {**wanted, "loops": {}, "refused": False})
        if {name: known[name] for name in wanted} != wanted:
            raise Refusal(f"the question {control.question} has asked for {known['to']} as {known['part']}; ask anew")
        self._keep_questions({**asked, control.question: known})
        return Relay(query, role, control)

    def refused(self, question: str) -> None:
        """Take note that a role refused what was asked for: no later pass may have it."""
        asked = self._questions()
        self._keep_questions({**asked, question: {**asked[question], "refused": True}})

    def _questions(self) -> dict[str, Any]:
        """Return what operators asked for: question -> part, to, the pass from which each loop has it, refused."""
        asked: dict[str, Any] = self._ledger.store.facts().get("asked", {})
        return asked

    def _keep_questions(self, asked: dict[str, Any]) -> None:
        self._ledger.store.set_facts(asked=asked)

    def _swapped(self, query: zenoh.Query, role: str) -> Answer:
        swapped, _ = Swapped.unpack(_payload(query, LARGEST_MESSAGE))
        self._check_epoch(role, _attachment(query))
        loop, number = self._loop(swapped.loop), swapped.pass_no
        if owner(swapped.part) != role:
            raise Refusal(f"{swapped.part} is a part of {owner(swapped.part)}, not of {role}")
        if swapped.planned:
            self._check_planned(swapped)
        elif number <= self._ledger.last(loop)[STAGE_OF[role]]:
            raise Refusal(f"pass {number} has been made with the part before; {swapped.part} is replaced after it")
        else:
            self._check_asked_for(swapped)
        self._ledger.swapped(Swap(loop, number, swapped.part, swapped.to, swapped.handed_over, swapped.planned))
        if not swapped.planned:
            text = f"from pass {number} on, {swapped.part} is {json.dumps(swapped.to)}"
            self._ledger.note(role, "swapped", text, loop, number)
        return Answer(query, b"ok")

    def _check_planned(self, swapped: Swapped) -> None:
        told = {"pass": swapped.pass_no, "part": swapped.part, "to": swapped.to}
        if self._config is not None and told not in self._config.get("swap", ()):
            raise Refusal(f"the config plans no swap of {swapped.part} to {swapped.to} at pass {swapped.pass_no}")

    def _check_asked_for(self, swapped: Swapped) -> None:
        """Hold it against what an operator asked for: what nobody did, no role puts into the log."""
        asked = self._questions()
        known = asked.get(swapped.question or "")
        if known is None or (known["part"], _normal(known["to"])) != (swapped.part, _normal(swapped.to)):
            raise Refusal(f"nobody asked Knowledge for {swapped.to} as {swapped.part}: an operator does, by mapek swap")
        loop, begins = str(swapped.loop), known["loops"].get(str(swapped.loop))
        if known["refused"] or begins not in (None, swapped.pass_no):
            why = "it was refused" if known["refused"] else f"loop {loop} has it from pass {begins} on"
            raise Refusal(f"{swapped.part} was asked for once, and {why}; ask anew")
        loops = {**known["loops"], loop: swapped.pass_no}
        self._keep_questions({**asked, str(swapped.question): {**known, "loops": loops}})

    def _event(self, query: zenoh.Query, role: str) -> Answer:
        happened, _ = Happened.unpack(_payload(query, LARGEST_MESSAGE))
        self._check_epoch(role, _attachment(query))
        if happened.kind not in TOLD_BY_ROLES:
            raise Refusal(f"a role tells of {', '.join(TOLD_BY_ROLES)}; not of {happened.kind!r}")
        if happened.kind in ("begun", "aborted"):
            if role != "execute" or happened.loop is None or happened.pass_no is None:
                raise Refusal("only Execute begins episodes, and names its loop and episode")
            loop = self._loop(happened.loop)
            if happened.kind == "begun":
                begins(self._ledger.store, loop, happened.pass_no)
            else:
                breaks_off(self._ledger, happened.text, loop, happened.pass_no)
            return Answer(query, b"ok")
        self._ledger.note(role, happened.kind, happened.text, happened.loop, happened.pass_no)
        return Answer(query, b"ok")

    def _loop(self, number: int) -> int:
        if not 0 <= number < self._ledger.units:
            raise ValueError(f"loop {number}; this run has loops 0 to {self._ledger.units - 1}")
        return number


def _telling_first(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a config with what tells most at its beginning, and what is only for people at its end."""
    rest = [name for name in config if name not in ("system", *_FOR_PEOPLE)]
    return {name: config[name] for name in ("system", *rest, *_FOR_PEOPLE) if name in config}


_FOR_PEOPLE = ("name", "description")


def _normal(to: dict[str, Any]) -> dict[str, Any]:
    """Return a part as all write it, whoever left out what is so by default."""
    normal: dict[str, Any] = PartSpec.model_validate(to).model_dump(mode="json")
    return normal


def _missing(whole: str) -> Refusal:
    return Refusal(f"{MISSING}not all pieces of {whole[:12]} have come")


def _payload(query: zenoh.Query, largest: int) -> bytes:
    payload = query.payload
    if payload is None:
        raise MalformedRecord("the question carries nothing; what is sent stands in its payload")
    if len(payload) > largest:
        raise MalformedRecord(f"a message of {len(payload)} bytes; at most {largest} are taken here")
    return bytes(payload.to_bytes())


def _attachment(query: zenoh.Query) -> bytes:
    attachment = query.attachment
    if attachment is not None and len(attachment) > LARGEST_MESSAGE:
        raise MalformedRecord(f"an attachment of {len(attachment)} bytes; at most {LARGEST_MESSAGE} are taken")
    return b"" if attachment is None else bytes(attachment.to_bytes())


def _whole(text: str | None, what: str) -> int:
    if text is None or not (text.isascii() and text.isdigit() and len(text) <= 18):
        raise MalformedRecord(f"{what} is {text!r}; a whole number is taken")
    return int(text)
