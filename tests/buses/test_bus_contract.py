"""What every bus promises, and that both keep it."""

from contextlib import ExitStack

import pytest
from bus_records import new_log, observation, plan, request, run_of, symptom
from bus_small_loop import add_analyze, add_execute, add_monitor, add_plan, in_process, small_config
from bus_small_loop import new_log as new_loop_log

from adapters.buses import KnowledgeHub, ZenohBus
from adapters.systems import make_system
from knowledge import STAGES, ChangePlan, ChangeRequest, Knowledge, Observation, Symptom
from mape.bus import LocalBus
from mape.errors import BusError

pytestmark = pytest.mark.timeout(20)


class LocalSite:
    """One bus for everybody."""

    def __init__(self, log):
        self.log = log
        self._bus = LocalBus(log)

    def bus(self, name):
        return self._bus

    def settle(self):
        return self._bus.run()

    def finished_log(self):
        self._bus.close()
        return self.log


class ZenohSite:
    """A hub, and one session for each component."""

    def __init__(self, log, wire, stack):
        self.log = log
        self._stack = stack
        self._wire = wire
        self._buses = []
        stack.enter_context(KnowledgeHub(log, wire))

    def bus(self, name):
        self._buses.append(self._stack.enter_context(ZenohBus(self._wire, name)))
        return self._buses[-1]

    def settle(self):
        """Run the buses in turn until one turn delivers nothing."""
        total = 0
        while delivered := sum(bus.run() for bus in self._buses):
            total += delivered
        return total

    def finished_log(self):
        self._stack.close()
        return self.log


@pytest.fixture(params=["local", "zenoh"])
def site_of(request, wire):
    with ExitStack() as stack:
        if request.param == "local":
            yield LocalSite
        else:
            yield lambda log: ZenohSite(log, wire, stack)


@pytest.fixture
def site(site_of):
    return site_of(new_log())


def test_records_arrive_in_the_order_of_the_log_each_once(site):
    bus, got = site.bus("a"), []
    for kind in STAGES:
        bus.subscribe(kind, got.append)
    for record in run_of(5):
        bus.send(record)
    assert bus.run() == len(run_of(5))
    assert got == run_of(5)
    assert bus.run() == 0
    assert list(site.finished_log().since(0)) == got


def test_numbers_come_back_as_the_same_bits(site):
    bus, got = site.bus("a"), []
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


def test_only_what_was_subscribed_to_is_delivered(site):
    bus, got = site.bus("a"), []
    bus.subscribe(ChangeRequest, got.append)
    for record in run_of(3):
        bus.send(record)
    bus.run()
    assert got == [request(1), request(2), request(3)]


def test_what_is_sent_twice_is_delivered_once(site):
    bus, got = site.bus("a"), []
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
def test_a_gap_or_a_conflict_is_an_error_and_changes_nothing(site, record, reason):
    bus, got = site.bus("a"), []
    for kind in STAGES:
        bus.subscribe(kind, got.append)
    bus.send(plan(0))
    named = f"{type(record).__name__} {record.pass_no} is refused as a {reason}: the log holds 0 finished passes"
    with pytest.raises(BusError, match=named):
        bus.send(record)
    bus.send(observation(1))
    bus.run()
    assert got == [plan(0), observation(1)]
    assert list(site.finished_log().since(0)) == got


def test_a_stage_that_hands_on_other_signals_is_in_conflict(site):
    bus = site.bus("a")
    bus.send(plan(0))
    bus.send(observation(1))
    with pytest.raises(BusError, match="conflict"):
        bus.send(symptom(1)._replace(signals={"return": 9.0}))


def test_a_record_that_does_not_fit_the_run_is_an_error_and_changes_nothing(site):
    bus = site.bus("a")
    with pytest.raises(BusError, match=r"ChangePlan 0 is refused.*does not fit the run's layout of 1 signals"):
        bus.send(plan(0)._replace(learning_rate=(0.1, 0.2)))
    bus.send(plan(0))
    assert list(site.finished_log().since(0)) == [plan(0)]


def test_a_handler_that_sends_is_finished_before_the_next_record_is_delivered(site):
    bus, got, depth = site.bus("a"), [], []

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


def test_two_subscribers_of_one_kind_both_get_it_in_the_order_they_came(site):
    bus, got = site.bus("a"), []
    bus.subscribe(ChangePlan, lambda record: got.append(("first", record)))
    bus.subscribe(ChangePlan, lambda record: got.append(("second", record)))
    bus.send(plan(0))
    assert bus.run() == 1
    assert got == [("first", plan(0)), ("second", plan(0))]


def test_two_components_both_get_it(site):
    one, two, got = site.bus("a"), site.bus("b"), []
    one.subscribe(ChangePlan, lambda record: got.append(("one", record)))
    two.subscribe(ChangePlan, lambda record: got.append(("two", record)))
    two.send(plan(0))
    site.settle()
    assert sorted(got) == [("one", plan(0)), ("two", plan(0))]


def test_what_a_handler_raises_comes_out_of_run_and_the_rest_still_waits(site):
    bus, got = site.bus("a"), []

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


def test_what_a_sender_is_refused_within_a_handler_comes_out_of_run(site):
    bus = site.bus("a")
    bus.subscribe(ChangePlan, lambda record: bus.send(symptom(5)))
    bus.send(plan(0))
    with pytest.raises(BusError, match="gap"):
        bus.run()


def test_after_close_nothing_is_delivered_and_the_log_keeps_it(site):
    bus, got = site.bus("a"), []
    bus.subscribe(ChangePlan, got.append)
    bus.send(plan(0))
    bus.close()
    bus.close()
    assert bus.run() == 0
    assert got == []
    assert list(site.finished_log().since(0)) == [plan(0)]


def test_a_handler_may_close_the_bus(site):
    bus, got = site.bus("a"), []

    def last(record):
        got.append(record)
        bus.send(observation(1))
        bus.close()

    bus.subscribe(ChangePlan, last)
    bus.subscribe(Observation, got.append)
    bus.send(plan(0))
    assert bus.run() == 1
    assert got == [plan(0)]


def test_a_small_loop_logs_the_same_rows(site_of):
    config = small_config()
    site = site_of(new_loop_log(config))
    system = make_system(config.system)
    knowledge = Knowledge(site.log)
    add_monitor(site.bus("monitor"), config)
    add_analyze(site.bus("analyze"), config)
    plan = add_plan(site.bus("plan"), config, knowledge)
    execute = add_execute(site.bus("execute"), config, knowledge, system)
    plan.start(0)
    site.settle()
    for _ in range(config.episodes):
        execute.drive()
        assert site.settle() == 4
    system.close()
    log = site.finished_log()
    expected = in_process()
    for ours, theirs in zip(log.window, expected.window, strict=True):
        assert ours == theirs, f"pass {ours.observation.pass_no}"
    assert any(done.request.drifts for done in log.window), "no drift: the run is too tame to show anything"
    assert log.sha256() == expected.sha256()
