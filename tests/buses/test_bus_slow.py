"""A role that takes longer for what it is given than Knowledge for giving it."""

import threading

import pytest
from bus_peers import Site
from bus_records import run_of

from adapters.buses import answers, inbox, outbox
from adapters.buses.wire import INPUT
from knowledge import STAGES, to_json


def test_a_slow_consumer_asks_about_once_per_full_answer(wire, monkeypatch):
    passes, limit = 512, 64
    monkeypatch.setattr(answers, "SINCE_LIMIT", limit)
    # One answer takes it longer than it waits for an answer, and longer than silence lasts.
    monkeypatch.setattr(inbox, "ANSWER_WITHIN", 0.05)
    monkeypatch.setattr(inbox, "SILENCE", 0.02)
    asked, true_since = [], answers.Answers._since

    def since(self, query):
        asked.append(int(query.parameters.get("from").partition(":")[2]))
        return true_since(self, query)

    monkeypatch.setattr(answers.Answers, "_since", since)
    with Site(wire, begun=True) as site:
        for record in run_of(passes):
            site.ledger.take(0, STAGES.index(type(record)), to_json(record))
        site.ledger.commit()
        monitor, got, pause = site.member("monitor"), [], threading.Event()
        monitor.watch(0, 1)
        while len(got) < passes:
            came = monitor.receive(1.0)
            if came is not None:
                got.append(came)
                pause.wait(0.002)
    assert got == [record for record in run_of(passes) if type(record) is INPUT["monitor"]]
    # What it asks when it has all is whether there is more; that has its own pace.
    questions = [number for number in asked if number <= passes]
    print(f"asked {len(questions)} times for {passes // limit} full answers: {questions}")
    assert len(questions) <= 2 * (passes // limit)


@pytest.mark.long
def test_what_takes_its_time_is_sent_about_once(wire, monkeypatch):
    """An answer that takes longer than the first patience is waited for from then on, and not asked for ever again."""
    monkeypatch.setattr(outbox, "RESEND_AFTER", 0.02)
    heard, slowly = [], threading.Event()
    with Site(wire, begun=True) as site:
        true_say, true_append = site.hub._say, site.hub.answers.append
        monkeypatch.setattr(site.hub, "_say", lambda answer: (slowly.wait(0.3), true_say(answer)))
        monkeypatch.setattr(
            site.hub.answers, "append", lambda query: (heard.append(str(query.key_expr)), true_append(query))[1]
        )
        site.everybody()
        for record in run_of(4):
            site.send(record)
    sent = len(run_of(4))
    print(f"{sent} records were heard {len(heard)} times")
    assert len(heard) < 2 * sent
