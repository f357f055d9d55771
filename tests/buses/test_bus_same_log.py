"""The four components log the same rows over a `LocalBus` and over the wire."""

from bus_peers import eventually
from bus_small_loop import Distributed, in_process, small_config

from adapters.buses.messages import Control
from adapters.roles import ROLES
from knowledge import from_json


def logged(ledger, loop=0):
    return [from_json(body) for body in ledger.since(loop, dict.fromkeys(range(4), 1), 100_000)]


def run_over(wire, path, config, meanwhile=lambda site: None):
    site = Distributed(config, wire, path)
    site.open()
    try:
        for role in ROLES:
            site.start(role)
        meanwhile(site)
        site.join()
        assert site.ledger.complete
        site.hub.close()
        records = [logged(site.ledger, loop) for loop in range(config.units)]
        digests = [site.ledger.sha256(loop) for loop in range(config.units)]
        return records, digests, site.ledger.store.snapshot(0, "execute")
    finally:
        site.close()


def test_a_small_run_has_the_same_log_hash_and_q_table(wire, tmp_path):
    config = small_config()
    expected = in_process(config)
    (records,), (digest,), snapshot = run_over(wire, tmp_path / "l", config)
    for at, finished in enumerate(expected.log.window):
        assert tuple(records[4 * at : 4 * at + 4]) == finished, f"pass {finished.plan.pass_no}"
    assert any(finished.request.drifts for finished in expected.log.window), "no drift: too tame to show anything"
    assert digest == expected.log.sha256()
    assert snapshot.table.sha256() == expected.execute.q_table.sha256()


def test_two_loops_have_the_same_log_hashes(wire, tmp_path):
    config = small_config(12, loops=2)
    _, digests, _ = run_over(wire, tmp_path / "l", config)
    assert digests == [in_process(config, loop).log.sha256() for loop in range(2)]


def test_it_is_the_same_after_restarts_of_knowledge(wire, tmp_path):
    config = small_config(60)

    def restart(site):
        for reached in (10, 30):
            eventually(lambda reached=reached: site.ledger.last(0)[3] >= reached, within=60)
            site.close()
            site.open()

    _, (digest,), _ = run_over(wire, tmp_path / "l", config, restart)
    assert digest == in_process(config).log.sha256()


def test_a_question_about_a_loop_that_is_not_there_does_not_stop_execute(wire, tmp_path):
    config = small_config(60)
    answers = []

    def question(site):
        eventually(lambda: site.ledger.epoch("execute") == 1, within=60)
        with wire.join("operator", 5) as raw:
            control = Control(what="q_table", loop=99, pass_no=1).pack()
            asked = {"payload": control, "attachment": site.hub._seal}
            eventually(lambda: answers.extend(raw.get(wire.control("execute"), **asked)) or answers, within=60)

    _, (digest,), _ = run_over(wire, tmp_path / "l", config, question)
    assert "loop 99; this run has loops 0 to 0" in answers[0].err.payload.to_string()
    assert digest == in_process(config).log.sha256()
