"""Looking at a plant does not touch it: its diary over every command holds one reset for each logged episode."""

import json
import subprocess
import sys

import pytest
from diaries import EPISODES, LONG, diary, lives, one_by_one, plant, resets
from real_processes import end_all, endpoint, five, up, write_config
from real_runs import MAPEK, run

pytestmark = pytest.mark.timeout(120)

SHORT = ("--no-figures", "-q")
FREE = {"execute": {"mode": "free", "rate": 200.0}}


def test_run_makes_a_plant_once_and_resets_it_once_for_each_episode(here):
    config = write_config(here, plant())
    run("run", str(config), "--out", "out", "-q", cwd=here)  # with figures
    assert diary(here) == one_by_one(1, EPISODES)


@pytest.mark.parametrize("options", [("--trials", "3"), ("--set", "loops=3"), ("--trace", "2:4"), ("--show", "2:3")])
def test_run_makes_each_unit_a_plant_when_the_one_before_is_closed(here, options):
    config = write_config(here, plant())
    run("run", str(config), "--out", "out", *SHORT, *options, cwd=here)
    units = 3 if "3" in options or "loops=3" in options else 1
    assert diary(here) == one_by_one(1, EPISODES) * units


@pytest.mark.long
def test_compare_drives_one_agent_after_the_other(here):
    agents = {"agents": {"one": {}, "other": {"plan": {"name": "q_learning"}}}}
    config = write_config(here, {**plant(), **agents})
    run("compare", str(config), "--out", "out", "--trials", "2", "-q", cwd=here)
    assert diary(here) == one_by_one(1, EPISODES) * 4


@pytest.mark.parametrize("over", [LONG({}), FREE, LONG({"loops": 2})], ids=["lockstep", "free", "loops"])
def test_up_makes_a_plant_in_execute_alone(here, over):
    config = write_config(here, {**plant(), **over})
    with up(config, short=("-q",)) as running:
        running.result()
    (life,) = lives(here)
    loops = over.get("loops", 1)
    assert life.count("made") == life.count("connect") == life.count("closed") == loops
    assert sorted(resets(here)) == sorted([*range(1, EPISODES + 1)] * loops)
    assert life[:loops] == ["made"] * loops
    assert life.index("connect") == loops


def test_serve_makes_a_plant_in_execute_alone(here):
    config = write_config(here, plant())
    with five(config, endpoint(here)) as served:
        end_all(served)
    assert lives(here) == [one_by_one(1, EPISODES)]


def test_check_leaves_a_plant_alone_unless_it_is_asked_and_then_has_one_of_it(here):
    config = write_config(here, plant())
    for name in (str(config), "pump:PlantPump-v0"):
        (here / "diary").unlink(missing_ok=True)
        said = run("check", name, cwd=here).stdout
        assert diary(here) == ["made", "closed"]
        assert "--drive N" in said
        (here / "diary").unlink()
        run("check", name, "--drive", "4", cwd=here)
        assert diary(here) == one_by_one(1, 4)


def test_check_of_a_system_that_can_be_driven_again_drives_as_many_episodes_as_it_is_asked_to(here):
    config = write_config(here, plant(name="Tank"))
    run("check", str(config), "--drive", "0", cwd=here)
    assert resets(here) == []
    run("check", str(config), "--drive", "2", cwd=here)
    assert max(resets(here)) <= 2


def test_step_resets_a_plant_for_no_episode_that_is_not_stepped_to(here):
    config = write_config(here, plant())
    done = subprocess.run(
        [*MAPEK, "step", str(config), "--from", "3"], input="\n\n\n\nq\n", cwd=here, text=True, timeout=90, check=True,
        capture_output=True,
    )  # fmt: skip
    assert diary(here) == one_by_one(1, 3), done.stdout


@pytest.mark.parametrize("command", ["run", "up"])
def test_what_is_wrong_with_a_config_is_said_before_a_plant_is_touched(here, command):
    config = write_config(here, plant(monitor={"detectors": [{"name": "page_hinkley", "signal": "noise"}]}))
    run(command, str(config), "--out", "out", *SHORT, cwd=here, code=2)
    assert set(diary(here)) <= {"made", "closed"}


@pytest.mark.parametrize("looks", [("list",), ("schema",), ("--version",)])
def test_other_commands_make_no_plant(here, looks):
    run(*looks, cwd=here)
    assert diary(here) == []


@pytest.mark.parametrize("command", ["run", "up"])
def test_replay_and_log_do_not_touch_a_plant(here, command):
    config = write_config(here, plant())
    run(command, str(config), "--out", "out", *SHORT, cwd=here)
    (here / "diary").unlink()
    said = run("replay", "out", "-q", cwd=here).stdout
    assert "cannot be driven again" in said
    assert "no difference" in said
    run("log", "out", "--events", cwd=here)
    run("replay", "out", "-q", "--to", "5", cwd=here)
    assert diary(here) == []


CONNECTS_WHEN_MADE = """
import gymnasium
import pump


class Line(pump.Pump):
    def __init__(self, render_mode=None):
        super().__init__()
        pump.Pump.connect(self)

    connect = None


gymnasium.register("Line-v0", Line, max_episode_steps=3)
"""


@pytest.mark.long
@pytest.mark.parametrize("command", ["run", "up"])
def test_a_plant_that_connects_when_it_is_made_is_connected_once(here, command):
    (here / "line.py").write_text(CONNECTS_WHEN_MADE)
    config = write_config(here, plant(system={"id": "line:Line-v0"}))
    run(command, str(config), "--out", "out", *SHORT, cwd=here)
    assert diary(here) == one_by_one(1, EPISODES)


ONE_PER_PROCESS = """
import gymnasium
import pump


class Simulator(pump.Tank):
    running = None

    def reset(self, *, seed=None, options=None):
        if Simulator.running not in (None, self):
            raise RuntimeError("the simulator is taken")
        Simulator.running = self
        return super().reset(seed=seed, options=options)

    def close(self):
        super().close()
        Simulator.running = None


gymnasium.register("Simulator-v0", Simulator, max_episode_steps=3)
"""


@pytest.mark.parametrize("options", [("--set", "loops=2"), LONG(("--trials", "2", "--workers", "1"))])
def test_a_simulator_that_exists_once_per_process_serves_one_loop_after_the_other(here, options):
    (here / "simulator.py").write_text(ONE_PER_PROCESS)
    config = write_config(here, plant(system={"id": "simulator:Simulator-v0"}))
    run("run", str(config), "--out", "out", "-q", *options, cwd=here)
    assert resets(here) == [*range(1, EPISODES + 1)] * 2


def test_python_makes_a_loop_without_touching_its_system(here):
    program = (
        "from adapters.systems import make_system\n"
        "from mape import load\n"
        "from mape.loop import Loop\n"
        "config = load('config.json')\n"
        "Loop(config, make_system(config.system))\n"
    )
    write_config(here, plant())
    subprocess.run([sys.executable, "-c", program], cwd=here, timeout=90, check=True)
    assert diary(here) == ["made"]


def test_reproduce_leaves_a_plant_that_takes_the_place_of_its_system_in_one_piece(here):
    """No plant has the paper's drifts; that is said, and before it is driven."""
    done = subprocess.run(
        [*MAPEK, "reproduce", "jump", "--set", 'system={id = "pump:PlantPump-v0"}', "--trials", "1",
         "--set", "episodes=12", "--no-statistics", "--no-figures", "--out", "out", "-q"],
        cwd=here, capture_output=True, text=True, timeout=90, check=False,
    )  # fmt: skip
    agents = json.loads((here / "out" / "result.json").read_bytes())["agents"] if done.returncode == 0 else {}
    assert diary(here) == one_by_one(1, EPISODES) * len(agents), done.stderr
