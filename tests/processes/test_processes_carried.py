"""What a system carries from one reset to the next outlives a restart, or is found, and all is driven again."""

import json
import signal
from pathlib import Path

import pytest
import worn_worlds
from bus_small_loop import in_process
from real_processes import events, hashes, run, run_here, up, write_config
from roles_on_threads import Paced, Roles, paced
from worn_worlds import CARRIES, WEARS_AT, Fresh

from adapters.systems import make_system
from mape.config import from_table
from mape.errors import ManagedSystemError
from mape.loop import Loop


def config_of(name, episodes=45):
    return paced(episodes, {"system": {"id": f"{name}-v0"}, "plan": {"schedule": {"decay": 0.1}}})


def restarted(config, folder):
    """Run, with a restart of Execute on the way from a state that is kept; return the hash of the log."""
    with Roles(config, folder, snapshot_every=5) as run:
        run.start_all()
        run.wait_for_pass(22)
        run.again("execute")
        return run.hash()


def undisturbed(config):
    Paced.free.set()
    return in_process(config).log.sha256()


@pytest.mark.parametrize("name", CARRIES)
def test_what_no_state_tells_is_named_and_all_is_driven_again(name, here):
    config = config_of(name)
    assert restarted(config, here) == undisturbed(config)
    (told,) = events(here / "log.sqlite", "carried")
    assert told.pass_no in (20, 25)
    assert CARRIES[name] in told.text
    assert "get_state()" in told.text
    assert events(here / "log.sqlite", "refused") == []


@pytest.mark.parametrize("name", ["Fresh", "Said", "Watched"])
def test_of_what_carries_nothing_or_says_it_the_state_is_enough(name, here):
    config = config_of(name)
    assert restarted(config, here) == undisturbed(config)
    assert events(here / "log.sqlite", "carried") == []


def test_an_environment_of_gymnasiums_own_is_not_driven_again(here):
    config = paced(30, {"system": {"id": "FrozenLake-v1"}, "plan": {"schedule": {"decay": 0.1}}})
    assert restarted(config, here) == undisturbed(config)
    assert events(here / "log.sqlite", "carried") == []


@pytest.fixture
def stopped(here, walk):
    """Begin a run and stop it by SIGTERM some passes after a state that is kept."""

    def begin(name):
        (here / "worn_worlds.py").write_bytes(Path(worn_worlds.__file__).read_bytes())
        table = {
            "name": "worn",
            "episodes": WEARS_AT + 20,
            "system": {"id": f"worn_worlds:{name}-v0"},
            "analyze": walk.part,
            "plan": {"schedule": {"decay": 0.1}},
        }
        config = write_config(here, table)
        with up(config, "--snapshot-every", "10") as running:
            running.wait_for_pass(25)
            assert running.process.signalled(signal.SIGTERM)[0] == 143
        walk.over()
        return config

    return begin


def test_a_resumed_run_comes_to_the_hashes_of_one_that_was_never_stopped(here, stopped):
    config = stopped("Attribute")
    run("resume", "up", cwd=here)
    assert hashes(json.loads((here / "up" / "result.json").read_bytes())) == hashes(run_here(config))
    assert "carries total" in run("log", "up", "--events", cwd=here).stdout


@pytest.mark.parametrize(
    ("name", "carried"),
    [pytest.param("Class", "Class.turns", marks=pytest.mark.long), ("Module", "worn_worlds.MODULE")],
)
def test_what_a_whole_process_shares_is_refused_by_its_name(name, carried, here, stopped):
    stopped(name)
    said = run("resume", "up", cwd=here, code=1)
    assert f"shared {carried}" in said.stdout + said.stderr
    assert "get_state() and set_state()" in said.stdout + said.stderr
    assert not (here / "up" / "result.json").exists()


def test_an_episode_that_is_begun_again_is_begun_as_it_was_or_not_at_all(monkeypatch):
    def torn(self, action):
        raise OSError("the belt tore")

    def loop(name):
        made = Loop(from_table({"episodes": 5, "system": {"id": f"{name}-v0"}}), make_system(config_of(name).system))
        made.run(2)
        made.execute.look_at(3)
        with monkeypatch.context() as patch:
            patch.setattr(Fresh, "step", torn)
            with pytest.raises(ManagedSystemError, match="the belt tore"):
                made.run(1)
        return made

    loop("Fresh").run(1)
    with pytest.raises(ManagedSystemError, match=r"begun again in episode 3, and carries total from one reset"):
        loop("Attribute").run(1)
