"""A free-running system does not stand still for its link, whatever that has to wait for."""

import threading

import pytest
from roles_on_threads import Paced, Roles
from test_processes_free_again import dropped, free, observations

from adapters.buses.member import Member
from adapters.buses.outbox import Outbox

MORE = 150
"""Episodes that a system does not come to which waits for its link."""


@pytest.mark.parametrize(
    ("kind", "method"),
    [
        (Outbox, "_transmit"),  # what is sent waits in a queue that is full, as over a link that is cut
        pytest.param(Member, "beat", marks=pytest.mark.long),
        pytest.param(
            Member, "_keep_up", marks=pytest.mark.long
        ),  # a session that hears nothing is given up for another one, which takes its time
        pytest.param(Member, "_acknowledged", marks=pytest.mark.long),
    ],
)
def test_the_system_is_driven_on_while_its_link_stands_still(here, monkeypatch, kind, method):
    passes = threading.Event()
    passes.set()
    true_method = getattr(kind, method)

    def waits(self, *given, **options):
        if "execute" in (getattr(self, "role", ""), getattr(self, "_role", "")):
            passes.wait(100)
        return true_method(self, *given, **options)

    monkeypatch.setattr(kind, method, waits)
    with Roles(free(600), here) as run:
        Paced.free.set()
        run.start_all()
        run.wait_for_pass(40)
        component = run.roles["execute"].units[0].component
        passes.clear()
        reached = component.passes
        run.until(lambda: component.passes > reached + MORE, f"{MORE} more episodes")
        passes.set()
        run.wait_for_pass(600)
        assert [seen.pass_no for seen in observations(run.path)] == list(range(1, 601))
        assert dropped(run.path) == []
