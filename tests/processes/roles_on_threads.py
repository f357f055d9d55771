"""The four roles and Knowledge on threads of this process: each can be ended in the middle, and started anew."""

import json
import threading
import uuid
from contextlib import ExitStack

from bus_small_loop import Distributed, small_config
from real_processes import last, passes, until

from adapters.buses import Wire
from adapters.buses.messages import Control, Replaced
from adapters.roles import ROLES
from mape.analyze.changes import Changes
from mape.config import from_table, merge

NO_STATES = 10**9
"""For `snapshot_every`: who is started anew does all again from the first pass."""


class Paced(Changes):
    """Changes, at a walk until `free` is set: a run that is not over before what is to meet it."""

    free = threading.Event()

    def analyze(self, symptom):
        self.free.wait(0.01)
        return super().analyze(symptom)


def paced(episodes, table=None):
    """Return a config of the small run, paced, with a table laid over it."""
    whole = merge(json.loads(small_config(episodes).to_json()), {"analyze": "roles_on_threads:Paced", **(table or {})})
    return from_table(whole, "the small run")


class Roles(Distributed):
    """A run whose parts live in this process, so that a test can hold them where it wants.

    Parameters
    ----------
    config, folder
        What runs, and where its log and its socket are.
    snapshot_every
        Passes from one state that is kept to the next.
    """

    def __init__(self, config, folder, snapshot_every=NO_STATES):
        super().__init__(config, Wire(f"unixsock-stream/{folder}/t.sock", "example"), folder / "log.sqlite")
        self.snapshot_every = snapshot_every
        self._stack = ExitStack()

    def open(self):
        super().open()
        self.hub.answers.snapshot_every = self.snapshot_every

    def __enter__(self):
        Paced.free.clear()
        self.open()
        self.operator = self._stack.enter_context(self.wire.join("operator", 10))
        return self

    def __exit__(self, *_):
        Paced.free.set()
        for role in self.roles.values():
            role.stopping.set()
        for thread in self.threads:
            thread.join(60)
        self._stack.close()
        self.close()

    def start_all(self):
        for role in ROLES:
            self.start(role)

    def end(self, name):
        """End a role where it is, as a restart of its process does."""
        self.roles[name].stopping.set()
        for thread in self.threads:
            if thread.name == name:
                thread.join(60)

    def again(self, name):
        self.end(name)
        self.start(name)

    @property
    def last(self):
        return last(self.path)

    def wait_for_pass(self, number):
        self.until(lambda: passes(self.path) >= number, f"pass {number}")

    def until(self, condition, what):
        """Wait for a condition; that a role fails meanwhile ends the wait."""

        def come_true_or_failed():
            assert self.failed == []
            return condition()

        return until(come_true_or_failed, what, within=60.0)

    def wanted(self, name):
        """Whether a part has been let in that has not served yet."""
        units = self.roles[name].units
        return bool(units) and units[0].wanted is not None

    def ask_for(self, part, to, role):
        """Ask a role for another part; return what gives the answer once it is there."""
        payload = Control(what="swap", part=part, to=to, question=uuid.uuid4().hex).pack()
        answers = self.operator.get(self.wire.ask("swap"), payload=payload, timeout=60)

        def answer():
            (reply,) = answers
            return Replaced.unpack(reply.ok.payload.to_bytes())[0] if reply.ok else reply.err.payload.to_string()

        return answer

    def hash(self):
        """Return the hash of the log of a run that is over, of which every role must have made its part."""
        Paced.free.set()
        self.join()
        assert self.ledger.complete
        return self.ledger.sha256(0)
