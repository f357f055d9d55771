"""Records as Hypothesis draws them, and runs made by hand."""

from hypothesis import strategies as st

from knowledge import ChangePlan, ChangeRequest, Drift, Observation, Reading, Symptom

SIGNALS = ("return", "steps", "arrivals")

whole = st.integers(0, 2**40)
number = st.floats(allow_nan=False, allow_infinity=False)
ids = st.lists(st.integers(0, 63), unique=True, max_size=6).map(tuple)
direction = st.sampled_from(["down", "up", "unknown"])
signals = st.fixed_dictionaries(dict.fromkeys(SIGNALS, number))
sha = st.binary(min_size=32, max_size=32).map(bytes.hex)

observations = st.builds(Observation, whole, whole, whole, number, st.booleans(), whole, ids, ids, signals)
readings = st.builds(Reading, st.sampled_from(SIGNALS), number, st.none() | number, st.booleans(), direction)
symptoms = st.builds(Symptom, whole, whole, signals, ids, ids, st.lists(readings, max_size=3).map(tuple))
drifts = st.lists(st.builds(Drift, st.sampled_from(SIGNALS), direction), max_size=3, unique_by=lambda d: d.signal).map(
    tuple
)
requests = st.builds(ChangeRequest, whole, whole, drifts, ids, ids, signals)
rates = st.lists(number, max_size=4).map(tuple)
plans = st.builds(ChangePlan, whole, whole, number, rates, ids, ids, ids, st.booleans(), st.none() | sha)
records = observations | symptoms | requests | plans


def plan(number, *, epsilon=0.5, rate=(0.1, 0.9, 5.0), add=(), drop=(), enable=(), reset=False, adopt=None):
    return ChangePlan(0, number, epsilon, rate, add, drop, enable, reset, adopt)


def one_pass(number, value=None, alarm=False, known=(0, 1)):
    """The four records of a pass with one signal, one detector and three learning-rate parameters."""
    signals = {"return": float(-number if value is None else value)}
    reading = Reading("return", signals["return"], None if number % 2 else 1.5 * number, alarm, "down")
    drifts = (Drift("return", "down"),) if alarm else ()
    return (
        Observation(0, number, number - 1, 0.5, False, 3 * number, (0, 1), known, signals),
        Symptom(0, number, signals, (0, 1), known, (reading,)),
        ChangeRequest(0, number, drifts, (), (), signals),
        plan(number, epsilon=1.0 / number, add=(2,) if alarm else ()),
    )
