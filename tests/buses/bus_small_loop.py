"""A short run of the four components, each on a bus of its own or all on one; also a program, for two processes.

    python bus_small_loop.py managing ENDPOINT    Knowledge, Monitor and Analyze
    python bus_small_loop.py managed ENDPOINT     Plan and Execute

Each prints the hash of the log that it holds.
"""

import sys
from pathlib import Path

from adapters.buses import KnowledgeHub, Wire, ZenohBus
from adapters.systems import make_system
from knowledge import STAGES, ChangePlan, ChangeRequest, Knowledge, Log, Observation, Symptom
from mape import registry
from mape.analyze import Analyze
from mape.config import load
from mape.execute import Execute
from mape.loop import Loop, layout_of
from mape.monitor import Monitor
from mape.plan import Plan

EXAMPLE = Path(__file__).parents[2] / "examples" / "gridworld_goals.toml"
EPISODES = 20
SYSTEM = "gridworld_goals"


def small_config():
    """Return the example with its goals swapped early, and a detector that alarms at once."""
    detector = '{ name = "page_hinkley", signal = "return", delta = 0.5, threshold = 30.0 }'
    return load(
        EXAMPLE,
        overrides=[
            f"episodes={EPISODES}",
            "execute.engine=python",
            "system.options.switch_at=[6, 11]",
            f"monitor.detectors=[{detector}]",
        ],
    )


def new_log(config):
    system = make_system(config.system)
    try:
        return Log(layout_of(config, system))
    finally:
        system.close()


def in_process():
    """Run it as a `Loop`; return its log."""
    config = small_config()
    system = make_system(config.system)
    loop = Loop(config, system)
    loop.run(config.episodes)
    system.close()
    return loop.log


def add_monitor(bus, config):
    detectors = [(spec.signal, registry.build("detector", spec)) for spec in config.monitor.detectors]
    bus.subscribe(Observation, Monitor(detectors, bus.send).on_observation)


def add_analyze(bus, config):
    bus.subscribe(Symptom, Analyze(registry.build("analyzer", config.analyze), bus.send).on_symptom)


def add_plan(bus, config, knowledge):
    schedule = registry.build("schedule", config.plan.schedule)
    plan = Plan(registry.build("planner", config.plan, schedule=schedule), knowledge, bus.send)
    bus.subscribe(ChangeRequest, plan.on_request)
    return plan


def add_execute(bus, config, knowledge, system):
    learner = registry.build("learner", config.learner)
    execute = Execute(system, learner, knowledge, bus.send, seed=config.seed, engine=config.execute.engine)
    bus.subscribe(ChangePlan, execute.adopt)
    return execute


def managing(wire):
    config = small_config()
    plans = []
    with KnowledgeHub(new_log(config), wire) as hub, ZenohBus(wire, "managing") as bus:
        add_monitor(bus, config)
        add_analyze(bus, config)
        bus.subscribe(ChangePlan, plans.append)
        bus.run_until(lambda: bool(plans) and plans[-1].pass_no == EPISODES, timeout=30)
    return hub.log


def managed(wire):
    config = small_config()
    mirror = new_log(config)
    system = make_system(config.system)
    bus = ZenohBus(wire, "managed", patience=20)
    for kind in STAGES:
        bus.subscribe(kind, mirror.append)
    knowledge = Knowledge(mirror)
    plan = add_plan(bus, config, knowledge)
    execute = add_execute(bus, config, knowledge, system)
    with bus:
        plan.start(0)
        for number in range(EPISODES + 1):
            bus.run_until(lambda number=number: execute.plan is not None and execute.plan.pass_no == number, timeout=30)
            if number < EPISODES:
                execute.drive()
    system.close()
    return mirror


if __name__ == "__main__":
    role = {"managing": managing, "managed": managed}[sys.argv[1]]
    print(role(Wire(sys.argv[2], SYSTEM)).sha256())
