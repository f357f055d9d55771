"""Watch a run of `mapek up` from its folder, finished or not: python examples/watch_the_log.py DIR

Each drift is printed with the plan that answered it. Start it before the run if you like; Ctrl-C ends it.
"""

import sys
import time
from pathlib import Path

from adapters.cli.log import config_in, opened
from adapters.cli.sentences import sentence
from knowledge import from_json
from mape.errors import MapekError

REQUEST, PLAN = 2, 3  # stages of a pass; 0 is the Observation, 1 the Symptom


def watch(store):
    config = config_in(store, follow=True)
    due = dict.fromkeys(range(config["trials"] * config["loops"]), 1)  # loop -> pass of its next plan
    while min(due.values()) <= config["episodes"]:
        for loop in due:
            for number, _, plan in store.since(loop, {PLAN: due[loop]}, limit=512):
                due[loop] = number + 1
                request = from_json(store.body(loop, number, REQUEST))
                if request.drifts:
                    print(f"loop {loop}, pass {number}", sentence(request), sentence(from_json(plan)), sep="\n  ")
        time.sleep(0.1)  # another process writes the file


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    try:
        with opened(Path(sys.argv[1]), follow=True) as store:  # which waits for a log that is still to be made
            watch(store)
    except MapekError as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(130)
