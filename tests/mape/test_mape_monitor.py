import pytest

from knowledge import Observation, Reading
from mape.errors import PartError
from mape.monitor import Monitor


class Scripted:
    """Alarms above 10 and notes what is done to it."""

    direction = "up"

    def __init__(self):
        self.done = []
        self.statistic = None

    def update(self, x):
        self.done.append(x)
        self.statistic = x / 2
        return x > 10.0

    def reset(self):
        self.done.append("reset")
        self.statistic = None


def observation(number, value, *, reset=False, steps=1.0):
    return Observation(0, number, number - 1, 0.5, reset, 3, (0, 1), (0,), {"return": value, "steps": steps})


def monitored(*observations, detectors):
    sent = []
    monitor = Monitor(detectors, sent.append)
    for seen in observations:
        monitor.on_observation(seen)
    return sent


def test_a_symptom_hands_on_the_very_signals_and_actions_and_one_reading_per_detector():
    seen = observation(1, 4.0, steps=20.0)
    first, second = Scripted(), Scripted()
    (symptom,) = monitored(seen, detectors=[("return", first), ("steps", second)])
    assert symptom[:2] == (0, 1)
    assert symptom.signals is seen.signals
    assert symptom.available is seen.available
    assert symptom.known is seen.known
    assert symptom.readings == (Reading("return", 4.0, 2.0, False, "up"), Reading("steps", 20.0, 10.0, True, "up"))


def test_an_alarm_resets_its_own_detector_at_once_and_no_other():
    first, second = Scripted(), Scripted()
    monitored(observation(1, 99.0), observation(2, 1.0), detectors=[("return", first), ("steps", second)])
    assert first.done == [99.0, "reset", 1.0]
    assert second.done == [1.0, 1.0]


def test_a_reading_is_that_of_the_alarm_and_not_of_the_reset_after_it():
    (symptom,) = monitored(observation(1, 99.0), detectors=[("return", Scripted())])
    assert symptom.readings[0].statistic == 49.5


def test_a_reset_that_plan_wants_is_done_before_the_update():
    first, second = Scripted(), Scripted()
    seen = (observation(1, 1.0), observation(2, 2.0, reset=True))
    monitored(*seen, detectors=[("return", first), ("steps", second)])
    assert first.done == [1.0, "reset", 2.0]
    assert second.done == [1.0, "reset", 1.0]


def test_without_detectors_a_symptom_has_no_readings():
    (symptom,) = monitored(observation(1, 1.0), detectors=[])
    assert symptom.readings == ()


@pytest.mark.parametrize("member", ["update", "reset"])
def test_a_detector_that_raises_is_named_with_its_signal_value_and_pass(member):
    class Broken(Scripted):
        pass

    def fail(*_):
        raise ZeroDivisionError("oh")

    setattr(Broken, member, fail)
    sent = []
    with pytest.raises(PartError, match=r"detector Broken raised ZeroDivisionError: oh, at pass 3 on return = 50\.0"):
        Monitor([("return", Broken())], sent.append).on_observation(observation(3, 50.0))
    assert sent == []


def test_a_signal_that_the_run_does_not_have_is_named_with_those_it_has():
    with pytest.raises(PartError, match="watches signal 'noise'; the run has return, steps"):
        monitored(observation(1, 1.0), detectors=[("noise", Scripted())])
