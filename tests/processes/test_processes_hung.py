"""Who is silent for too long is killed and started again, so often and no more; and the run then says why it ends."""

import os
import re
import signal
import sys
import threading
import time
from queue import SimpleQueue
from types import SimpleNamespace

import pytest
from bus_peers import Site, ask, join_of
from bus_records import run_of
from real_processes import EXAMPLES, events, until, up, write_config
from roles_on_threads import Roles, paced

from adapters.buses import Wire, presence, security
from adapters.buses.messages import Beat, Joined
from adapters.buses.wire import ORDERED, role_of
from adapters.processes import supervise
from adapters.processes.supervise import Failed, Supervisor, ask_status
from adapters.roles import ROLES
from knowledge import to_json
from mape.plan.morphin import Morphin

SLEEPS = [sys.executable, "-S", "-c", "import time; time.sleep(100)"]
"""A process that says nothing: what roles say, the test says in their name."""


class Enough(Exception):
    """The test has seen what it wanted."""


class Clock:
    """Time as the supervisor and Knowledge see it: nothing else moves it, however busy the machine is."""

    def __init__(self, monkeypatch):
        self.now = 1000.0
        self.missed = 0.0  # by the supervisor alone, which was stopped, as by Ctrl-Z
        self.stands = False
        self.held = False  # by the test
        monkeypatch.setattr(
            supervise, "time", SimpleNamespace(monotonic=lambda: self.now + self.missed, sleep=self.sleep)
        )
        monkeypatch.setattr(presence, "time", SimpleNamespace(monotonic=lambda: self.now))

    def sleep(self, seconds):
        time.sleep(0.002)  # for the threads of Zenoh, and for children that are to die
        self.now += 0.0 if self.stands or self.held else seconds


class Watched:
    """A supervisor of five processes that do nothing, over a Knowledge in this process."""

    def __init__(self, folder, monkeypatch, *, hang_after):
        for name, value in (("STATUS_EVERY", 0.0), ("CRASHES", 3)):
            monkeypatch.setattr(supervise, name, value)
        # One session speaks for all roles: what each may say is not looked at here.
        monkeypatch.setattr(security, "access_control", lambda *rights, **options: {"enabled": False})
        self.clock = Clock(monkeypatch)
        self.wire = Wire(f"unixsock-stream/{folder}/k.sock", "example")
        self.told = []
        self.speaking = set(ROLES)
        self.joining = set(ROLES)
        self.path = None
        self._pids, self._epochs, self._beats = {}, {}, 0
        # Knowledge is this process, and not the child in its place.
        pid = supervise.Child.pid.fget
        monkeypatch.setattr(
            supervise.Child, "pid", property(lambda child: os.getpid() if child.role == "knowledge" else pid(child))
        )
        commands = dict.fromkeys(("knowledge", *ROLES), SLEEPS)
        self.supervisor = Supervisor(self.wire, commands, folder, hang_after=hang_after, tell=self.told.append)

    def watch(self, enough=lambda watched: False):
        """Watch until it is enough, or the supervisor has given up."""
        with Site(self.wire, self.path) as self.site, self.supervisor:
            self.raw = self.site.session()

            def look(supervisor):
                for role in ROLES:
                    self._speak(role, supervisor.children[role].pid)
                if enough(self):
                    raise Enough
                # How long a link takes to come about is not what is looked at here.
                self.clock.stands = supervisor.status is None

            self.supervisor.watch(look)

    def _speak(self, role, pid):
        """Say in the name of a role that it is there, and see it heard."""
        if role in self.joining and self._pids.get(role) != pid:
            (answer,) = self.raw.get(self.wire.ask(f"join/{role}"), payload=join_of(role, pid=pid), timeout=60)
            self._epochs[role] = Joined.unpack(answer.ok.payload.to_bytes())[0].epoch
            self._pids[role] = pid
        if role in self.speaking:
            self._beats += 1
            # Its number stands in the one figure of a heartbeat that Knowledge passes on.
            beat = Beat(epoch=self._epochs[role], pid=pid, passes=0, refused=self._beats, waiting=True)
            self.raw.put(self.wire.beat(role), beat.pack(), **ORDERED)
            until(lambda: self._heard(role), "a heartbeat", every=0.001)

    def make_a_pass(self):
        for record in run_of(1):
            role = role_of(type(record))
            key = self.wire.append(role, 0)
            ask(self.raw, key, to_json(record), str(self._epochs[role]).encode())

    def _heard(self, role):
        return [status.roles[role].refused for status in ask_status(self.raw, self.wire, 20)] == [self._beats]

    @property
    def restarts(self):
        return {role: child.restarts for role, child in self.supervisor.children.items() if child.restarts}


def test_who_is_silent_again_and_again_ends_the_run_with_a_sentence_that_names_the_way_out(here, monkeypatch):
    watched = Watched(here, monkeypatch, hang_after=0.8)
    watched.speaking.remove("plan")
    with pytest.raises(Failed, match=r"plan died 3 times .*silent for 0\.8 s; .* give a longer --hang-after"):
        watched.watch()
    assert watched.restarts == {"plan": 2}
    pids = [re.fullmatch(r"plan \(process (\d+)\) was silent for \d\.\d s; it is killed and started again", sentence)[1]
            for sentence in watched.told]  # fmt: skip
    assert len({*pids}) == len(pids) == 3


def test_who_hangs_before_it_joins_is_hung_once_it_has_had_the_time_of_a_start(here, monkeypatch):
    monkeypatch.setattr(supervise, "STARTS_WITHIN", 1.5)
    watched = Watched(here, monkeypatch, hang_after=0.8)
    watched.joining.remove("plan")
    watched.speaking.remove("plan")
    with pytest.raises(Enough):
        watched.watch(lambda watched: watched.restarts)
    assert watched.restarts == {"plan": 1}
    (sentence,) = watched.told
    assert re.match(r"plan \(process \d+\) was silent for (1\.[5-9]|[2-9]\.\d) s;", sentence)


def test_who_speaks_is_not_hung(here, monkeypatch):
    """However long ago it was started."""
    monkeypatch.setattr(supervise, "STARTS_WITHIN", 0.2)
    watched = Watched(here, monkeypatch, hang_after=0.8)
    looks = []
    with pytest.raises(Enough):
        watched.watch(lambda watched: looks.append(1) or len(looks) > 40)
    assert (watched.restarts, watched.told) == ({}, [])


def test_who_dies_otherwise_is_not_told_of_hanging(here, monkeypatch):
    watched = Watched(here, monkeypatch, hang_after=50.0)

    def kill(watched):
        os.kill(watched.supervisor.children["plan"].pid, signal.SIGKILL)

    with pytest.raises(Failed, match=r"plan died 3 times .*\(exit code -9\)"):
        watched.watch(kill)
    assert watched.told == []


def test_roles_that_a_knowledge_started_again_has_not_heard_yet_are_not_hung(here, monkeypatch):
    """However long ago they were started: their links come back only after it listens."""
    monkeypatch.setattr(supervise, "STARTS_WITHIN", 0.8)
    watched, looks = Watched(here, monkeypatch, hang_after=0.8), []
    watched.path = here / "log.sqlite"

    def start_knowledge_again(watched):
        children = watched.supervisor.children
        again = children["knowledge"].restarts
        if watched.speaking and not again and watched.clock.now - children["plan"].started_at > 1.0:
            watched.speaking.clear()
            os.kill(children["knowledge"].process.pid, signal.SIGKILL)
            children["knowledge"].process.wait()
            watched.site.close()
            watched.site.open()
            watched.supervisor.status = None
        # Since it answers again.
        looks.extend([1] * (not watched.speaking and watched.supervisor.status is not None))
        if len(looks) == 5:
            watched.speaking.update(ROLES)
        return again and watched.speaking

    with pytest.raises(Enough):
        watched.watch(start_knowledge_again)
    assert (watched.restarts, watched.told) == ({"knowledge": 1}, [])


class Awaited(Morphin):
    """A planner that takes so long to make that a heartbeat of its role comes before it is there."""

    heard = SimpleQueue()

    def __init__(self, *options, **named):
        super().__init__(*options, **named)
        if threading.current_thread().name == "plan":
            self.heard.get(timeout=60)


def test_a_role_that_makes_the_parts_of_many_loops_gives_signs_of_life(here, monkeypatch):
    monkeypatch.setitem(sys.modules, "awaited", sys.modules[__name__])
    hear = presence.Presence.beats

    def heard(knowledge, sample):
        hear(knowledge, sample)
        if str(sample.key_expr).endswith("/plan"):
            Awaited.heard.put(sample)

    monkeypatch.setattr(presence.Presence, "beats", heard)
    with Roles(paced(3, {"loops": 6, "plan": "awaited:Awaited"}), here) as run:
        run.start_all()
        run.until(lambda: run.ledger.complete, "the end")
        run.hash()


def test_a_supervisor_that_was_stopped_takes_nobody_for_hung(here, monkeypatch):
    """What was said while it did not listen, it has not heard; that is nobody's silence."""
    watched = Watched(here, monkeypatch, hang_after=5.0)
    clock = watched.clock
    passed = []

    def stop_and_go_on(watched):
        if watched.supervisor.status is not None and not clock.missed:
            clock.missed = 100.0
        passed.extend([1] * bool(clock.missed))
        return len(passed) > 50

    with pytest.raises(Enough):
        watched.watch(stop_and_go_on)
    assert (watched.restarts, watched.told) == ({}, [])


def test_who_does_not_answer_a_supervisor_right_after_its_stop_has_its_time_all_the_same(here, monkeypatch):
    """The link that it had is gone, and the next one takes a moment."""
    watched = Watched(here, monkeypatch, hang_after=5.0)
    clock = watched.clock
    ask, unanswered = supervise.ask_status, []

    def ask_status(*asked):
        if clock.missed and len(unanswered) < 20:
            unanswered.append(asked)
            return []
        return ask(*asked)

    def stop_and_go_on(watched):
        if watched.supervisor.status is not None and not clock.missed:
            watched.supervisor.status, clock.missed = None, 100.0
        return clock.missed and watched.supervisor.status is not None

    monkeypatch.setattr(supervise, "ask_status", ask_status)
    with pytest.raises(Enough):
        watched.watch(stop_and_go_on)
    assert len(unanswered) == 20
    assert (watched.restarts, watched.told) == ({}, [])


def test_who_joins_while_the_supervisor_is_stopped_is_not_taken_for_one_that_never_joined(here, monkeypatch):
    watched = Watched(here, monkeypatch, hang_after=5.0)
    clock = watched.clock
    watched.joining.remove("plan")
    watched.speaking.remove("plan")
    passed = []

    def stop_and_go_on(watched):
        if watched.supervisor.status is not None and not clock.missed:
            clock.missed = 100.0
            watched.joining.add("plan")
            watched.speaking.add("plan")
        passed.extend([1] * bool(clock.missed))
        return len(passed) > 50

    with pytest.raises(Enough):
        watched.watch(stop_and_go_on)
    assert (watched.restarts, watched.told) == ({}, [])


FAILS = [sys.executable, "-S", "-c", "raise SystemExit('mapek: the valve is stuck')"]


@pytest.mark.parametrize(("role", "retries", "times"), [("execute", 0, 2), ("execute", 2, 4), ("plan", 2, 2)])
def test_who_fails_again_at_the_same_place_ends_the_run_and_execute_where_no_retry_is_left(
    here, monkeypatch, role, retries, times
):
    watched = Watched(here, monkeypatch, hang_after=1000.0)
    watched.supervisor.retries = retries
    watched.supervisor.children[role].command[:] = FAILS
    said = f"{role} failed {'twice' if times == 2 else f'{times} times'} at the same place: the valve is stuck"
    with pytest.raises(Failed, match=said):
        watched.watch()
    assert watched.restarts == {role: times - 1}


DIES = """
import pathlib, time
while not pathlib.Path("die").exists():
    time.sleep(0.001)
pathlib.Path("die").unlink()
raise SystemExit("mapek: log.sqlite cannot be written")
"""


def test_who_fails_again_a_pass_later_has_not_failed_at_the_same_place_however_long_ago_knowledge_was_asked(
    here, monkeypatch
):
    monkeypatch.chdir(here)
    watched = Watched(here, monkeypatch, hang_after=1000.0)
    watched.supervisor.children["execute"].command[:] = [sys.executable, "-S", "-c", DIES]
    died = []

    def fail_twice(watched):
        restarts = watched.restarts.get("execute", 0)
        if watched.supervisor.status is not None and restarts == len(died) < 2:
            monkeypatch.setattr(supervise, "STATUS_EVERY", 10**9)
            if died:
                watched.make_a_pass()
            died.append(restarts)
            (here / "die").touch()
        return restarts == 2

    with pytest.raises(Enough):
        watched.watch(fail_twice)


SOON = (supervise.KEEPS_FAILING / 2, Failed, "knowledge failed twice within 30 s: log.sqlite cannot be written")
LATE = (supervise.KEEPS_FAILING * 2, Enough, None)


@pytest.mark.parametrize(("apart", "ends", "says"), [SOON, LATE], ids=["soon", "late"])
def test_a_knowledge_that_fails_again_ends_the_run_if_that_is_soon_however_many_passes_lie_between(
    here, monkeypatch, apart, ends, says
):
    monkeypatch.chdir(here)
    watched = Watched(here, monkeypatch, hang_after=1000.0)
    watched.supervisor.children["knowledge"].command[:] = [sys.executable, "-S", "-c", DIES]
    asked_to_die = []

    def die():
        asked_to_die.append(watched.clock.now)
        watched.clock.held = True  # how often the supervisor looks until a process is gone is the machine's affair
        (here / "die").touch()

    def failed_twice(watched):
        status, restarts = watched.supervisor.status, watched.restarts.get("knowledge", 0)
        if status is None:
            return False
        if not asked_to_die:
            die()
        elif restarts == 1 and not status.passes:
            watched.make_a_pass()
        elif restarts == 1 and len(asked_to_die) == 1:
            watched.clock.now += apart
            die()
        return restarts == 2

    with pytest.raises(ends, match=says):
        watched.watch(failed_twice)


OWN = """
import time
from mape.plan.morphin import Morphin


class Sleeps(Morphin):
    def plan(self, request, knowledge):
        if request.pass_no == 5:
            time.sleep(100)
        return super().plan(request, knowledge)
"""


@pytest.mark.long
def test_a_pass_that_is_longer_than_may_be_ends_a_real_run_with_that_sentence(here):
    (here / "own_parts.py").write_text(OWN)
    table = {"name": "grid", "episodes": 20, "extends": str(EXAMPLES / "gridworld_goals.toml")}
    config = write_config(here, table | {"system": {"options": {"switch_at": [11]}}})
    options = ("--hang-after", "1", "--set", "plan.name=own_parts:Sleeps")
    with up(config, *options, short=("--no-figures",)) as running:
        said = running.process.end(1, 60.0)
    assert "give a longer --hang-after" in said
    assert said.count("it is killed and started again") == supervise.CRASHES, said
    joins = [event for event in events(running.log, "joined") if event.role == "plan"]
    assert len(joins) == supervise.CRASHES
