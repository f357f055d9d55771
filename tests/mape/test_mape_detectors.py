import json
import math
import random

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from river.drift import PageHinkley as RiverPageHinkley

from mape import registry
from mape.errors import ConfigError
from mape.monitor.oracle import Oracle, OracleConfig
from mape.monitor.page_hinkley import PageHinkley, PageHinkleyConfig
from mape.monitor.two_window import TwoWindow, TwoWindowConfig
from mape.specs import PartSpec

values = st.floats(-1e3, 1e3, allow_nan=False)


def against_river(stream, delta, threshold):
    """Alarms of both, each reset after an alarm; None where a statistic is so near that rounding decides."""
    ours = PageHinkley(PageHinkleyConfig(delta=delta, threshold=threshold))
    river = RiverPageHinkley(mode="down", alpha=1.0, min_instances=1, delta=delta, threshold=threshold)
    alarms = []
    for i, x in enumerate(stream):
        alarm = ours.update(x)
        if abs(ours.statistic - threshold) < 1e-9 * (1.0 + threshold + abs(x)):
            return None
        river.update(x)
        assert alarm == river.drift_detected, f"value {i} of {stream}"
        if alarm:
            alarms.append(i)
            ours.reset()
            river = river.clone()
    return alarms


@settings(max_examples=200)
@given(
    st.lists(values | st.integers(-5, 5).map(float), max_size=60),
    st.sampled_from([0.0, 0.01, 0.5, 3.0]),
    st.sampled_from([0.3, 2.0, 12.0, 300.0]),
)
def test_page_hinkley_equals_river_alarm_for_alarm_on_any_stream(stream, delta, threshold):
    assume(against_river(stream, delta, threshold) is not None)


def test_page_hinkley_equals_river_alarm_for_alarm_on_streams_that_drift():
    rng = random.Random(1954)
    total = 0
    for _ in range(300):
        level, spread, stream = 50.0, rng.choice([1.0, 5.0, 30.0]), []
        for _ in range(rng.randrange(1, 5)):
            stream += [rng.gauss(level, spread) for _ in range(rng.randrange(10, 60))]
            level += rng.uniform(-100.0, 100.0)
        alarms = against_river(stream, rng.choice([0.0, 0.5, 2.0]), rng.choice([20.0, 100.0, 300.0]))
        assert alarms is not None
        total += len(alarms)
    assert total > 300


def test_page_hinkley_sees_falls_and_not_rises():
    falls, rises = (PageHinkley(PageHinkleyConfig(delta=0.5, threshold=30.0)) for _ in range(2))
    assert any(falls.update(x) for x in [10.0] * 20 + [0.0] * 20)
    assert not any(rises.update(x) for x in [0.0] * 20 + [10.0] * 200)
    assert falls.direction == "down"


def test_page_hinkley_refuses_a_state_that_is_not_finite_and_keeps_its_own():
    test = PageHinkley(PageHinkleyConfig())
    test.update(3.0)
    before = test.state()
    with pytest.raises(ValueError, match="must be finite"):
        test.restore(before | {"mean": math.nan})
    assert test.state() == before


def reference_z(old, new):
    spread = math.sqrt(np.var(old, ddof=1) / len(old) + np.var(new, ddof=1) / len(new))
    return (np.mean(new) - np.mean(old)) / spread


@given(
    st.integers(2, 12),
    st.integers(2, 6),
    st.lists(st.integers(-1000, 1000).map(lambda n: n / 8), min_size=20, max_size=40),
)
def test_two_window_equals_the_two_sample_z_test_of_numpy(reference, recent, stream):
    test = TwoWindow(TwoWindowConfig(reference=reference, recent=recent, threshold=3.0))
    for i, x in enumerate(stream, 1):
        alarm = test.update(x)
        if i < reference + recent:
            assert (alarm, test.statistic, test.direction) == (False, None, "unknown")
            continue
        old, new = stream[i - reference - recent : i - recent], stream[i - recent : i]
        if np.ptp(old) == 0 and np.ptp(new) == 0:
            continue
        z = reference_z(old, new)
        assert test.statistic == pytest.approx(abs(z), rel=1e-9, abs=1e-9)
        if abs(z) > 1e-6:
            assert test.direction == ("up" if z > 0 else "down")
        if abs(abs(z) - 3.0) > 1e-6:
            assert alarm == (abs(z) > 3.0)


def test_two_window_is_not_led_astray_by_a_large_offset():
    noise = random.Random(5)
    stream = [noise.gauss(0.0, 1.0) for _ in range(40)]
    plain, lifted = (TwoWindow(TwoWindowConfig(reference=20, recent=5)) for _ in range(2))
    for x in stream:
        plain.update(x)
        lifted.update(x + 1e8)
        if plain.statistic is not None:
            assert lifted.statistic == pytest.approx(plain.statistic, rel=1e-5, abs=1e-6)


def test_two_window_alarms_on_a_step_between_constant_stretches_and_not_within_one():
    test = TwoWindow(TwoWindowConfig(reference=4, recent=2, threshold=7.0))
    assert [test.update(x) for x in [1.0] * 8 + [2.0] * 2] == [False] * 9 + [True]
    assert test.direction == "up"


def test_two_window_forgets_everything_on_reset():
    test = TwoWindow(TwoWindowConfig(reference=2, recent=2, threshold=1.0))
    for x in (0.0, 1.0, 9.0, 9.0):
        test.update(x)
    test.reset()
    assert (test.statistic, test.direction, test.state()) == (None, "unknown", {"values": [], "z": None})


@pytest.mark.parametrize("name", ["page_hinkley", "two_window"])
@given(st.lists(values, max_size=300), st.data())
def test_a_detector_takes_up_where_its_state_was_given(name, stream, data):
    spec = PartSpec.model_validate(
        {
            "name": name,
            **({"threshold": 50.0} if name == "page_hinkley" else {"reference": 5, "recent": 3, "threshold": 2.0}),
        }
    )
    original, heir = (registry.build("detector", spec) for _ in range(2))
    cut = data.draw(st.integers(0, len(stream)))
    for x in stream[:cut]:
        original.update(x)
    heir.restore(json.loads(json.dumps(original.state())))
    for x in stream[cut:]:
        assert (heir.update(x), heir.statistic) == (original.update(x), original.statistic)


def test_the_oracle_alarms_at_its_episodes_whatever_it_is_fed_and_counts_on_through_resets():
    oracle = Oracle(OracleConfig(episodes=(2, 5)))
    alarms = []
    for x in (1.0, -9.0, 3.0, 0.0, 7.0, 7.0):
        alarms.append(oracle.update(x))
        oracle.reset()
    assert alarms == [False, True, False, False, True, False]


@pytest.mark.parametrize("episodes", [[0], [3, 2], [2, 2]])
def test_the_oracle_is_told_increasing_episodes_from_1(episodes):
    with pytest.raises(ConfigError, match="must be increasing and at least 1"):
        registry.build("detector", PartSpec.model_validate({"name": "oracle", "episodes": episodes}))
