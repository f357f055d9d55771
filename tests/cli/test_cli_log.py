"""`mapek log`: what stands in a log, as sentences and as it is."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tracemalloc
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from command_line import EXAMPLES, Mapek
from replay_logs import begin, change, places, reseal, small, take, write_free_log, write_log

from adapters.cli.log import Cursor
from adapters.replay.records import logged
from adapters.stores import Store
from adapters.stores.ledger import Ledger
from knowledge import STAGES, Record, from_json

CONFIG = small()
FREE = small(execute={"engine": "python", "mode": "free", "rate": 100.0})
MAPEK = (sys.executable, "-m", "mape")


@pytest.fixture
def log(here: Path) -> Path:
    """The folder of a run in lockstep."""
    (here / "out").mkdir()
    write_log(here / "out" / "log.sqlite", CONFIG)
    return here / "out"


def bodies(folder: Path) -> list[str]:
    with Store(folder / "log.sqlite", readonly=True) as store:
        return [str(store.body(0, number, stage)) for number, stage in places(CONFIG)]


def test_a_log_is_told_pass_by_pass_from_its_start(mapek: Mapek, log: Path) -> None:
    lines = mapek("log", log).out.splitlines()

    assert lines[0] == "--- start"
    assert lines[1].startswith("Plan      plan 0: epsilon 1.000, ")
    assert [line for line in lines if line.startswith("---")][1:] == [f"--- pass {n}" for n in range(1, 13)]
    assert [line.split()[0] for line in lines[2:]] == ["---", "Execute", "Monitor", "Analyze", "Plan"] * 12


def test_sentences_are_those_of_run(mapek: Mapek, log: Path) -> None:
    Path("small.json").write_text(CONFIG.to_json())
    shown = mapek("run", "small.json", "--show", "3:5", "--no-figures", "-q", "--out", "run").out.splitlines()

    assert mapek("log", log, "--pass", "3:5").out.splitlines() == shown[:15]


def test_json_lines_are_the_records_byte_for_byte(mapek: Mapek, log: Path) -> None:
    assert mapek("log", log, "--json").out.splitlines() == bodies(log)
    assert mapek("log", log / "log.sqlite", "--json").out.splitlines() == bodies(log)


@pytest.mark.parametrize(
    ("stage", "kind"), list(zip(("observation", "symptom", "request", "plan"), STAGES, strict=True))
)
def test_one_stage_of_some_passes_is_picked(mapek: Mapek, log: Path, stage: str, kind: type) -> None:
    found = [
        json.loads(line) for line in mapek("log", log, "--stage", stage, "--pass", "4:6", "--json").out.splitlines()
    ]

    assert [(one["schema"], one["pass"]) for one in found] == [(f"{kind.__name__}/1", number) for number in (4, 5, 6)]


def test_one_pass_is_picked(mapek: Mapek, log: Path) -> None:
    assert [line.split()[0] for line in mapek("log", log, "--pass", "7").out.splitlines()] == [
        "---", "Execute", "Monitor", "Analyze", "Plan",
    ]  # fmt: skip


def test_loops_are_told_one_after_the_other_and_named(mapek: Mapek, here: Path) -> None:
    write_log(here / "log.sqlite", small(episodes=3, loops=2))

    heads = [line for line in mapek("log", "log.sqlite").out.splitlines() if line.startswith("---")]
    assert heads == [f"--- loop {loop}, {at}" for loop in (0, 1) for at in ("start", "pass 1", "pass 2", "pass 3")]
    only = [json.loads(line)["loop"] for line in mapek("log", "log.sqlite", "--loop", 1, "--json").out.splitlines()]
    assert only == [1] * 13


def test_a_replaced_part_is_said_right_before_its_first_record(mapek: Mapek, here: Path) -> None:
    planned = [{"pass": 2, "part": "plan", "to": {"name": "morphin", "alpha": 0.2}}]
    live: list[tuple[int, str, dict[str, Any]]] = [
        (3, "monitor", {"name": "page_hinkley", "threshold": 1.0}),
        (4, "learner", {"name": "q_learning", "discount": 0.5}),
    ]
    write_log(here / "log.sqlite", small(swap=planned), live)

    lines = mapek("log", "log.sqlite").out.splitlines()

    at = [place for place, line in enumerate(lines) if line.startswith("Swap ")]
    assert [lines[place] for place in at] == [
        "Swap      pass 2: plan is now morphin (alpha = 0.2), with the state of the one before.",
        "Swap      pass 3: monitor is now page_hinkley (threshold = 1.0), with the state of the one before.",
        "Swap      pass 4: learner is now q_learning (discount = 0.5), and the Q-table goes on.",
    ]
    assert [lines[place + 1].split()[0] for place in at] == ["Plan", "Monitor", "Execute"]
    kept = [json.loads(line) for line in mapek("log", "log.sqlite", "--json").out.splitlines() if "swap" in line]
    assert [(one["swap"]["part"], one["swap"]["planned"]) for one in kept] == [
        ("plan", True), ("monitor", False), ("learner", False),
    ]  # fmt: skip


def test_plans_that_came_late_and_episodes_that_were_dropped_are_said(mapek: Mapek, here: Path) -> None:
    write_free_log(here / "log.sqlite", FREE, lag=2, dropped={4, 5, 9})

    lines = mapek("log", "log.sqlite").out.splitlines()
    seen = [line for line in lines if line.startswith("Execute ")]
    drops = [line for line in lines if "dropped" in line]

    assert "passes old" not in seen[0]
    assert seen[2].endswith("; the plan was 3 passes old.")
    assert drops == [
        "--- pass 4: dropped, driven while Knowledge took no records",
        "--- pass 5: dropped, driven while Knowledge took no records",
        "--- pass 9: dropped, driven while Knowledge took no records",
    ]
    assert [lines[lines.index(drop) + 1] for drop in drops[1:]] == ["--- pass 6", "--- pass 10"]
    kept = [json.loads(line) for line in mapek("log", "log.sqlite", "--json").out.splitlines()]
    assert [one["dropped"] for one in kept if "dropped" in one] == [
        {"loop": 0, "first": number, "last": number} for number in (4, 5, 9)
    ]
    assert mapek("log", "log.sqlite", "--pass", "4:5").out.splitlines() == drops[:2]


@pytest.fixture
def eventful(here: Path) -> Path:
    """A log of two loops, beside which something happened; each event with the pass that the run was in."""
    write_log(here / "log.sqlite", small(episodes=6, loops=2))
    with Store(here / "log.sqlite") as store:
        store.event("plan", "joined", "epoch 1", None, 0)
        store.event("monitor", "joined", "by a mapek that noted no pass")
        store.event("execute", "aborted", "episode 4 was broken off", 0, 4)
        store.event("plan", "joined", "epoch 2", None, 4)
        store.event("execute", "joined", "epoch 2", None, 4)
        store.event("execute", "aborted", "of another loop", 1, 5)
        store.event("monitor", "swap refused", "no part", None, 6)
        store.commit()
    return here / "log.sqlite"


def _words(line: str) -> str:
    return (
        " ".join(line.partition(" UTC, ")[2].split()[:2]).rstrip(":") if line.startswith("Event ") else line.split()[0]
    )


def test_events_stand_where_they_happened(mapek: Mapek, eventful: Path) -> None:
    assert "Event" not in mapek("log", eventful).out
    told = [_words(line) for line in mapek("log", eventful, "--events", "--loop", 0).out.splitlines()]

    whole = ["---", "Execute", "Monitor", "Analyze", "Plan"]
    assert told == [
        "plan joined", "monitor joined", "---", "Plan", *whole * 3,
        "execute aborted", "---", "Execute", "Monitor", "Analyze", "plan joined", "Plan",
        "execute joined", *whole, "---", "Execute", "monitor swap", "Monitor", "Analyze", "Plan",
    ]  # fmt: skip


def test_events_are_told_once_and_those_of_a_loop_beside_its_records(mapek: Mapek, eventful: Path) -> None:
    lines = mapek("log", eventful, "--events", "--json").out.splitlines()
    told = [(place, json.loads(line)["event"]) for place, line in enumerate(lines) if line.startswith('{"event"')]

    assert sorted(event["number"] for _, event in told) == [*range(1, 8)]
    (place,) = (place for place, event in told if event["loop"] == 1)
    seen = json.loads(lines[place + 1])
    assert (seen["schema"], seen["loop"], seen["pass"]) == ("Observation/1", 1, 5)
    assert set(told[0][1]) == {"number", "time", "role", "kind", "loop", "pass", "text"}


@pytest.mark.parametrize(
    ("options", "texts"),
    [
        (("--pass", "4"), ["episode 4 was broken off", "epoch 2", "epoch 2"]),
        (("--pass", "5"), ["of another loop"]),
        (("--pass", "5", "--loop", "0"), []),
        (("--pass", "1:3"), []),
        (("--loop", "1", "--pass", "4:6"), ["epoch 2", "epoch 2", "of another loop", "no part"]),
    ],
)
def test_events_are_told_where_they_are_wanted(
    mapek: Mapek, eventful: Path, options: tuple[str, ...], texts: list[str]
) -> None:
    lines = mapek("log", eventful, "--events", "--json", *options).out.splitlines()
    assert [json.loads(line)["event"]["text"] for line in lines if line.startswith('{"event"')] == texts


def test_an_event_of_no_loop_is_noted_with_the_pass_that_the_run_was_in(here: Path) -> None:
    write_log(here / "log.sqlite", CONFIG)
    with Store(here / "new.sqlite") as store:
        ledger = begin(store, CONFIG)
        ledger.note("plan", "joined", "at the start")
        for record in records_of(here / "log.sqlite")[:14]:  # plan 0, three passes, and one Observation
            take(ledger, record)
        ledger.note("plan", "joined", "in the fourth pass")
        ledger.note("execute", "aborted", "of a loop", 0, 9)
        assert [(event.text, event.pass_no) for event in store.events()] == [
            ("at the start", 0), ("in the fourth pass", 4), ("of a loop", 9),
        ]  # fmt: skip


@pytest.mark.parametrize("options", [(), ("--json",), ("--events",)])
def test_a_log_without_records_is_said_to_have_none(mapek: Mapek, here: Path, options: tuple[str, ...]) -> None:
    with Store(here / "log.sqlite") as store:
        begin(store, CONFIG)
        store.commit()

    outcome = mapek("log", "log.sqlite", *options)
    assert (outcome.code, outcome.out) == (1, "")
    assert "log.sqlite holds no record yet; --follow waits" in outcome.err


def test_passes_that_an_unfinished_log_does_not_reach_are_said_to_be_missing(mapek: Mapek, log: Path) -> None:
    with Store(log / "log.sqlite") as store:
        store._db.execute("DELETE FROM records WHERE pass > 5")
    reseal(log / "log.sqlite")

    outcome = mapek("log", log, "--pass", "7:9")
    assert (outcome.code, outcome.out) == (1, "")
    assert "holds no such record" in outcome.err


def test_an_unfinished_log_is_told_as_far_as_it_goes(mapek: Mapek, log: Path) -> None:
    for stage in (3, 2):
        change(log / "log.sqlite", "DELETE FROM records WHERE pass = 12 AND stage = ?", stage)

    assert mapek("log", log, "--json").out.splitlines() == bodies(log)[:-2]


@pytest.mark.parametrize(
    ("options", "code", "says"),
    [
        (("--pass", "1:13"), 2, "--pass 1:13 goes beyond the run's 12 episodes"),
        (("--loop", "1"), 2, "--loop 1: the run has loops 0 to 0"),
        (("--stage", "plans"), 2, "unknown --stage 'plans'"),
    ],
)
def test_what_the_log_cannot_have_is_refused(
    mapek: Mapek, log: Path, options: tuple[str, ...], code: int, says: str
) -> None:
    outcome = mapek("log", log, *options)
    assert (outcome.code, outcome.out) == (code, "")
    assert says in outcome.err


def test_what_is_no_log_is_said_with_what_has_one(mapek: Mapek, here: Path) -> None:
    goals = EXAMPLES / "frozen_lake.toml"
    assert mapek("run", goals, "--set", "episodes=2", "--no-figures", "-q", "--out", "run").code == 0
    (here / "empty").mkdir()
    (here / "text").write_text("dear diary, " * 100)

    tables = mapek("log", "run")
    assert tables.code == 1
    assert (
        "run has the tables of a run, and no log of its records: `mapek up` and `mapek serve` write one" in tables.err
    )
    assert "empty holds no run of ours" in mapek("log", "empty").err
    assert "there is no folder or file nowhere" in mapek("log", "nowhere").err
    assert "text cannot be opened as a log" in mapek("log", "text").err


# Following.


class Growing:
    """A log that another writes on whenever the reader has seen what there is."""

    def __init__(self, ledger: Ledger, records: list[Record], at_once: int) -> None:
        self._ledger = ledger
        self._records = deque(records)
        self._at_once = at_once

    def sleep(self, seconds: float) -> None:
        assert self._records, "the reader waits for more than there is"
        for _ in range(min(self._at_once, len(self._records))):
            take(self._ledger, self._records.popleft())
        self._ledger.commit()


def records_of(path: Path) -> list[Record]:
    with Store(path, readonly=True) as store:
        return [from_json(body) for _, _, body in logged(store, 0)]


@pytest.mark.parametrize("at_once", [1, 3, 50])
def test_follow_tells_what_comes_until_the_run_is_complete(
    mapek: Mapek, log: Path, monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    with Store(log / "growing.sqlite") as store:
        growing = Growing(begin(store, CONFIG), records_of(log / "log.sqlite"), at_once)
        monkeypatch.setattr("adapters.cli.log.time", growing)

        outcome = mapek("log", log / "growing.sqlite", "--follow", "--json")

    assert outcome.code == 0
    assert outcome.out.splitlines() == bodies(log)


def test_follow_misses_no_record_of_a_stage_that_lags_behind(
    mapek: Mapek, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_free_log(here / "log.sqlite", FREE, lag=0)
    records = records_of(here / "log.sqlite")
    late = sorted(records, key=lambda record: record.pass_no + 2 * STAGES.index(type(record)) * (record.pass_no > 0))
    with Store(here / "growing.sqlite") as store:
        monkeypatch.setattr("adapters.cli.log.time", Growing(begin(store, FREE), late, 3))

        outcome = mapek("log", "growing.sqlite", "--follow", "--json")

    found = [from_json(line) for line in outcome.out.splitlines()]
    assert len(found) == len(records)
    for kind in STAGES:
        assert [r for r in found if type(r) is kind] == [r for r in records if type(r) is kind]


def test_follow_ends_after_the_passes_that_are_wanted(mapek: Mapek, log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Store(log / "growing.sqlite") as store:
        monkeypatch.setattr("adapters.cli.log.time", Growing(begin(store, CONFIG), records_of(log / "log.sqlite"), 4))

        outcome = mapek("log", log / "growing.sqlite", "--follow", "--pass", "2:3", "--json")

    assert outcome.out.splitlines() == bodies(log)[5:13]


class Appearing:
    """A folder, and in it a log, that come into being while the reader waits."""

    def __init__(self, whole: Path, folder: Path) -> None:
        self._steps: deque[Callable[[], object]] = deque(
            [lambda: None, folder.mkdir, lambda: self._copy(whole, folder)]
        )

    @staticmethod
    def _copy(whole: Path, folder: Path) -> None:
        for one in (whole.with_suffix(".mark"), whole):
            shutil.copy(one, folder)

    def sleep(self, seconds: float) -> None:
        assert self._steps, "the reader waits for more than there is"
        self._steps.popleft()()


def test_follow_waits_for_a_folder_and_for_the_log_in_it(
    mapek: Mapek, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("adapters.cli.log.time", Appearing(log / "log.sqlite", log.parent / "later"))

    outcome = mapek("log", "later", "--follow", "--json")

    assert (outcome.code, outcome.err) == (0, "waiting for the log of later\n")
    assert outcome.out.splitlines() == bodies(log)


def test_follow_tells_what_happens_while_no_record_comes(
    mapek: Mapek, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Store(log / "growing.sqlite") as store:
        ledger = begin(store, CONFIG)
        records = records_of(log / "log.sqlite")
        for record in records[:-4]:
            take(ledger, record)
        ledger.commit()
        growing = Growing(ledger, records[-4:], 4)
        said: list[str] = []

        def sleep(seconds: float) -> None:
            if not said:
                said.append("first")
                ledger.note("plan", "joined", "epoch 2")
                ledger.commit()
            else:
                growing.sleep(seconds)

        monkeypatch.setattr("adapters.cli.log.time", SimpleNamespace(sleep=sleep))
        lines = mapek("log", log / "growing.sqlite", "--follow", "--json", "--events").out.splitlines()

    assert [place for place, line in enumerate(lines) if line.startswith('{"event"')] == [len(lines) - 5]


def test_ctrl_c_ends_following_with_130(log: Path) -> None:
    with Store(log / "growing.sqlite") as store:
        ledger = begin(store, CONFIG)
        for record in records_of(log / "log.sqlite")[:-8]:
            take(ledger, record)
        ledger.commit()
        command = [*MAPEK, "log", str(log / "growing.sqlite"), "--follow"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            for line in process.stdout:
                if line.startswith("Plan      plan 10:"):
                    break
            process.send_signal(signal.SIGINT)
            rest, complaint = process.communicate(timeout=60)

    assert (process.returncode, rest, complaint) == (130, "", "mapek: stopped.\n")


def test_a_reader_that_has_seen_enough_is_no_fault(here: Path) -> None:
    write_log(here / "log.sqlite", small(episodes=400))
    command = f'"{sys.executable}" -m mape log log.sqlite | head -1'

    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=60, check=False)

    assert (done.stdout, done.stderr) == ("--- start\n", "")


def test_memory_does_not_grow_with_the_log(here: Path) -> None:
    write_log(here / "log.sqlite", small(episodes=2000))
    with Store(here / "log.sqlite", readonly=True) as store:
        cursor = Cursor(store, 0, range(4), 0, 2000)
        tracemalloc.start()
        assert sum(1 for _ in cursor.read(over=True)) == 8001
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < os.stat(here / "log.sqlite").st_size / 5


def test_to_read_a_log_no_transport_is_loaded():
    script = "import sys, adapters.cli.log, adapters.cli.replay; print('zenoh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True).stdout == "False\n"
