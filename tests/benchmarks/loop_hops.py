"""A pass of the loop over five processes, measured where Execute begins an episode.

python loop_hops.py ADDRESS PASSES LOOPS memory|normal|full    prints {"median_us": ..., "passes_per_s": ...}
"""

import itertools
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import hops

from adapters.buses import Member, Wire
from adapters.buses.wire import system_segment, versions
from adapters.processes.roles import make_role
from adapters.processes.serve import quick_switches
from mape.config import load

CONFIG = Path(__file__).parents[2] / "examples" / "gridworld_goals.toml"


def main():
    address, passes, loops, durability = sys.argv[1:]
    config = load(CONFIG, overrides=[f"episodes={passes}", f"loops={loops}"])
    wire = Wire(address, system_segment(config.system.id))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "config.json")
        path.write_text(config.to_json(), encoding="utf-8")
        serve = [sys.executable, "-m", "mape", "serve", str(path), "--role"]
        log = [":memory:"] if durability == "memory" else [str(Path(folder, "log.sqlite")), "--durability", durability]
        commands = [[*serve, "knowledge", "--listen", address, "--log", *log]]
        commands += [[*serve, role, "--connect", address] for role in ("monitor", "analyze", "plan")]
        others = [subprocess.Popen(command, stderr=subprocess.DEVNULL) for command in commands]
        try:
            quick_switches()
            found = drive(config, wire)
        finally:
            for other in others[::-1]:
                other.terminate()
                other.wait()
    print(json.dumps(found))


def drive(config, wire):
    table = json.loads(config.to_json())
    role = make_role(
        "execute", config, lambda layout: Member(wire, "execute", config=table, versions=versions(), layout=layout)
    )
    begun, drive_one = [], role.drive

    def drive_and_note(unit):
        begun.append(time.perf_counter())
        drive_one(unit)

    role.drive = drive_and_note
    role.run()
    return hops.figures([after - before for before, after in itertools.pairwise(begun)])


if __name__ == "__main__":
    main()
