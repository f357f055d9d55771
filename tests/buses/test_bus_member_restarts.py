"""What a role may rely on while Knowledge comes and goes, and while its own link does."""

import gc
import threading

import pytest
from bus_peers import Site, eventually, lose, of, play_part, received, status
from bus_records import TOLD, new_ledger, observation, plan, run_of, symptom

from adapters.buses import Member, inbox, member, questions
from adapters.buses.questions import Refused
from adapters.roles import ROLES
from adapters.stores.mark import mark_path
from knowledge import to_json


def test_nothing_is_lost_and_nothing_comes_twice_over_restarts_of_knowledge(site, impatient):
    passes, got = 60, {}
    site.everybody()
    players = [
        threading.Thread(target=lambda peer=peer: got.update({peer.role: play_part(peer, 0, passes)}))
        for peer in site.members.values()
    ]
    for player in players:
        player.start()
    for reached in (10, 25, 40):
        eventually(lambda reached=reached: site.ledger.last(0)[3] >= reached, within=60)
        site.close()
        site.open()
        assert site.ledger.last(0)[3] >= reached
    for player in players:
        player.join(60)
    assert got == {role: of(role, run_of(passes)) for role in ROLES}
    site.close()
    log = new_ledger(site.path)
    assert [body.encode() for body in log.since(0, dict.fromkeys(range(4), 0), 9999)] == list(
        map(to_json, run_of(passes))
    )
    log.store.close()
    site.open()


def test_what_was_sent_while_knowledge_was_away_is_appended_when_it_is_back(wire, tmp_path):
    with Site(wire, tmp_path / "l", free=True) as site:
        site.everybody()
        site.send(plan(0))
        site.close()
        for number in range(1, 200):
            site.members["execute"].send(observation(number))
        site.open()
        site.members["execute"].settle(60)
        assert site.ledger.last(0) == (199, 0, 0, 0)


def test_one_that_sends_to_a_knowledge_that_lost_its_log_stops_with_a_sentence(site, all_four, tmp_path):
    site.send(*run_of(2))
    site.close()
    site.open(tmp_path / "another.sqlite")
    all_four["execute"].send(observation(3))
    with pytest.raises(Refused, match=r"no execute of epoch 1 has joined this Knowledge; was its log lost\?"):
        all_four["execute"].settle(60)


def test_one_that_only_waits_on_a_knowledge_that_lost_its_log_stops_too(site, all_four, tmp_path):
    all_four["monitor"].watch(0, 1)
    site.send(*run_of(2))
    assert len(received(all_four["monitor"], 2)) == 2
    site.close()
    site.open(tmp_path / "another.sqlite")
    with pytest.raises(Refused, match="the run has not begun"):
        received(all_four["monitor"], 1, within=60)


def test_one_whose_log_is_an_older_one_stops_with_a_sentence(site, all_four, tmp_path):
    old = tmp_path / "old.sqlite"
    site.send(*run_of(1))
    site.close()
    for kept in (site.path, mark_path(site.path)):
        old.with_suffix(kept.suffix).write_bytes(kept.read_bytes())
    site.open()
    site.send(*run_of(3)[5:])
    site.close()
    site.open(old)
    all_four["execute"].send(observation(4))
    with pytest.raises(Refused, match="had Observation 3 of loop 0 from execute, and has them up to 1 only"):
        all_four["execute"].settle(60)


def test_a_record_that_is_lost_behind_dropped_episodes_is_sent_again(wire, impatient, monkeypatch):
    """A stage goes past what was dropped; the hole before its record is none that the record fills."""
    with Site(wire, free=True) as site:
        site.everybody()
        execute, monitor = site.members["execute"], site.members["monitor"]
        site.send(plan(0), observation(1), symptom(1))
        execute.drop(0, 2, 9)
        site.send(observation(10), observation(11))
        lost = lose(monkeypatch, site, lambda data: data == to_json(symptom(10)))
        monitor.send(symptom(10))
        monitor.send(symptom(11))
        monitor.settle(60)
        assert lost == [to_json(symptom(10))]
        assert site.ledger.last(0) == (11, 11, 0, 0)


def test_dropped_episodes_are_said_and_a_reader_goes_past_them(wire, impatient, monkeypatch):
    with Site(wire, free=True) as site:
        site.everybody()
        execute, monitor = site.members["execute"], site.members["monitor"]
        monitor.watch(0, 1)
        site.send(plan(0), observation(1))
        lost = lose(monkeypatch, site, lambda data: b"Dropped" in data)
        execute.drop(0, 2, 9)
        execute.send(observation(10))
        execute.send(observation(11))
        execute.settle(60)
        assert len(lost) == 1
        assert received(monitor, 3) == [observation(1), observation(10), observation(11)]
        assert status(site.session(), wire).dropped == 8


def test_one_whose_link_stands_and_is_dead_opens_another_session(site, all_four, monkeypatch):
    monkeypatch.setattr(inbox, "ANSWER_WITHIN", 0.1)
    monkeypatch.setattr(member, "DEAF_AFTER", 0.1)
    raw, planner, heard = site.session(), all_four["plan"], threading.Event()
    site.send(plan(0))
    planner.watch(0, 1)
    true_hear = site.hub._hear
    unheard = []  # kept, as one that is let go is answered by that
    monkeypatch.setattr(
        site.hub, "_hear", lambda *given: true_hear(*given) if heard.is_set() else unheard.append(given)
    )
    first = planner._session
    eventually(lambda: planner.receive(0.01) is not None or planner._session is not first, within=60)
    heard.set()
    site.send(*run_of(1)[1:])
    assert received(planner, 1) == of("plan", run_of(1))
    assert planner.joined.epoch == 1
    assert site.ledger.last(0) == (1, 1, 1, 1)
    eventually(lambda: status(raw, site.wire).roles["plan"].alive)
    planner.close()
    eventually(lambda: not status(raw, site.wire).roles["plan"].alive)


def test_one_that_waits_for_a_busy_knowledge_keeps_its_session(site, all_four, monkeypatch):
    for module in (inbox, questions):
        monkeypatch.setattr(module, "ANSWER_WITHIN", 0.1)
    held, true_take = threading.Event(), site.ledger.take
    monkeypatch.setattr(site.ledger, "take", lambda *given: (held.wait(60), true_take(*given))[1])
    planner, first, lost = all_four["plan"], all_four["plan"]._session, []
    true_lost = planner._lost
    monkeypatch.setattr(planner, "_lost", lambda: (lost.append(1), true_lost()))
    planner.send(plan(0))
    eventually(lambda: planner.receive(0.01) is not None or len(lost) >= 3)
    held.set()
    planner.settle(60)
    assert planner._session is first


def test_one_that_nobody_holds_any_more_leaves_at_once(wire):
    """Not at some later moment, on whatever thread then looks for garbage."""
    with Site(wire) as site:
        raw = site.session()
        held = [Member(wire, "execute", layout=TOLD, patience=10)]
        gc.disable()
        try:
            held[0].connect()
            held[0].send(observation(1))
            held[0].watch(0, 0)
            eventually(lambda: status(raw, wire).roles["execute"].alive)
            held.clear()
            eventually(lambda: not status(raw, wire).roles["execute"].alive)
        finally:
            gc.enable()
