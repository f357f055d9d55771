"""A role's end of the wire: what it sends is appended once, what it is to see comes in order, once."""

from __future__ import annotations

import hmac
import json
import logging
import os
import secrets
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, NamedTuple, Self

import zenoh

from adapters.buses import pieces
from adapters.buses.inbox import Inbox
from adapters.buses.keeping import Keeping
from adapters.buses.messages import Beat, Control, Dropped, Join, Joined, Layout, State
from adapters.buses.outbox import Outbox
from adapters.buses.own_keys import OwnKeys
from adapters.buses.questions import Questions, Refused
from adapters.buses.round_trip import RoundTrip
from adapters.buses.wire import INPUT, LARGEST_MESSAGE, MISSING, ORDERED, Unanswered, Wire, hand_over, host, role_of
from adapters.roles import KNOWLEDGE, STAGE_OF
from knowledge import MalformedRecord, QTable, Record, to_json
from mape.errors import BusError, ConfigError

logger = logging.getLogger(__name__)

KEEP_UP_EVERY = 0.1
"""Seconds between two looks at what is outstanding."""

DEAF_AFTER = 4.0
"""Seconds of nothing but lost questions, or what an answer takes if that is more, after which a session is given up."""

FIRST_TRY = 0.5
"""Seconds that the first try to open a session takes at most; each further one over a slow network twice as long."""

TRY_EVERY = 0.05
"""Seconds from one try to the next, which may have ended at once, as where there is no token yet."""

LOOK_AT_KEYS_EVERY = 1.0
"""Seconds between two looks at the files of one's own keys."""

BEAT_EVERY = 0.5
"""Seconds between two heartbeats."""


class Asked(NamedTuple):
    """A question to this role; answer it by `Member.answer` or `Member.refuse`."""

    query: zenoh.Query
    control: Control


class Member(Questions):
    """One role's link to Knowledge, for all loops of the run.

    Nothing rests on delivery. A record is sent until Knowledge has acknowledged it, which appends it once however often
    it comes; the acknowledgement is not waited for (`Outbox`). Of what is published each record is seen once, in order;
    what was missed is asked for (`Inbox`).

    Constructing does no I/O. `connect`, then `watch`, `send`, `receive`, `close`; all on one thread.

    Parameters
    ----------
    wire
        Where Knowledge listens.
    role
        What this is: execute, monitor, analyze or plan.
    config, versions
        What Knowledge compares with its own.
    layout
        Execute's word on what the rows of the run hold; None from the other roles, which wait for it.
    patience
        Seconds that Knowledge may be away before a BusError; None waits for ever.
    waiting
        Told, as a sentence, for whom this role waits.
    """

    def __init__(
        self,
        wire: Wire,
        role: str,
        *,
        config: Mapping[str, Any] | None = None,
        versions: Mapping[str, str] | None = None,
        layout: Layout | None = None,
        patience: float | None = None,
        waiting: Callable[[str], object] = lambda sentence: None,
    ) -> None:
        super().__init__(wire, role, patience, waiting)
        self.joined = Joined(epoch=0, seal="", units=0, layout=None, last=(), swaps=())
        self.refused = 0
        self.passes = 0  # for the heartbeat: what all loops together have done
        self.vouched: Callable[[], bool] = lambda: True  # whether who does the work is alive, if on another thread
        self._woken = self._missing = False
        self._config, self._versions, self._layout = dict(config or {}), dict(versions or {}), layout
        self._arrived: SimpleQueue[Any] = SimpleQueue()  # filled by Zenoh's threads, and by nobody else
        self._waiting: deque[Record | Asked] = deque()
        # Neither knows this Member: who lets go of it has it freed, and closed, at once.
        self._inbox = Inbox(wire, role, hand_over(self._arrived, "since"), self._waiting.append, self._round_trip)
        self._outbox = Outbox(wire, role, hand_over(self._arrived, "ack"), self._round_trip)
        self._keeping = Keeping(wire, role, self._arrived, self._round_trip)
        self._kept_up_at = self._beat_at = self._keys_looked_at = 0.0
        self._keys: OwnKeys | None = None
        self._renewed = False
        self._leave: Callable[..., object] | None = None

    # Coming and going.

    def connect(self) -> None:
        """Join the run; waits for Knowledge, and for an Execute that tells the layout.

        Raises
        ------
        BusError
            Nobody was there within the patience; or Knowledge refuses this role, and says why.
        """
        deadline = None if self.patience is None else time.monotonic() + self.patience
        session = self._open(deadline)
        if self.wire.tls is not None:
            self._keys = OwnKeys(self.wire.tls, self.role)
        self._attach(session, lambda: self._join(deadline))

    def _attach(self, session: zenoh.Session, join: Callable[[], object]) -> None:
        with ExitStack() as opened:
            self._session = session
            opened.callback(session.close)
            streams = self.wire.stream(role_of(INPUT[self.role]))
            opened.callback(session.declare_subscriber(streams, hand_over(self._arrived, "record")).undeclare)
            opened.callback(
                session.declare_queryable(self.wire.control(self.role), hand_over(self._arrived, "control")).undeclare
            )
            self._inbox.get = self._outbox.get = self._keeping.get = session.get
            self._beats = session.declare_publisher(self.wire.beat(self.role), **ORDERED)
            # Knowledge's token comes again with each new link to it: what was on its way over the last one is lost.
            knowledge = self.wire.alive(KNOWLEDGE)
            tokens = session.liveliness().declare_subscriber(knowledge, hand_over(self._arrived, "knowledge"))
            opened.callback(tokens.undeclare)
            join()
            # Last: who sees the token knows that all else stands.
            token = session.liveliness().declare_token(self.wire.alive(self.role, self.joined.epoch))
            opened.callback(token.undeclare)
            # At the latest at the interpreter's exit: a Zenoh thread that then still calls Python aborts the process.
            self._leave = weakref.finalize(self, opened.pop_all().close)
        self.beat()

    def close(self) -> None:
        """Leave; what was not acknowledged may be lost, unless `settle` was called."""
        if self._leave is not None:
            self._leave()
        self._session = self._inbox.get = self._outbox.get = self._keeping.get = None

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _open(self, deadline: float | None) -> zenoh.Session:
        patience = RoundTrip(self.wire.patience)
        while True:
            try:
                return self.wire.join(self.role, patience.within(FIRST_TRY))
            except Unanswered as error:
                if deadline is not None and time.monotonic() > deadline:
                    raise
                if error.slow:
                    patience.in_vain()
                why = f" ({error})" if error.found else ""
                self._say(f"waiting for Knowledge on {self.wire.endpoint}{why}")
                threading.Event().wait(TRY_EVERY)

    def _join(self, deadline: float | None) -> None:
        challenge = secrets.token_hex(16)
        join = Join(
            role=self.role, config=self._config, versions=self._versions, pid=os.getpid(), host=host(),
            layout=self._layout, challenge=challenge,
        ).pack()  # fmt: skip
        pause = threading.Event()
        while True:
            # One of another system is asked too: it refuses this role, and says what differs.
            joined, _ = Joined.unpack(self.ask(f"join/{self.role}", join, deadline=deadline, any_system=True))
            if not hmac.compare_digest(joined.proof, self.wire.proof(self.role, challenge)):
                raise Refused(
                    f"who answers {self.role} on {self.wire.endpoint} has not the run's token, and is no Knowledge of "
                    "yours. Look who listens there, and give the run another endpoint"
                )
            self.joined = joined
            if self.joined.layout is not None:
                break
            if deadline is not None and time.monotonic() > deadline:
                raise BusError(f"{self.role} waited in vain for an Execute to tell what its system's signals are")
            self._say("waiting for Execute, which has the managed system")
            pause.wait(0.05)
        self._inbox.seal = self.joined.seal.encode()
        for loop, last in enumerate(self.joined.last):
            self._outbox.begin(loop, last[STAGE_OF[self.role]])
        self._epoch = self._keeping.epoch = str(self.joined.epoch).encode()

    def _lost(self) -> None:
        """Take note that a question was lost; where all are, and yet the link stands, open another session.

        A process that was frozen while much was sent to it may come back before the router has taken its old link down;
        through the new one nothing then passes, for ever (https://github.com/eclipse-zenoh/zenoh/issues/1886).
        """
        now = time.monotonic()
        self._deaf_since = now if self._deaf_since is None else self._deaf_since
        session, leave = self._session, self._leave
        if now - self._deaf_since < max(DEAF_AFTER, 2 * self._round_trip.expected) or session is None or leave is None:
            return
        self._deaf_since = None
        if not session.info.routers_zid():
            return  # Zenoh itself connects again
        logger.warning("%s hears nothing from Knowledge, and opens another session", self.role)
        self._open_another()

    def _look_at_keys(self, now: float) -> None:
        """Warn of a certificate near its end; with one that was renewed, open another session."""
        if self._keys is None or now < self._keys_looked_at + LOOK_AT_KEYS_EVERY:
            return
        self._keys_looked_at = now
        if self._keys.renewed() or self._renewed:
            self._renewed = not self._open_another()

    def _open_another(self) -> bool:
        """Open another session in place of the one that is there; return whether that was possible."""
        leave = self._leave
        try:
            another = self.wire.join(self.role, self._round_trip.within(FIRST_TRY))
        except (BusError, ConfigError):
            return False
        assert leave is not None
        leave()
        self._attach(another, lambda: None)
        self._link_again()
        return True

    def _link_again(self) -> None:
        """Send and ask again what was under way over a link that is gone."""
        self._outbox.send_all_again()
        self._inbox.ask_again()
        self._keeping.ask_again()

    # Sending.

    def send(self, record: Record, state: State | None = None, table: QTable | None = None) -> None:
        """Have `record` appended; it is sent again until Knowledge has acknowledged it.

        Parameters
        ----------
        record
            The next one of its loop.
        state, table
            Written together with the record, or neither is.

        Raises
        ------
        BusError
            It cannot be written as JSON. A refusal by Knowledge comes out of a later `receive` or `settle`.
        """
        try:
            payload = to_json(record)
        except MalformedRecord as error:
            raise BusError(
                f"{type(record).__name__} {record.pass_no} cannot be written for the wire: {error}"
            ) from error
        behind = b"" if state is None else state.pack(table)
        if len(behind) > pieces.PIECE:
            whole = self._hand_over(behind).encode()
            attachment = self._epoch + b"\nwhole=" + whole
        else:
            attachment, behind = self._epoch + (b"\n" + behind if behind else b""), b""
        self._outbox.put(record.loop, record.pass_no, payload, attachment, behind)

    def drop(self, loop: int, first: int, last: int) -> None:
        """Say that episodes of a free-running loop will not be logged."""
        self._outbox.put(loop, last, Dropped(loop=loop, first=first, last=last).pack(), self._epoch)

    def unacknowledged(self, loop: int) -> int:
        """Return how many records of a loop were sent and not acknowledged yet."""
        return self._outbox.unacknowledged(loop)

    def settle(self, timeout: float | None = None) -> None:
        """Wait until all that was sent is acknowledged; what comes meanwhile is kept for `receive`.

        Raises
        ------
        BusError
            It was refused, or Knowledge does not answer within `timeout` seconds, or within the patience.
        """
        timeout = self.patience if timeout is None else timeout
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self._outbox.empty:
            left = KEEP_UP_EVERY if deadline is None else min(KEEP_UP_EVERY, deadline - time.monotonic())
            if left <= 0:
                raise BusError(f"Knowledge on {self.wire.endpoint} did not acknowledge what {self.role} sent in time")
            self._take_in(left)
            self._keep_up(time.monotonic())
            if self._missing:
                self._hand_over_again()

    def keep(self, state: State, table: QTable | None = None) -> None:
        """Have a state kept; that it got lost does no harm, as another one will follow."""
        self._keeping.put(state, table)

    def _between(self) -> None:
        now = time.monotonic()
        self._take_in(0.0)
        if now >= self._kept_up_at:
            self._keep_up(now)
        if now >= self._beat_at and self.vouched():
            self.beat()

    def _hand_over_again(self) -> None:
        """Hand over what belongs to records and is not at Knowledge any more, and send these again."""
        self._missing = False
        for loop, data in self._outbox.behind.items():
            self._hand_over(data)
            self._outbox.send_again(loop)

    def _acknowledged(self, reply: zenoh.Reply) -> None:
        ok = reply.ok
        if ok is None:
            self._unanswered(reply)
            return
        self._deaf_since = None
        answer = json.loads(ok.payload.to_bytes())
        self._outbox.acknowledged(int(str(ok.key_expr).split("/")[2]), answer["ack"], answer["last"])

    def _unanswered(self, reply: zenoh.Reply) -> None:
        said = reply.err.payload.to_string() if reply.err is not None else "Timeout"
        if said.startswith(MISSING):
            self._missing = True
            return
        if said != "Timeout":  # Zenoh's own word; everything else was said by Knowledge
            raise Refused(f"{self.role} is refused by Knowledge: {said}")
        self._lost()

    # Receiving.

    def watch(self, loop: int, number: int) -> None:
        """Receive the records of `loop` from pass `number` on, those that are in the log already first."""
        self._inbox.watch(loop, number)

    def unwatch(self, loop: int) -> None:
        """Receive no more of `loop`."""
        self._inbox.unwatch(loop)

    def receive(self, timeout: float) -> Record | Asked | None:
        """Return the next record, or question to this role; None where neither came within `timeout` seconds.

        Raises
        ------
        BusError
            Knowledge refused what was sent, does not answer, or has another log than before.
        """
        deadline = time.monotonic() + timeout
        looked = False
        while True:
            now = time.monotonic()
            if now >= self._beat_at and self.vouched():
                self.beat(waiting=not self._waiting)
            if now >= self._kept_up_at:
                self._keep_up(now)
            if self._missing:
                self._hand_over_again()
            if self._waiting:
                if not self._arrived.empty():
                    self._take_in(0.0)  # acknowledgements do not wait until there is nothing else to do
                return self._waiting.popleft()
            left = deadline - now
            if looked and left < 0:
                return None
            self._take_in(min(left, KEEP_UP_EVERY))
            looked = True
            if self._woken:
                self._woken, deadline = False, now

    def wake(self) -> None:
        """Have `receive`, in which another thread waits, return."""
        if not self._woken:
            self._woken = True
            self._arrived.put(("woken", None))

    def _take_in(self, timeout: float) -> None:
        """Take what Zenoh's threads have put down, waiting for the first of it."""
        try:
            kind, what = self._arrived.get(timeout=max(0.0, timeout))
            while True:
                if kind == "record":
                    self._hear(what)
                elif kind == "ack":
                    self._acknowledged(what)
                elif kind == "since":
                    self._caught_up(what)
                elif kind == "kept":
                    self._keeping.answered(*what)
                elif kind == "woken":
                    pass
                elif kind == "knowledge":
                    if what.kind == zenoh.SampleKind.PUT:
                        self._link_again()
                else:
                    self._questioned(what)
                kind, what = self._arrived.get_nowait()
        except Empty:
            return

    def _hear(self, sample: zenoh.Sample) -> None:
        try:
            self._inbox.hear(sample)
        except MalformedRecord as error:
            self._ignore(f"{sample.key_expr}: {error}")

    def _ignore(self, why: str) -> None:
        self.refused += 1
        logger.warning("%s ignores %s", self.role, why[:300])

    def _questioned(self, query: zenoh.Query) -> None:
        try:
            seal = query.attachment
            if seal is None or seal.to_bytes() != self._inbox.seal:
                raise MalformedRecord(f"{self.role} is asked by Knowledge alone; ask that")
            payload = query.payload
            if payload is None or len(payload) > LARGEST_MESSAGE:
                raise MalformedRecord(f"a question to {self.role} carries a Control message")
            control, _ = Control.unpack(payload.to_bytes())
        except MalformedRecord as error:
            self._ignore(f"a question: {error}")
            self.refuse(query, str(error))
            return
        self._waiting.append(Asked(query, control))

    def _keep_up(self, now: float) -> None:
        """Send again what was not acknowledged, and ask for what may have been missed."""
        self._kept_up_at = now + KEEP_UP_EVERY
        self._look_at_keys(now)
        if self._outbox.keep_up(now):
            self._lost()
        self._inbox.keep_up(now)
        self._keeping.keep_up(now)

    def _caught_up(self, reply: zenoh.Reply) -> None:
        if reply.ok is None:
            self._unanswered(reply)
            return  # it is asked again after a while
        self._deaf_since = None
        head, *lines = reply.ok.payload.to_bytes().splitlines()
        loop, more = head.split()
        self._inbox.caught_up(int(loop), lines, more != b"0")

    # Answering, and being alive.

    def answer(self, asked: Asked, payload: bytes) -> None:
        """Answer a question to this role."""
        with suppress(zenoh.ZError), asked.query as query:  # who asked may have gone
            query.reply(self.wire.control(self.role), payload)

    def refuse(self, query: zenoh.Query, why: str) -> None:
        """Say no to a question to this role, and why."""
        with suppress(zenoh.ZError), query:
            query.reply_err(why)

    def beat(self, *, waiting: bool = False) -> None:
        """Say that the thread that does the work is alive; from within `receive` it is said by itself."""
        if self._session is None:
            return
        self._beat_at = time.monotonic() + BEAT_EVERY
        epoch = self.joined.epoch
        self._beats.put(
            Beat(epoch=epoch, pid=os.getpid(), passes=self.passes, refused=self.refused, waiting=waiting).pack()
        )
