"""Records of a run with one signal and no detector."""

from knowledge import ChangePlan, ChangeRequest, Log, Observation, RowLayout, Symptom


def new_log(**options):
    return Log(RowLayout(("return",), detectors=0, rates=1), **options)


def plan(number, epsilon=0.5):
    return ChangePlan(0, number, epsilon, (0.1,), (), (), (), False, None)


def observation(number, value=None):
    return Observation(
        0, number, number - 1, 0.5, False, 3, (0, 1), (0, 1), {"return": number / 3 if value is None else value}
    )


def symptom(number):
    seen = observation(number)
    return Symptom(0, number, seen.signals, seen.available, seen.known, ())


def request(number):
    return ChangeRequest(0, number, (), (), (), observation(number).signals)


def run_of(passes):
    """List what a log of that many passes holds, in order."""
    records = [plan(0)]
    for number in range(1, passes + 1):
        records += [observation(number), symptom(number), request(number), plan(number)]
    return records
