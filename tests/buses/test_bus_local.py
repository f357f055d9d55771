"""What the bus within a process promises: the order of the log, each once, and no recursion."""

import pytest
from bus_records import new_log, observation, plan, request, run_of, symptom

from knowledge import STAGES, ChangePlan, ChangeRequest, Observation, Symptom
from mape.bus import LocalBus
from mape.errors import BusError


@pytest.fixture
def log():
    return new_log()


@pytest.fixture
def bus(log):
    return LocalBus(log)


def test_records_arrive_in_the_order_of_the_log_each_once(bus, log):
    got = []
    for kind in STAGES:
        bus.subscribe(kind, got.append)
    for record in run_of(5):
        bus.send(record)
    assert bus.run() == len(run_of(5))
    assert got == run_of(5)
    assert bus.run() == 0
    assert list(log.since(0)) == got


def test_numbers_come_back_as_the_same_bits(bus, log):
    got = []
    bus.subscribe(Observation, got.append)
    bus.send(plan(0))
    values = [0.1 + 0.2, -0.0, 5e-324, 1.7976931348623157e308, -1 / 3]
    for number, value in enumerate(values, 1):
        for record in (observation(number, value), symptom(number), request(number), plan(number)):
            if "signals" in record._fields:
                record = record._replace(signals={"return": value})
            bus.send(record)
    bus.run()
    assert [seen.signals["return"].hex() for seen in got] == [value.hex() for value in values]


def test_only_what_was_subscribed_to_is_delivered(bus, log):
    got = []
    bus.subscribe(ChangeRequest, got.append)
    for record in run_of(3):
        bus.send(record)
    bus.run()
    assert got == [request(1), request(2), request(3)]


def test_what_is_sent_twice_is_delivered_once(bus, log):
    got = []
    bus.subscribe(ChangePlan, got.append)
    bus.send(plan(0))
    bus.send(plan(0))
    assert bus.run() == 1
    bus.send(plan(0))
    assert bus.run() == 0
    assert got == [plan(0)]


@pytest.mark.parametrize(
    ("record", "reason"),
    [
        (observation(2), "gap"),
        (symptom(1), "gap"),
        (plan(7), "gap"),
        (plan(0, epsilon=0.25), "conflict"),
    ],
)
def test_a_gap_or_a_conflict_is_an_error_and_changes_nothing(bus, log, record, reason):
    got = []
    for kind in STAGES:
        bus.subscribe(kind, got.append)
    bus.send(plan(0))
    named = f"{type(record).__name__} {record.pass_no} is refused as a {reason}: the log holds 0 finished passes"
    with pytest.raises(BusError, match=named):
        bus.send(record)
    bus.send(observation(1))
    bus.run()
    assert got == [plan(0), observation(1)]
    assert list(log.since(0)) == got


def test_a_stage_that_hands_on_other_signals_is_in_conflict(bus, log):
    bus.send(plan(0))
    bus.send(observation(1))
    with pytest.raises(BusError, match="conflict"):
        bus.send(symptom(1)._replace(signals={"return": 9.0}))


def test_a_record_that_does_not_fit_the_run_is_an_error_and_changes_nothing(bus, log):
    with pytest.raises(BusError, match=r"ChangePlan 0 is refused.*does not fit the run's layout of 1 signals"):
        bus.send(plan(0)._replace(learning_rate=(0.1, 0.2)))
    bus.send(plan(0))
    assert list(log.since(0)) == [plan(0)]


def test_a_handler_that_sends_is_finished_before_the_next_record_is_delivered(bus, log):
    got, depth = [], []

    def answer(record, make):
        assert depth == [], "a handler ran within another"
        depth.append(record)
        got.append(record)
        bus.send(make(record.pass_no))
        depth.pop()

    bus.subscribe(ChangePlan, lambda record: answer(record, lambda n: observation(n + 1)))
    bus.subscribe(Observation, lambda record: answer(record, symptom))
    bus.subscribe(Symptom, lambda record: answer(record, request))
    bus.subscribe(ChangeRequest, lambda record: answer(record, plan) if record.pass_no < 4 else got.append(record))
    bus.send(plan(0))
    bus.run()
    assert got == run_of(4)[:-1]


def test_two_subscribers_of_one_kind_both_get_it_in_the_order_they_came(bus, log):
    got = []
    bus.subscribe(ChangePlan, lambda record: got.append(("first", record)))
    bus.subscribe(ChangePlan, lambda record: got.append(("second", record)))
    bus.send(plan(0))
    assert bus.run() == 1
    assert got == [("first", plan(0)), ("second", plan(0))]


def test_what_a_handler_raises_comes_out_of_run_and_the_rest_still_waits(bus, log):
    got = []

    def fragile(record):
        got.append(record)
        if record.pass_no == 0:
            raise RuntimeError("plan 0 is not to my taste")

    bus.subscribe(ChangePlan, fragile)
    for record in run_of(1):
        bus.send(record)
    with pytest.raises(RuntimeError, match="not to my taste"):
        bus.run()
    assert got == [plan(0)]
    bus.run()
    assert got == [plan(0), plan(1)]


def test_what_a_sender_is_refused_within_a_handler_comes_out_of_run(bus, log):
    bus.subscribe(ChangePlan, lambda record: bus.send(symptom(5)))
    bus.send(plan(0))
    with pytest.raises(BusError, match="gap"):
        bus.run()


def test_after_close_nothing_is_delivered_and_the_log_keeps_it(bus, log):
    got = []
    bus.subscribe(ChangePlan, got.append)
    bus.send(plan(0))
    bus.close()
    bus.close()
    assert bus.run() == 0
    assert got == []
    assert list(log.since(0)) == [plan(0)]


def test_a_handler_may_close_the_bus(bus, log):
    got = []

    def last(record):
        got.append(record)
        bus.send(observation(1))
        bus.close()

    bus.subscribe(ChangePlan, last)
    bus.subscribe(Observation, got.append)
    bus.send(plan(0))
    assert bus.run() == 1
    assert got == [plan(0)]
