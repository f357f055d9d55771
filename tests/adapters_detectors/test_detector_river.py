import json
import random
import subprocess
import sys
from pathlib import Path

import pytest
from river import drift

from adapters.cli.main import main
from adapters.detectors.river_detector import Adwin, AdwinConfig, RiverConfig, RiverDetector, _classes
from adapters.systems import make_system
from mape import registry
from mape.config import DetectorSpec, from_table
from mape.errors import ConfigError, PartError
from mape.loop import Loop
from mape.testing import check_detector, require


def build(name="river", **options):
    return registry.build("detector", DetectorSpec.model_validate({"name": name, **options}))


def steps(*levels, count=120, spread=1.0):
    rng = random.Random(7)
    return [rng.gauss(level, spread) for level in levels for _ in range(count)]


def alarms(detector, stream):
    found = []
    for i, x in enumerate(stream):
        if detector.update(x):
            found.append(i)
            detector.reset()
    return found


ZEROS_AND_ONES = [
    float(x) for x in random.Random(3).choices([0, 1], k=100) + random.Random(3).choices([0, 1, 1, 1], k=100)
]


@pytest.mark.parametrize("name", ["ADWIN", "DummyDriftDetector", "KSWIN", "NoDrift", "PageHinkley"])
def test_rivers_detectors_keep_the_contract_of_a_detector(name):
    require(check_detector(lambda: build(detector=name)))


@pytest.mark.parametrize("name", ["DDM", "EDDM", "FHDDM", "HDDMA", "HDDMW"])
def test_rivers_detectors_for_zeros_and_ones_keep_the_contract_on_such_a_signal(name):
    require(check_detector(lambda: build(detector=name), ZEROS_AND_ONES))


@pytest.mark.parametrize("name", ["ADWIN", "KSWIN", "PageHinkley"])
def test_the_contract_holds_too_where_the_memory_overflows(name):
    require(check_detector(lambda: build(detector=name, memory=50)))


def test_all_of_rivers_detectors_are_found_and_its_classifiers_are_not():
    assert {"ADWIN", "KSWIN", "PageHinkley", "NoDrift", "DDM", "EDDM", "HDDMA", "HDDMW"} <= set(_classes())
    assert "DriftRetrainingClassifier" not in _classes()
    assert "DriftDetector" not in _classes()


@pytest.mark.parametrize("name", ["ADWIN", "PageHinkley"])
def test_a_detector_alarms_when_rivers_own_does(name):
    stream = steps(0.0, 8.0, -8.0, 0.0)
    rivers, expected = getattr(drift, name)(), []
    for i, x in enumerate(stream):
        rivers.update(x)
        if rivers.drift_detected:
            expected.append(i)
            rivers = rivers.clone()
    assert alarms(build(detector=name), stream) == expected
    assert len(expected) >= 2


def test_options_reach_rivers_detector():
    stream = steps(0.0, 8.0)
    eager, patient = ({"delta": 0.5, "clock": 1}, {"clock": 1000})
    assert alarms(build(detector="ADWIN", options=eager), stream)
    assert not alarms(build(detector="ADWIN", options=patient), stream)


def test_adwin_has_a_short_name_and_sees_both_sides():
    assert alarms(build("adwin"), steps(0.0, 8.0)) == alarms(build(detector="ADWIN"), steps(0.0, 8.0)) != []
    assert alarms(build("adwin"), steps(8.0, 0.0)) != []
    assert build("adwin").direction == "unknown"
    assert not alarms(build("adwin", clock=1000), steps(0.0, 8.0))
    with pytest.raises(ConfigError, match=r"detector\.delta: .*less than 1"):
        build("adwin", delta=1.5)


@pytest.mark.parametrize(("mode", "direction"), [("down", "down"), ("up", "up"), ("both", "unknown")])
def test_a_page_hinkley_says_which_side_it_watches(mode, direction):
    assert build(detector="PageHinkley", options={"mode": mode}).direction == direction
    assert build(detector="PageHinkley").direction == "unknown"


def test_the_statistic_is_what_river_exposes_and_else_none():
    adwin, kswin, page_hinkley = (build(detector=name) for name in ("ADWIN", "KSWIN", "PageHinkley"))
    for detector in (adwin, kswin, page_hinkley):
        for x in steps(5.0, spread=0.0):
            detector.update(x)
    assert adwin.statistic == pytest.approx(5.0)
    assert 0.0 <= kswin.statistic <= 1.0
    assert page_hinkley.statistic is None


def test_a_detector_that_draws_is_seeded_unless_a_seed_is_given():
    stream = steps(0.0, 0.5, 0.0, 0.5)

    def readings(**options):
        detector = build(detector="KSWIN", options=options)
        return [(detector.update(x), detector.statistic) for x in stream]

    assert readings() == readings() == readings(seed=0)
    assert readings(seed=1) == readings(seed=1) != readings()


def test_the_state_is_the_signal_since_the_last_reset():
    detector = build()
    for x in (1.0, 2.5, -3.0):
        detector.update(x)
    assert detector.state() == {"signal": [1.0, 2.5, -3.0]}
    detector.reset()
    assert detector.state() == {"signal": []}


def test_no_more_than_memory_values_are_ever_kept_and_never_less_than_half():
    detector = build(detector="NoDrift", memory=10)
    kept = []
    for i in range(50):
        detector.update(float(i))
        kept.append(detector.state()["signal"])
        assert kept[-1] == [float(n) for n in range(i + 1)][-len(kept[-1]) :]
    assert max(map(len, kept)) == 10
    assert min(map(len, kept[10:])) == 5


def test_a_restored_detector_goes_on_as_the_original_where_values_were_forgotten():
    stream = steps(0.0, 1.0, 0.0, 1.0, spread=0.7)
    for cut in range(5, 400, 37):
        original, heir = (build(detector="ADWIN", memory=64, options={"clock": 3}) for _ in range(2))
        for x in stream[:cut]:
            original.update(x)
        heir.restore(json.loads(json.dumps(original.state())))
        for x in stream[cut:]:
            assert (heir.update(x), heir.statistic) == (original.update(x), original.statistic)


def test_a_detector_for_zeros_and_ones_refuses_other_values():
    detector = build(detector="DDM")
    detector.update(1.0)
    with pytest.raises(ValueError, match=r"River's DDM watches a signal of 0 and 1, got 0\.5"):
        detector.update(0.5)
    assert detector.state() == {"signal": [1.0]}


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"detector": "ADWN"}, r"detector\.detector: unknown detector of River 'ADWN'; did you mean 'ADWIN'\?"),
        ({"detector": "DriftRetrainingClassifier"}, "unknown detector of River"),
        (
            {"options": {"delat": 1.0}},
            r"detector\.options: unknown option of River's ADWIN 'delat'; did you mean 'delta'\?",
        ),
        ({"detector": "NoDrift", "options": {"delta": 1.0}}, "unknown option of River's NoDrift 'delta'"),
        ({"detector": "PageHinkley", "options": {"mode": "sideways"}}, "ValueError: Invalid 'mode'"),
        ({"options": {"delta": float("nan")}}, "finite"),
        ({"memory": 1}, r"detector\.memory: .*greater than or equal to 2"),
        ({"detektor": "ADWIN"}, "no such option; did you mean 'detector'"),
    ],
)
def test_a_class_or_option_that_does_not_exist_is_asked_back(options, reason):
    with pytest.raises(ConfigError, match=reason):
        build(**options)


@pytest.mark.parametrize("name", ["river", "adwin"])
def test_without_river_the_error_says_how_to_install_it(name, monkeypatch):
    for module in [m for m in sys.modules if m.partition(".")[0] == "river"]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "river", None)
    _classes.cache_clear()
    try:
        with pytest.raises(ConfigError, match=r"needs the package 'river', which is not installed: pip install river"):
            build(name)
    finally:
        _classes.cache_clear()


PROGRAM = """
from adapters.systems import make_system
from mape.config import from_table
from mape.trials import run_trial

detectors = ["adwin", {"name": "river", "detector": "PageHinkley"}]
config = from_table({"episodes": 3, "system": {"id": "mapek/Gridworld-v0"}, "monitor": {"detectors": detectors}})
print(run_trial(config, 0, make_system).passes)
"""


def test_a_program_of_ones_own_knows_the_short_names_as_the_command_does():
    ran = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=120)
    assert (ran.stdout, ran.stderr) == ("3\n", "")


def test_a_panic_of_rust_is_a_sentence_that_names_the_part(tmp_path, capfd):
    detectors = 'monitor.detectors=[{name="river", detector="ADWIN", options={clock=0}}]'
    config = Path(__file__).parents[2] / "examples" / "gridworld_goals.toml"
    options = ["--set", detectors, "--quiet", "--no-figures", "--out", str(tmp_path / "out")]
    assert main(["run", str(config), "--set", "episodes=5", *options]) == 1
    (said,) = [line for line in capfd.readouterr().err.splitlines() if line.startswith("mapek: ")]
    assert "detector RiverDetector raised PanicException" in said


def test_a_detector_is_made_by_hand_too():
    assert Adwin(AdwinConfig()).direction == RiverDetector(RiverConfig(detector="ADWIN")).direction


def loop(detector):
    table = {
        "episodes": 60,
        "system": {"id": "mapek/TrafficJunction-v0", "options": {"switch_at": [30], "rates": [[4.0, 2.0], [9.0, 9.0]]}},
        "monitor": {"detectors": [detector]},
    }
    config = from_table(table)
    return Loop(config, make_system(config.system))


def test_adwin_on_the_arrival_rate_sees_the_rates_shift():
    made = loop({"name": "adwin", "signal": "arrivals_2", "clock": 4})
    made.run(60)
    drifts = [(p.request.pass_no, drift) for p in made.log.window for drift in p.request.drifts]
    assert [drift for _, drift in drifts] == [("arrivals_2", "unknown")]
    assert 30 <= drifts[0][0] <= 45


def test_what_a_detector_of_rivers_raises_is_the_parts_error():
    with pytest.raises(
        PartError, match="detector RiverDetector raised ValueError: River's DDM watches a signal of 0 and 1"
    ):
        loop({"name": "river", "detector": "DDM"}).run(1)
