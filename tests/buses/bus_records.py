"""Records of a run with one signal and no detector, and the logs that take them."""

from adapters.buses.messages import Layout
from adapters.stores import Store
from adapters.stores.ledger import Ledger
from knowledge import ChangePlan, ChangeRequest, Log, Observation, RowLayout, Symptom

TOLD = Layout(signals=("return",), detectors=0, rates=1, max_actions=64)
"""What the Execute of such a run tells Knowledge."""


def new_log(**options):
    return Log(RowLayout(TOLD.signals, TOLD.detectors, TOLD.rates), **options)


def new_ledger(path=None, units=1, episodes=1000, *, free=False, begun=True):
    """Open a ledger on a file, or in memory, that holds what is in it and takes records."""
    ledger = Ledger(Store(path), units, episodes, free=free)
    if begun:
        ledger.begin(TOLD.model_dump(mode="json"))
        ledger.commit()
    return ledger


def plan(number, epsilon=0.5, loop=0):
    return ChangePlan(loop, number, epsilon, (0.1,), (), (), (), False, None)


def observation(number, value=None, loop=0):
    signals = {"return": number / 3 if value is None else value}
    return Observation(loop, number, max(0, number - 1), 0.5, False, 3, (0, 1), (0, 1), signals)


def symptom(number, loop=0):
    seen = observation(number, loop=loop)
    return Symptom(loop, number, seen.signals, seen.available, seen.known, ())


def request(number, loop=0):
    return ChangeRequest(loop, number, (), (), (), observation(number).signals)


MAKERS = (observation, symptom, request, plan)
"""What makes the record of a pass, in the order of the stages."""


def run_of(passes, loop=0):
    """List what a log of that many passes holds, in order."""
    records = [plan(0, loop=loop)]
    for number in range(1, passes + 1):
        records += [make(number, loop=loop) for make in MAKERS]
    return records
