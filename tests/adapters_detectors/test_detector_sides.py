"""Which side each detector sees: of a fall and of a rise, of a return of 0 and 1, and of one that is inverted."""

import itertools
import random

import pytest
from gymnasium import Env, register
from gymnasium.spaces import Discrete

from adapters.detectors.river_detector import AdwinConfig, RiverConfig, RiverDetector
from adapters.systems import make_system
from mape import registry
from mape.config import DetectorSpec, from_table
from mape.parts import cautions
from mape.trials import run_trial


def build(name, **options):
    return registry.build("detector", DetectorSpec.model_validate({"name": name, **options}))


def successes(before, after, count=400, seed=11):
    """A return of 0 and 1 whose share of successes changes in the middle."""
    rng = random.Random(seed)
    return [float(rng.random() < share) for share in (before, after) for _ in range(count)]


def directions(detector, stream, first):
    """The directions of the alarms from value `first` on; the detector is reset after each, as Monitor does it."""
    found = []
    for i, x in enumerate(stream):
        if detector.update(x):
            if i >= first:
                found.append(detector.direction)
            detector.reset()
    return found


TWO_SIDED = {"drift_confidence": 0.001, "two_sided_test": True}
SIDES = {
    # name, options, invert -> the sides that it sees, of a return of 0 and 1
    ("ADWIN", (), False): "fall rise",
    ("ADWIN", (), True): "fall rise",
    ("KSWIN", (), False): "fall rise",
    ("PageHinkley", (), False): "fall rise",
    ("PageHinkley", (("mode", "down"),), False): "fall",
    ("PageHinkley", (("mode", "up"),), False): "rise",
    ("PageHinkley", (("mode", "up"),), True): "fall",
    ("DDM", (), False): "rise",
    ("DDM", (), True): "fall",
    ("EDDM", (), False): "rise",
    ("EDDM", (), True): "fall",
    ("HDDMA", (), False): "rise",
    ("HDDMA", (), True): "fall",
    ("HDDMA", tuple(TWO_SIDED.items()), False): "fall rise",
    ("HDDMA", tuple(TWO_SIDED.items()), True): "fall rise",
    ("HDDMW", (), False): "rise",
    ("HDDMW", (), True): "fall",
    ("FHDDM", (), False): "fall",
    ("FHDDM", (), True): "rise",
}
NAMED = {"down": "fall", "up": "rise"}


@pytest.mark.parametrize(("name", "options", "invert"), SIDES)
def test_a_detector_of_rivers_sees_the_sides_that_are_said_of_it(name, options, invert):
    given = {"threshold": 10.0, **dict(options)} if name == "PageHinkley" else dict(options)
    for side, stream in {"fall": successes(0.95, 0.2), "rise": successes(0.2, 0.95)}.items():
        detector = build("river", detector=name, options=given, invert=invert)
        # EDDM alarms of errors that were rare before, and is looked at from the change on.
        found = directions(detector, stream, 400)
        if side in SIDES[name, options, invert].split():
            assert found, f"{name} misses the {side}"
            assert {NAMED.get(direction, side) for direction in found} == {side}
        else:
            assert found[1:] == [], f"{name} alarms at the {side}"


@pytest.mark.parametrize(("name", "options", "sides"), [
    ("page_hinkley", {"threshold": 20.0, "delta": 0.1}, "fall"),
    ("two_window", {}, "fall rise"),
    ("adwin", {}, "fall rise"),
])  # fmt: skip
def test_a_built_in_detector_names_the_side_to_which_the_mean_moved(name, options, sides):
    for side, stream in {"fall": successes(0.95, 0.2), "rise": successes(0.2, 0.95)}.items():
        found = directions(build(name, **options), stream, 400)
        assert bool(found) == (side in sides.split())
        assert {NAMED.get(direction, side) for direction in found} <= {side}


@pytest.mark.parametrize("name", ["ADWIN", "KSWIN", "DDM", "EDDM", "HDDMA", "HDDMW", "FHDDM"])
def test_an_inverted_detector_reads_what_the_plain_one_reads_of_the_mirrored_values(name):
    inverted, plain = (RiverDetector(RiverConfig(detector=name, invert=invert)) for invert in (True, False))
    for x in successes(0.9, 0.3):
        assert (inverted.update(x), inverted.statistic) == (plain.update(1.0 - x), plain.statistic)
    assert inverted.state() == plain.state()


def test_an_option_for_rates_of_errors_is_none_of_adwins():
    assert "invert" not in AdwinConfig.model_fields


CAUTIOUS = [("DDM", False), ("EDDM", False), ("HDDMA", False), ("HDDMW", False), ("FHDDM", True)]


@pytest.mark.parametrize(
    ("detector", "invert"),
    [*itertools.product(["DDM", "EDDM", "HDDMA", "HDDMW", "FHDDM", "ADWIN"], [False, True])],
)
def test_who_would_never_see_the_return_fall_says_so(detector, invert):
    def said(**spec):
        watching = {"name": "river", "detector": detector, "invert": invert, **spec}
        return cautions(from_table({"episodes": 1, "system": {"id": "x"}, "monitor": {"detectors": [watching]}}))

    assert said(signal="failures") == []
    if (detector, invert) not in CAUTIOUS:
        assert said() == []
        return
    (sentence,) = said()
    assert detector in sentence
    assert f"Give it invert = {str(not invert).lower()}" in sentence


def test_a_detector_that_is_swapped_in_is_looked_at_too():
    table = {
        "episodes": 9,
        "system": {"id": "x"},
        "monitor": {"detectors": ["page_hinkley"]},
        "swap": [{"pass": 5, "part": "monitor", "to": {"name": "river", "detector": "DDM"}}],
    }
    (sentence,) = cautions(from_table(table))
    assert "invert = true" in sentence


class Lottery(Env):
    """One step an episode, a success of .95 that falls to .20 from episode 301 on, whatever is done."""

    observation_space, action_space = Discrete(1), Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.share = 0.95 if options["episode"] <= 300 else 0.20
        return 0, {}

    def step(self, action):
        return 0, float(self.np_random.random() < self.share), True, False, {}


register("Lottery-v0", Lottery, max_episode_steps=1)


@pytest.mark.parametrize("detector", ["DDM", "EDDM", "HDDMA", "HDDMW"])
def test_a_success_rate_that_falls_is_seen_by_an_inverted_test_of_the_error_rate(detector):
    table = {
        "episodes": 600,
        "system": {"id": "Lottery-v0"},
        "monitor": {"detectors": [{"name": "river", "detector": detector, "invert": True}]},
    }
    alarms = run_trial(from_table(table), 0, make_system).alarms
    assert any(300 < episode < 420 for episode in alarms)
