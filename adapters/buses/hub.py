"""Knowledge's end of the wire: the meeting point of a run's processes, and the only writer of its log."""

from __future__ import annotations

import json
import logging
import os
import secrets
import socket
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, NamedTuple, Self

import zenoh

from adapters.buses.messages import (
    Acknowledged,
    Beat,
    Control,
    Dropped,
    Happened,
    Join,
    Joined,
    Layout,
    RoleStatus,
    State,
    Status,
    Swapped,
    Table,
)
from adapters.buses.wire import (
    LARGEST_MESSAGE,
    LARGEST_TABLE,
    ORDERED,
    ROLES,
    STAGE_OF,
    WIRE_VERSION,
    Wire,
    hand_over,
)
from adapters.stores.ledger import Ledger
from adapters.stores.sqlite_store import Snapshot, Swap
from knowledge import STAGES, Ack, MalformedRecord
from mape.errors import BusError, MapekError, ResultsError
from mape.parts import owner
from mape.tables import first_difference

logger = logging.getLogger(__name__)

SINCE_LIMIT = 512
"""Most records in one answer to `since`; a shorter answer reaches the end of the log."""

AT_ONCE = 1024
"""Most questions that are answered with one commit."""

OF_CONFIG = "config: "
"""What a refusal begins with that is a matter of the config."""

TOLD_BY_ROLES = ("begun", "aborted", "swap refused")
"""Kinds of events that a role may tell; the others are Knowledge's own word."""

TABLE_WITHIN = 5.0
"""Seconds that Execute has to hand out a Q-table."""


class _Answer(NamedTuple):
    # What is said once all that was taken is on disk: the reply, and what is published before it.
    query: zenoh.Query
    payload: bytes
    published: tuple[str, int, bytes] | None = None  # role, loop, record


class _Refused(BusError):
    # An answer that says no, and why; nothing was changed.
    pass


class _Seen:
    """What is known of a role beside its epoch."""

    def __init__(self) -> None:
        self.tokens: set[int] = set()
        self.pid = 0
        self.host = ""
        self.beat: Beat | None = None
        self.beat_at: float | None = None
        self.refused = 0


class KnowledgeHub:
    """Appends what is sent, writes it to disk, publishes what it appended, and acknowledges; in this order.

    One worker thread answers all questions, so what is published has the order of the log, and nothing is published or
    acknowledged that is not on disk. What has gathered while it wrote is answered with one commit. What cannot be
    answered gets an error reply that says why, is counted, noted in the store, and changes nothing.

    Parameters
    ----------
    ledger
        The logs. Between `connect` and `close` only the worker touches them.
    wire
        Where to listen.
    config
        The run's config, which every role must have too; None takes roles of any config (for tests of the wire).
    versions
        Versions of what must be equal in all processes.
    snapshot_every
        Passes from one state that a role has kept to the next: what it does again, at most, after a crash.

    Raises
    ------
    ResultsError
        `failure`, where the disk is full: the worker has then ended.
    """

    def __init__(
        self,
        ledger: Ledger,
        wire: Wire,
        config: Mapping[str, Any] | None = None,
        versions: Mapping[str, str] | None = None,
        snapshot_every: int = 100,
    ) -> None:
        self.ledger = ledger
        self.wire = wire
        self.failure: ResultsError | None = None
        self.ended = threading.Event()  # the run is complete, or the worker has failed
        self.left = threading.Event()  # the run is complete, and all roles have come and gone
        self._config = config
        self._versions = dict(versions or {})
        self._snapshot_every = snapshot_every
        facts = ledger.store.facts()
        # Who knows it is Knowledge, or was told by it: what others publish under its keys is not taken.
        self._seal = facts.get("seal") or secrets.token_hex(16)
        if "seal" not in facts:
            ledger.store.set_facts(seal=self._seal)
            ledger.commit()
        self._asked: SimpleQueue[tuple[str, Any] | None] = SimpleQueue()
        self._seen = {role: _Seen() for role in ROLES}
        self._came: set[str] = set()  # roles that were here since this Knowledge listens
        self._leave: Callable[..., object] | None = None
        self._worker: threading.Thread | None = None
        self._session: zenoh.Session | None = None

    def connect(self) -> None:
        """Listen, and begin to answer.

        Raises
        ------
        BusError
            The endpoint is taken, or cannot be made.
        ConfigError
            A certificate is missing, or of no use.
        """
        if self._worker is not None:
            return
        with ExitStack() as opened:
            self._session = session = self.wire.listen()
            opened.callback(session.close)
            # Daemonic, so that a hub that was never closed does not keep its process from ending.
            self._worker = worker = threading.Thread(target=self._work, name="knowledge", daemon=True)
            worker.start()
            opened.callback(self._finish, worker)
            for kind, key in (("append", self.wire.append("*")), ("knowledge", self.wire.ask("**"))):
                queryable = session.declare_queryable(key, hand_over(self._asked, kind), complete=True)
                opened.callback(queryable.undeclare)
            beats = session.declare_subscriber(self.wire.beat("*"), hand_over(self._asked, "beat"))
            opened.callback(beats.undeclare)
            alive = self.wire.alive("*")
            tokens = session.liveliness().declare_subscriber(alive, hand_over(self._asked, "alive"), history=True)
            opened.callback(tokens.undeclare)
            # Last: who sees the token finds everything else in place.
            token = session.liveliness().declare_token(self.wire.alive("knowledge", os.getpid()))
            opened.callback(token.undeclare)
            # At the latest at the interpreter's exit: a Zenoh thread that then still calls Python aborts the process.
            self._leave = weakref.finalize(self, opened.pop_all().close)

    def close(self) -> None:
        """Answer what was asked, then leave; the log stays."""
        if self._leave is not None:
            self._leave()

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _finish(self, worker: threading.Thread) -> None:
        self._asked.put(None)
        worker.join()
        self._worker = None
        with suppress(Empty):
            while True:  # what came in between is dropped unanswered; its sender asks again
                if isinstance((left := self._asked.get_nowait() or ("", None))[1], zenoh.Query):
                    with left[1]:
                        pass

    # The worker.

    def _work(self) -> None:
        asked = self._asked.get()
        while asked is not None:
            answers: list[_Answer] = []
            try:
                for _ in range(AT_ONCE):
                    self._hear(*asked, answers)
                    asked = self._asked.get_nowait()
                    if asked is None:
                        break
            except Empty:
                asked = ("", None)
            except ResultsError as error:
                self._fail(error, answers)
                return
            try:
                self.ledger.commit()
            except ResultsError as error:
                self._fail(error, answers)
                return
            for answer in answers:
                self._say(answer)
            if self.ledger.complete:
                self.ended.set()
                if self._came.issuperset(ROLES) and not any(seen.tokens for seen in self._seen.values()):
                    self.left.set()
            if asked == ("", None):
                asked = self._asked.get()

    def _fail(self, error: ResultsError, answers: list[_Answer]) -> None:
        # The logs in memory are ahead of the disk: nothing more can be said that would be true.
        self.failure = error
        for answer in answers:
            with suppress(Exception), answer.query:
                answer.query.reply_err(str(error))
        self.ended.set()

    def _say(self, answer: _Answer) -> None:
        with suppress(zenoh.ZError), answer.query:  # who asked may have gone; the others have not
            if answer.published is not None:
                role, loop, record = answer.published
                assert self._session is not None
                # By no declared publisher: for a moment that would know of no taker, and send nothing.
                self._session.put(
                    self.wire.stream(role, loop), record, attachment=self._seal,
                    encoding=zenoh.Encoding.APPLICATION_JSON, **ORDERED,
                )  # fmt: skip
            # A question may name any system: what is said stands under this one's key.
            _, _, rest = str(answer.query.key_expr).split("/", 2)
            answer.query.reply(f"mape/{self.wire.system}/{rest}", answer.payload)

    def _hear(self, kind: str, what: Any, answers: list[_Answer]) -> None:
        try:
            if kind == "beat":
                self._see_beat(what)
            elif kind == "alive":
                self._see_token(what)
            elif kind == "table":
                query, number, loop, table = what
                self.ledger.store.keep_version(loop, number, table)
                answers.append(_Answer(query, Table(loop=loop, pass_no=number).pack(table)))
            elif kind:
                answer = self._append(what) if kind == "append" else self._knowledge(what)
                if answer is not None:
                    answers.append(answer)
        except ResultsError:
            raise
        except Exception as error:
            # What is no fault of the question is told as well; without a reply the sender would ask again.
            said = str(error)
            key = getattr(what, "key_expr", kind)
            if not isinstance(error, (ValueError, LookupError, MapekError)):
                logger.exception("Knowledge failed over %s", key)
                said = f"Knowledge failed with {type(error).__name__}: {error}"
            # JSON can hold what is no Unicode, and can then be neither told nor stored.
            said = said.encode(errors="backslashreplace").decode()
            self._refuse(str(key).rsplit("/", 1)[-1], said)
            if isinstance(what, zenoh.Query):
                with suppress(zenoh.ZError), what:
                    what.reply_err(said)

    def _refuse(self, role: str, said: str) -> None:
        logger.warning("refused, from %s: %s", role, said[:300])
        if role in self._seen:
            self._seen[role].refused += 1
        self.ledger.note(role[:64], "refused", said[:500])

    # What roles send.

    def _append(self, query: zenoh.Query) -> _Answer:
        parts = str(query.key_expr).split("/")
        if len(parts) != 5:
            raise _Refused(f"no records are taken under {query.key_expr}")
        loop, role = _whole(parts[2], "the loop"), parts[4]
        if role not in STAGE_OF:
            raise _Refused(f"role {role!r} sends no records; the roles are {', '.join(ROLES)}")
        stage = STAGE_OF[role]
        data = _payload(query, LARGEST_MESSAGE)
        epoch, _, behind = _attachment(query).partition(b"\n")
        self._check_epoch(role, epoch)
        if data.startswith(b'{"schema":"Dropped/'):
            return self._drop(query, loop, stage, data)
        # Its episode can be driven only once: the state is written together with the record, or neither is.
        state, table = State.unpack(behind) if behind else (None, None)
        ack, last = self.ledger.take(loop, stage, data)
        if ack is Ack.OK and state is not None:
            self.ledger.keep(role, Snapshot(loop, role, state.pass_no, state.state, table), stage)
        said = b'{"schema":"Acknowledged/1","ack":"%s","last":%d}' % (ack.value.encode(), last)
        return _Answer(query, said, (role, loop, data) if ack is Ack.OK else None)

    def _drop(self, query: zenoh.Query, loop: int, stage: int, data: bytes) -> _Answer:
        dropped, _ = Dropped.unpack(data)
        if stage != 0:
            raise _Refused("only Execute says which episodes were dropped")
        ack, last = self.ledger.drop(loop, dropped.first, dropped.last)
        if ack is Ack.OK:
            count = dropped.last - dropped.first + 1
            text = f"{count} episodes were driven while Knowledge could not be reached, and are not in the log"
            self.ledger.note("execute", "dropped", text, loop, dropped.first)
        return _Answer(query, Acknowledged(ack=ack.value, last=last).pack())  # type: ignore[arg-type]

    def _check_epoch(self, role: str, text: bytes) -> None:
        epoch = _whole(text.decode("ascii", "replace"), "the epoch")
        newest = self.ledger.epoch(role)
        if epoch < newest:
            raise _Refused(f"another {role} has joined since (epoch {newest}; this one has {epoch})")
        if epoch > newest or epoch == 0:
            raise _Refused(f"no {role} of epoch {epoch} has joined this Knowledge; was its log lost?")

    # What is asked of Knowledge.

    def _knowledge(self, query: zenoh.Query) -> _Answer | None:
        what, _, role = str(query.key_expr).partition("/knowledge/")[2].partition("/")
        # A selector may name any system.
        if what == "join":
            return self._join(query, role)
        if what == "status":
            return _Answer(query, self.status().pack())
        if what == "since":
            return self._since(query)
        if what == "table":
            return self._table(query)
        if what == "snapshot":
            return self._snapshot(query, role)
        if what == "remember" and role == "plan":
            _, table = Table.unpack(_payload(query, LARGEST_TABLE))
            if table is None:
                raise MalformedRecord("a Q-table to remember stands behind its message")
            return _Answer(query, self.ledger.store.keep_table(table, remembered=True).encode())
        if what == "swapped" and role in STAGE_OF:
            swapped, _ = Swapped.unpack(_payload(query, LARGEST_MESSAGE))
            self._check_epoch(role, _attachment(query))
            loop, number = self._loop(swapped.loop), swapped.pass_no
            if owner(swapped.part) != role:
                raise _Refused(f"{swapped.part} is a part of {owner(swapped.part)}, not of {role}")
            if not swapped.planned and number <= self.ledger.last(loop)[STAGE_OF[role]]:
                raise _Refused(f"pass {number} has been made with the part before; {swapped.part} is replaced after it")
            self.ledger.swapped(Swap(loop, number, swapped.part, swapped.to, swapped.handed_over, swapped.planned))
            if not swapped.planned:
                text = f"from pass {number} on, {swapped.part} is {json.dumps(swapped.to)}"
                self.ledger.note(role, "swapped", text, loop, number)
            return _Answer(query, b"ok")
        if what == "event" and role in STAGE_OF:
            happened, _ = Happened.unpack(_payload(query, LARGEST_MESSAGE))
            self._check_epoch(role, _attachment(query))
            if happened.kind not in TOLD_BY_ROLES:
                raise _Refused(f"a role tells of {', '.join(TOLD_BY_ROLES)}; not of {happened.kind!r}")
            if happened.kind == "begun":  # one per episode: only the last of them counts
                if role != "execute" or happened.loop is None or happened.pass_no is None:
                    raise _Refused("only Execute begins episodes, and names its loop and episode")
                loop = self._loop(happened.loop)
                begun = {**self.ledger.store.facts().get("begun", {}), str(loop): happened.pass_no}
                self.ledger.store.set_facts(begun=begun)
                return _Answer(query, b"ok")
            self.ledger.note(role, happened.kind, happened.text, happened.loop, happened.pass_no)
            return _Answer(query, b"ok")
        raise _Refused(f"nothing is asked under {query.key_expr}")

    def _join(self, query: zenoh.Query, role: str) -> _Answer:
        join, _ = Join.unpack(_payload(query, LARGEST_MESSAGE))
        if role not in STAGE_OF or join.role != role:
            raise _Refused(f"role {join.role!r} joined as {role!r}; the roles are {', '.join(ROLES)}")
        for name in ("mapek", "wire"):
            here, there = self._versions.get(name), join.versions.get(name)
            if here != there:
                raise _Refused(
                    f"{role} is of {name} {there}, Knowledge of {name} {here}; run the same version everywhere"
                )
        if self._config is not None and join.config != self._config:
            name, here, there = first_difference(self._config, join.config)
            raise _Refused(
                f"{OF_CONFIG}{role} has another config than Knowledge: {name} is {there!r} in {role}, and {here!r} in "
                "Knowledge. Give both the same file and the same --set"
            )
        if join.layout is not None and role == "execute":
            self.ledger.begin(_facts(join.layout))
        seen = self._seen[role]
        seen.pid, seen.host, seen.beat, seen.beat_at = join.pid, join.host, None, time.monotonic()
        layout = self.ledger.layout
        if layout is None:  # who waits for Execute asks again and again, and joins once
            return _Answer(query, Joined(epoch=0, seal="", units=0, layout=None, last=(), swaps=()).pack())
        epoch = self.ledger.join(role)
        others = {n: v for n, v in join.versions.items() if self._versions.get(n, v) != v}
        if others:
            text = ", ".join(f"{n} {v} there, {self._versions[n]} here" for n, v in others.items())
            self.ledger.note(role, "versions", f"hashes hold for equal versions only: {text}")
        self.ledger.note(role, "joined", f"epoch {epoch}, process {join.pid} on {join.host}")
        told = Layout(
            signals=layout.signals, detectors=layout.detectors, rates=layout.rates, max_actions=layout.max_actions
        )
        joined = Joined(
            epoch=epoch,
            seal=self._seal,
            units=self.ledger.units,
            layout=told,
            last=tuple(self.ledger.last(loop) for loop in range(self.ledger.units)),
            begun=tuple(
                self.ledger.store.facts().get("begun", {}).get(str(loop), 0) for loop in range(self.ledger.units)
            ),
            snapshot_every=self._snapshot_every,
            swaps=tuple(
                Swapped(loop=s.loop, pass_no=s.pass_no, part=s.part, to=s.spec)
                for s in self.ledger.store.swaps()
                if not s.planned
            ),
        )
        return _Answer(query, joined.pack())

    def _since(self, query: zenoh.Query) -> _Answer:
        loop = _whole(query.parameters.get("loop"), "loop")
        stages = {}
        for pair in str(query.parameters.get("from") or "").split(","):
            stage, _, number = pair.partition(":")
            stages[_whole(stage, "a stage of `from`")] = _whole(number, "a pass of `from`")
        if max(stages) >= len(STAGES):
            raise ValueError(f"stage is {max(stages)}; the stages of a pass are numbered from 0 to {len(STAGES) - 1}")
        return _Answer(query, "\n".join([str(loop), *self.ledger.since(loop, stages, SINCE_LIMIT)]).encode())

    def _snapshot(self, query: zenoh.Query, role: str) -> _Answer:
        if role not in STAGE_OF:
            raise _Refused(f"role {role!r} has no state; the roles are {', '.join(ROLES)}")
        if query.payload is None:
            found = self.ledger.store.snapshot(_whole(query.parameters.get("loop"), "loop"), role)
            if found is None:
                return _Answer(query, b"")
            state = State(loop=found.loop, pass_no=found.pass_no, state=found.state, final=found.final)
            return _Answer(query, state.pack(found.table))
        self._check_epoch(role, _attachment(query))
        state, table = State.unpack(_payload(query, LARGEST_TABLE))
        snapshot = Snapshot(self._loop(state.loop), role, state.pass_no, state.state, table, state.final)
        ack, last = self.ledger.keep(role, snapshot, STAGE_OF[role])
        return _Answer(query, Acknowledged(ack=ack.value, last=last).pack())  # type: ignore[arg-type]

    def _table(self, query: zenoh.Query) -> _Answer | None:
        key = query.parameters.get("sha256")
        if key is not None:
            table = self.ledger.store.table(key)
            if table is None:
                raise LookupError(f"no Q-table {key[:12]}... is remembered")
            return _Answer(query, Table(loop=None, pass_no=None).pack(table))
        loop = self._loop(_whole(query.parameters.get("loop"), "loop"))
        number = _whole(query.parameters.get("pass"), "pass")
        table = self.ledger.store.version(loop, number)
        if table is not None:
            return _Answer(query, Table(loop=loop, pass_no=number).pack(table))
        # Execute may itself be waiting for this thread.
        threading.Thread(target=self._fetch_table, args=(query, loop, number), daemon=True).start()
        return None

    def _fetch_table(self, query: zenoh.Query, loop: int, number: int) -> None:
        said = f"Execute did not hand out its Q-table of pass {number}"
        control = Control(what="q_table", loop=loop, pass_no=number).pack()
        assert self._session is not None
        with suppress(zenoh.ZError):
            for reply in self._session.get(self.wire.control("execute"), payload=control, timeout=TABLE_WITHIN):
                if reply.ok is None:
                    said = reply.err.payload.to_string() if reply.err is not None else said
                    continue
                try:
                    _, table = Table.unpack(reply.ok.payload.to_bytes())
                except MalformedRecord as error:
                    said = str(error)
                    continue
                if table is not None:
                    self._asked.put(("table", (query, number, loop, table)))
                    return
        with suppress(zenoh.ZError), query:
            query.reply_err(f"later: {said}")

    def _loop(self, number: int) -> int:
        if not 0 <= number < self.ledger.units:
            raise ValueError(f"loop {number}; this run has loops 0 to {self.ledger.units - 1}")
        return number

    # Who is there.

    def _see_beat(self, sample: zenoh.Sample) -> None:
        role = str(sample.key_expr).rsplit("/", 1)[-1]
        try:
            if len(sample.payload) > LARGEST_MESSAGE:
                raise MalformedRecord(f"a heartbeat of {len(sample.payload)} bytes")
            beat, _ = Beat.unpack(sample.payload.to_bytes())
        except MalformedRecord as error:
            self._refuse(role, f"heartbeat: {error}")
            return
        if role in self._seen and beat.epoch == self.ledger.epoch(role):
            seen = self._seen[role]
            seen.beat, seen.beat_at, seen.pid = beat, time.monotonic(), beat.pid

    def _see_token(self, sample: zenoh.Sample) -> None:
        role, epoch = str(sample.key_expr).split("/")[-2:]
        if role not in self._seen or not (epoch.isascii() and epoch.isdigit() and len(epoch) <= 18):
            return
        if sample.kind == zenoh.SampleKind.PUT:
            self._seen[role].tokens.add(int(epoch))
            self._came.add(role)
        else:
            self._seen[role].tokens.discard(int(epoch))

    def status(self) -> Status:
        """Say who is there, and how far the run is."""
        ledger = self.ledger
        lasts = [ledger.last(loop) for loop in range(ledger.units)]
        now = time.monotonic()
        roles = {}
        for role, seen in self._seen.items():
            stage = STAGE_OF[role]
            beat = seen.beat
            roles[role] = RoleStatus(
                alive=bool(seen.tokens),
                epoch=ledger.epoch(role),
                pid=seen.pid,
                host=seen.host,
                passes=sum(max(0, last[stage]) for last in lasts),
                last_pass=min(last[stage] for last in lasts),
                beat_age=None if seen.beat_at is None else round(now - seen.beat_at, 3),
                refused=seen.refused + (0 if beat is None else beat.refused),
            )
        newest = [ledger.store.body(0, last, stage) if last >= 0 else None for stage, last in enumerate(lasts[0])]
        config = self._config or {}
        return Status(
            system=self.wire.system,
            name=str(config.get("name", "run")),
            mode="free" if ledger.free else "lockstep",
            episodes=ledger.episodes,
            units=ledger.units,
            passes=sum(max(0, last[3]) for last in lasts),
            last=tuple(body or "" for body in newest),  # type: ignore[arg-type]
            roles=roles,
            refused=ledger.refused,
            dropped=sum(b - a + 1 for loop in range(ledger.units) for a, b in ledger.store.dropped(loop)),
            complete=ledger.complete,
            pid=os.getpid(),
        )


def versions() -> dict[str, str]:
    """Return the versions that processes of one run compare."""
    from adapters.results.folder import versions as of_results

    return {**of_results(), "wire": str(WIRE_VERSION)}


def host() -> str:
    """Return this machine's name, for people."""
    return socket.gethostname()[:255]


def _facts(layout: Layout) -> dict[str, Any]:
    return layout.model_dump(mode="json")


def _payload(query: zenoh.Query, largest: int) -> bytes:
    payload = query.payload
    if payload is None:
        raise MalformedRecord("the question carries nothing; what is sent stands in its payload")
    if len(payload) > largest:
        raise MalformedRecord(f"a message of {len(payload)} bytes; at most {largest} are taken here")
    return bytes(payload.to_bytes())


def _attachment(query: zenoh.Query) -> bytes:
    attachment = query.attachment
    if attachment is not None and len(attachment) > LARGEST_TABLE:
        raise MalformedRecord(f"an attachment of {len(attachment)} bytes; at most {LARGEST_TABLE} are taken")
    return b"" if attachment is None else bytes(attachment.to_bytes())


def _whole(text: str | None, what: str) -> int:
    if text is None or not (text.isascii() and text.isdigit() and len(text) <= 18):
        raise MalformedRecord(f"{what} is {text!r}; a whole number is taken")
    return int(text)
