"""A short run of the four components, as a `Loop` in this process and as roles over the wire."""

import json
import threading
from pathlib import Path

from adapters.buses import KnowledgeHub, Member
from adapters.buses.wire import versions
from adapters.processes.roles import make_role
from adapters.processes.serve import open_ledger
from adapters.systems import make_system
from mape.config import load
from mape.loop import Loop

EXAMPLE = Path(__file__).parents[2] / "examples" / "gridworld_goals.toml"


def small_config(episodes=20, **options):
    """Return the example with its goals swapped early, and a detector that alarms at once."""
    detector = '{ name = "page_hinkley", signal = "return", delta = 0.5, threshold = 30.0 }'
    return load(
        EXAMPLE,
        overrides=[
            f"episodes={episodes}",
            "execute.engine=python",
            "system.options.switch_at=[6, 11]",
            f"monitor.detectors=[{detector}]",
            *[f"{name}={value}" for name, value in options.items()],
        ],
    )


def in_process(config, loop=0):
    """Run it over a `LocalBus`; return the loop."""
    system = make_system(config.system)
    one = Loop(config, system, loop=loop)
    one.run(config.episodes)
    system.close()
    return one


class Distributed:
    """Knowledge and the four roles, each role on a thread of its own."""

    def __init__(self, config, wire, path):
        self.config, self.wire, self.path = config, wire, path
        self.failed = []
        self.threads = []
        self.roles = {}

    def open(self):
        self.ledger = open_ledger(self.config, self.path, "normal")
        self.hub = KnowledgeHub(self.ledger, self.wire, json.loads(self.config.to_json()), versions(), 5)
        self.hub.connect()

    def start(self, name):
        def member_of(layout):
            config = json.loads(self.config.to_json())
            return Member(self.wire, name, config=config, versions=versions(), layout=layout, patience=20)

        role = self.roles[name] = make_role(name, self.config, member_of)

        def run():
            try:
                role.run()
            except Exception as error:
                self.failed.append(error)

        self.threads.append(threading.Thread(target=run, name=name))
        self.threads[-1].start()

    def join(self):
        for thread in self.threads:
            thread.join(60)
        assert self.failed == []

    def close(self):
        self.hub.close()
        self.ledger.store.close()
