"""Knowledge's end of the wire: the meeting point of a run's processes, and the only writer of its log."""

from __future__ import annotations

import logging
import os
import secrets
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, Self

import zenoh

from adapters.buses import pieces
from adapters.buses.answers import Answer, Answers, Relay
from adapters.buses.messages import (
    Control,
    Table,
)
from adapters.buses.own_keys import OwnKeys
from adapters.buses.pace import PACE, ROOM, Counted, Pace, Room
from adapters.buses.presence import Presence
from adapters.buses.wire import (
    ORDERED,
    Wire,
    hand_over,
)
from adapters.roles import KNOWLEDGE
from adapters.stores.ledger import Ledger
from knowledge import MalformedRecord, QTable
from mape.errors import BusError, MapekError, ResultsError

logger = logging.getLogger(__name__)

AT_ONCE = 1024
"""Most questions that are answered with one commit."""


SWAPPED_WITHIN = 60.0
"""Seconds that a role has to check a part that is asked for, and to reach the end of its pass."""

FREE_WITHIN = 10.0
"""Seconds that an endpoint has to be free again after its listener was closed, to be listened on with new keys."""


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
    requests
        Questions of a kind and role a second; see `adapters.buses.pace`.

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
        requests: int = PACE,
    ) -> None:
        self.ledger = ledger
        self.requests = requests
        self.wire = wire
        self.failure: ResultsError | None = None
        self.ended = threading.Event()  # the run is complete, or the worker has failed
        self.left = threading.Event()  # the run is complete, and all roles have come and gone
        facts = ledger.store.facts()
        # Who knows it is Knowledge, or was told by it: what others publish under its keys is not taken.
        self._seal = facts.get("seal") or secrets.token_hex(16)
        if "seal" not in facts:
            ledger.store.set_facts(seal=self._seal)
            ledger.commit()
        self._asked: SimpleQueue[tuple[str, Any] | None] = SimpleQueue()
        self.presence = Presence(ledger, wire.system, config or {})
        self.answers = Answers(
            ledger,
            self.presence,
            config=config,
            versions=dict(versions or {}),
            snapshot_every=snapshot_every,
            seal=self._seal,
            proof=wire.proof,
            fetch_table=self._fetch_table,
        )
        self._rooms = {kind: self._room(kind) for kind in ("append", "beat")}
        self._fetching: set[tuple[int, int]] = set()  # loop and pass of the Q-tables that Execute is asked for
        self._leave: Callable[..., object] | None = None
        self._worker: threading.Thread | None = None
        self._keys: OwnKeys | None = None
        self._declared = ExitStack()
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
        self._listen()
        # Daemonic, so that a hub that was never closed does not keep its process from ending.
        self._worker = threading.Thread(target=self._work, name="knowledge", daemon=True)
        self._worker.start()
        if self.wire.tls is not None:
            self._keys = OwnKeys(self.wire.tls, KNOWLEDGE)
        # At the latest at the interpreter's exit: a Zenoh thread that then still calls Python aborts the process.
        self._leave = weakref.finalize(self, self._close)

    def _listen(self) -> None:
        session = self.wire.listen()
        with ExitStack() as opened:
            opened.callback(session.close)
            declared = opened.enter_context(ExitStack())
            pace = Pace(
                lambda query: self._asked.put(("knowledge", query)),
                lambda query: _leave_unanswered(("knowledge", query)),
                self.requests,
                self.ledger.units,
            )
            pace.start()
            declared.callback(pace.stop)
            for key, handler in (
                (self.wire.append("*"), _direct(self._rooms["append"].hear)),
                (self.wire.ask("**"), _direct(pace.hear)),
            ):
                queryable = session.declare_queryable(key, handler, complete=True)
                declared.callback(queryable.undeclare)
            beats = session.declare_subscriber(self.wire.beat("*"), _direct(self._rooms["beat"].hear))
            declared.callback(beats.undeclare)
            alive = self.wire.alive("*")
            tokens = session.liveliness().declare_subscriber(alive, hand_over(self._asked, "alive"), history=True)
            declared.callback(tokens.undeclare)
            # Last: who sees the token finds everything else in place.
            token = session.liveliness().declare_token(self.wire.alive("knowledge", os.getpid()))
            declared.callback(token.undeclare)
            opened.pop_all()
        self._session, self._declared = session, declared

    def look_at_keys(self) -> None:
        """Warn of a certificate near its end; with one that was renewed, listen anew, while the run goes on.

        Raises
        ------
        BusError
            The endpoint cannot be listened on any more.
        """
        if self._keys is None or not self._keys.renewed():
            return
        self._declared.close()
        assert self._session is not None
        self._session.close()  # type: ignore[no-untyped-call]
        self._asked.put(("renewed", None))  # whose tokens come again is here; of the others nobody told
        deadline, tick = time.monotonic() + FREE_WITHIN, threading.Event()
        while True:
            try:
                self._listen()
                return
            except BusError:
                if time.monotonic() > deadline:
                    raise
                tick.wait(0.1)  # no event tells that the port is free

    def close(self) -> None:
        """Answer what was asked, then leave; the log stays."""
        if self._leave is not None:
            self._leave()

    def _close(self) -> None:
        self._declared.close()
        if self._worker is not None:
            self._finish(self._worker)
        assert self._session is not None
        self._session.close()  # type: ignore[no-untyped-call]

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
            while True:  # what came in between; its sender asks again
                _leave_unanswered(self._asked.get_nowait())

    # The worker.

    def _work(self) -> None:
        asked = self._asked.get()
        while asked is not None:
            answers: list[Answer | Relay] = []
            try:
                try:
                    for _ in range(AT_ONCE):
                        self._hear(*asked, answers)
                        asked = self._asked.get_nowait()
                        if asked is None:
                            break
                except Empty:
                    asked = ("", None)
                self.ledger.commit()
            except ResultsError as error:
                self._fail(error, asked, answers)
                return
            for answer in answers:
                if isinstance(answer, Relay):
                    # The role may take as long as the checks of a part do.
                    threading.Thread(target=self._relay, args=(answer,), daemon=True).start()
                else:
                    self._say(answer)
            if self.ledger.complete:
                self.ended.set()
                if self.presence.all_came_and_went:
                    self.left.set()
            if asked == ("", None):
                asked = self._asked.get()

    def _fail(self, error: ResultsError, asked: tuple[str, Any] | None, answers: list[Answer | Relay]) -> None:
        # The logs in memory are ahead of the disk: nothing more can be said that would be true. Who asked is told
        # nothing, and waits for the next Knowledge, as it would if this one had been killed.
        self.failure = error
        for unanswered in (asked, *(("", answer.query) for answer in answers)):
            _leave_unanswered(unanswered)
        self.ended.set()

    def _say(self, answer: Answer) -> None:
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

    def _room(self, kind: str) -> Room:
        return Room(self._asked, kind, lambda what: _leave_unanswered((kind, what)), ROOM * self.ledger.units)

    def _hear(self, kind: str, what: Any, answers: list[Answer | Relay]) -> None:
        if isinstance(what, Counted):
            room, what = what
            room.heard(what)
        try:
            if kind == "beat":
                self.presence.beats(what)
            elif kind == "alive":
                self.presence.token(what)
            elif kind == "renewed":
                self.presence.forget_tokens()
            elif kind == "table":
                query, number, loop, table = what
                self.ledger.store.keep_version(loop, number, table)
                answers.append(self.answers.give(query, Table(loop=loop, pass_no=number).pack(table)))
            elif kind == "swap refused":
                self.answers.refused(what)
            elif kind:
                answer = self.answers.append(what) if kind == "append" else self.answers.asked(what)
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
        self.presence.refused(role)
        self.ledger.note(role[:64], "refused", said[:500])

    def _relay(self, relay: Relay) -> None:
        """Hand an operator's question on, and the role's answer back; without one the operator asks again."""
        query, role, control = relay
        assert self._session is not None
        with suppress(zenoh.ZError), query:
            for reply in self._session.get(
                self.wire.control(role),
                payload=control.pack(),
                attachment=self._seal,
                timeout=SWAPPED_WITHIN,
                **ORDERED,
            ):
                if reply.ok is not None:
                    query.reply(self.wire.ask("swap"), reply.ok.payload)
                    return
                if reply.err is not None and (said := reply.err.payload.to_string()) != "Timeout":
                    self._asked.put(("swap refused", control.question))
                    query.reply_err(said)
                    return

    def _fetch_table(self, query: zenoh.Query, loop: int, number: int) -> None:
        if (loop, number) in self._fetching:  # who asks again is answered once it is here
            with suppress(zenoh.ZError), query:
                query.reply_err("later: it is being fetched")
            return
        self._fetching.add((loop, number))
        # Execute may itself be waiting for the worker.
        threading.Thread(target=self._ask_execute, args=(query, loop, number), daemon=True).start()

    def _ask_execute(self, query: zenoh.Query, loop: int, number: int) -> None:
        try:
            table = self._table_of_execute(loop, number)
        except (BusError, MalformedRecord) as error:
            with suppress(zenoh.ZError), query:
                query.reply_err(f"later: {error}")
        else:
            self._asked.put(("table", (query, number, loop, table)))
        finally:
            self._fetching.discard((loop, number))

    def _table_of_execute(self, loop: int, number: int) -> QTable:
        parts, found = pieces.Assembled(), None
        while found is None:
            further = {"whole": parts.whole, "at": parts.at} if parts.whole else {}
            control = Control(what="q_table", loop=loop, pass_no=number, **further)  # type: ignore[arg-type]
            found = parts.take(self._answer_of_execute(control))
        _, table = Table.unpack(found)
        if table is None:
            raise MalformedRecord("Execute answered without the Q-table that it was asked for")
        return table

    def _answer_of_execute(self, control: Control) -> bytes:
        said = f"Execute did not hand out its Q-table of pass {control.pass_no}"
        assert self._session is not None
        with suppress(zenoh.ZError):
            for reply in self._session.get(
                self.wire.control("execute"),
                payload=control.pack(),
                attachment=self._seal,
                timeout=self.wire.patience,
                **ORDERED,
            ):
                if reply.ok is not None:
                    return bytes(reply.ok.payload.to_bytes())
                said = reply.err.payload.to_string() if reply.err is not None else said
        raise BusError(said)


def _direct(hear: Callable[[Any], object]) -> zenoh.handlers.Callback[Any]:
    return zenoh.handlers.Callback(hear, indirect=False)


def _leave_unanswered(asked: tuple[str, Any] | None) -> None:
    """Let who asked, if it was a question, know that nothing comes: it asks again."""
    if asked is None:
        return
    kind, what = asked
    if isinstance(what, Counted):
        what = what.what
    query = what[0] if kind == "table" else what
    if isinstance(query, zenoh.Query):
        with query:
            pass
