"""A part that is asked for is vetted beside the loop: whatever its check comes to, who asked for it is answered."""

import sys
import threading
from types import SimpleNamespace

import pytest
from bus_small_loop import in_process
from real_processes import events
from roles_on_threads import Roles, paced

from adapters.processes import replacing
from mape.plan.morphin import Morphin


class Exits(Morphin):
    def plan(self, request, knowledge):
        sys.exit(5)


class Interrupts(Morphin):
    def plan(self, request, knowledge):
        raise KeyboardInterrupt


class InTheWay(Morphin):
    def __init__(self, config, schedule):
        sys.exit("I am a script")


class Sleeps(Morphin):
    """Whose check does not end before the test does."""

    over = threading.Event()

    def plan(self, request, knowledge):
        self.over.wait(50)
        return super().plan(request, knowledge)


@pytest.fixture(autouse=True)
def own(monkeypatch):
    classes = (Exits, Interrupts, InTheWay, Sleeps)
    monkeypatch.setitem(sys.modules, "own", SimpleNamespace(**{each.__name__: each for each in classes}))
    Sleeps.over.clear()
    yield
    Sleeps.over.set()


def refused(here, name):
    """Ask for a planner in the middle of a run, which goes on with the old one; return what is said."""
    config = paced(600)
    with Roles(config, here) as run:
        run.start_all()
        run.wait_for_pass(2)
        said = run.ask_for("plan", {"name": f"own:{name}"}, "plan")()
        digest = run.hash()
    assert [event.text for event in events(run.path, "swap refused")] == [said]
    assert digest == in_process(config).log.sha256()
    return said.removeprefix(f"plan stays as it is, 'own:{name}' was refused: ")


@pytest.mark.parametrize(
    ("name", "says"),
    [
        pytest.param("Exits", "SystemExit was raised: 5", marks=pytest.mark.long),
        pytest.param("Interrupts", "KeyboardInterrupt", marks=pytest.mark.long),
        ("InTheWay", "SystemExit: I am a script"),
    ],
)
def test_a_part_that_ends_its_check_is_refused_with_what_it_raised(here, name, says):
    assert says in refused(here, name)


def test_a_part_whose_check_does_not_end_is_refused_after_a_while(here, monkeypatch):
    monkeypatch.setattr(replacing, "CHECKED_WITHIN", 2.0)
    assert refused(here, "Sleeps").startswith("its check has not ended within 2 s")
