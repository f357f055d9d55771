"""Both ends of the wire as tests hold them, and questions to either from a session that is neither."""

import subprocess
import sys
import textwrap
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh
from bus_records import MAKERS, TOLD, new_ledger

from adapters.buses import KnowledgeHub, Member
from adapters.buses.member import Asked
from adapters.buses.messages import Control, Join, Status
from adapters.buses.wire import INPUT, ORDERED, role_of
from adapters.roles import ROLES

HERE = Path(__file__).parent


class Site:
    """A Knowledge over one file, which may be closed and opened again, and the members that joined it."""

    def __init__(self, wire, path=None, **options):
        self.wire = wire
        self.path = path
        self.options = options
        self._stack = ExitStack()
        self.hub = None
        self.open()
        self.members = {}

    def open(self, path=None):
        self.ledger = new_ledger(path or self.path, **{"begun": False, **self.options})
        self.hub = KnowledgeHub(self.ledger, self.wire)
        self.hub.connect()

    def close(self):
        self.hub.close()
        self.ledger.store.close()

    def member(self, role, **options):
        member = Member(self.wire, role, **{"layout": TOLD if role == "execute" else None, "patience": 10, **options})
        self._stack.enter_context(member)
        self.members[role] = member
        return member

    def everybody(self):
        for role in ROLES:
            self.member(role)
        return self.members

    def session(self):
        return self._stack.enter_context(self.wire.join("operator", 5))

    def send(self, *records):
        """Send each record from its role, and see it acknowledged."""
        for record in records:
            member = self.members[role_of(type(record))]
            member.send(record)
            member.settle(60)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stack.close()
        self.close()


def received(member, count, within=60.0):
    """Return the next records that come, `count` of them, and see that none comes behind."""
    got, deadline = [], time.monotonic() + within
    while len(got) < count:
        assert time.monotonic() < deadline, f"{len(got)} of {count} records came in time: {got}"
        came = member.receive(0.05)
        if came is not None:
            got.append(came)
    assert member.receive(0.0) is None
    return got


def ask(session, selector, payload=None, attachment=None):
    """Return (reply, error reply) of the one answer that comes."""
    (answer,) = session.get(selector, payload=payload, attachment=attachment, timeout=60, **ORDERED)
    return (answer.ok.payload.to_bytes(), None) if answer.ok else (None, answer.err.payload.to_string())


def want(session, wire, part, to, question):
    """Ask for a swap as an operator does, and see that Knowledge has heard it; the role's answer is not waited for."""
    control = Control(what="swap", part=part, to=to, question=question).pack()
    session.get(wire.ask("swap"), zenoh.handlers.Callback(lambda reply: None), payload=control, timeout=60, **ORDERED)
    status(session, wire)


def status(session, wire):
    reply, error = ask(session, wire.ask("status"))
    assert error is None
    return Status.unpack(reply)[0]


def join_of(role, **other):
    fields = {"config": {}, "versions": {}, "pid": 1, "host": "here", "layout": TOLD if role == "execute" else None}
    return Join(role=role, **{**fields, **other}).pack()


def eventually(condition, within=60.0):
    deadline = time.monotonic() + within
    tick = threading.Event()
    while not condition():
        assert time.monotonic() < deadline, "did not come true in time"
        tick.wait(0.01)


def serve_questions(member, answer, stop):
    """Take a member's questions until `stop` is set, answering each by `answer`."""
    while not stop.is_set():
        came = member.receive(0.02)
        if isinstance(came, Asked):
            answer(came)


def play_part(member, loop, passes, stop=lambda: False):
    """Do what a role does, without a component: answer each record of a loop by the one that comes next."""
    stage = ROLES.index(member.role)
    first = {"execute": 0, "monitor": 1, "analyze": 1, "plan": 1}[member.role]
    if member.role == "plan":
        member.send(MAKERS[3](0, loop=loop))
    member.watch(loop, first)
    got = []
    while not stop():
        came = member.receive(0.05)
        if came is None:
            continue
        got.append(came)
        number = came.pass_no + (stage == 0)
        if number <= passes:
            member.send(MAKERS[stage](number, loop=loop))
        if came.pass_no == passes:
            break
    member.settle(60)
    return got


def start(program, *arguments):
    """Run a program, given as text, in a process of its own; it finds the modules beside this one."""
    text = f"import sys\nsys.path.append({str(HERE)!r})\n{textwrap.dedent(program)}"
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-c", text, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process, within=60):
    """Return (exit code, stdout, stderr) of a process that is expected to end by itself."""
    try:
        out, err = process.communicate(timeout=within)
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = process.communicate()
        pytest.fail(f"the process did not end within {within} s; it said {out!r} and {err!r}")
    return process.returncode, out, err


def of(role, records):
    """Pick what a role takes."""
    return [record for record in records if type(record) is INPUT[role]]


def lose(monkeypatch, site, wanted):
    """Let Knowledge not hear what `wanted` names, once each."""
    lost, true_append = [], site.hub.answers.append

    def append(query):
        data = query.payload.to_bytes()
        if data not in lost and wanted(data):
            lost.append(data)
            query.drop()
            return None
        return true_append(query)

    monkeypatch.setattr(site.hub.answers, "append", append)
    return lost
