"""What was acknowledged is there after the process was killed, and after the disk was full."""

import random
import signal
import sqlite3
import subprocess
import sys
import textwrap
from contextlib import closing
from pathlib import Path

from bus_records import new_ledger, new_log, run_of

from adapters.stores import Store
from knowledge import ChangePlan, from_json

HERE = Path(__file__).parents[1] / "buses"

APPENDS = """
    import sys, resource, signal
    from pathlib import Path
    sys.path.append({here!r})
    from bus_records import new_ledger, run_of
    from knowledge import STAGES, to_json
    from mape.errors import ResultsError

    ledger = new_ledger(Path({path!r}))
    {before}
    records = run_of({passes})
    done = len(ledger.since(0, dict.fromkeys(range(4), 0), 10**6))
    try:
        for place in range(done, len(records)):
            record = records[place]
            assert ledger.take(0, STAGES.index(type(record)), to_json(record)).ack.value == "ok"
            ledger.commit()
            print(place, flush=True)
    except ResultsError as error:
        print(error, flush=True)
        sys.exit(3)
"""


def start(path, passes, before=""):
    program = textwrap.dedent(APPENDS.format(here=str(HERE), path=str(path), passes=passes, before=before))
    return subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def check(path, printed):
    """Hold the file to what was acknowledged; return how many records it has."""
    with closing(sqlite3.connect(path)) as db:
        assert db.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    with Store(path, readonly=True) as store:
        found = [from_json(body) for _, _, body in store.since(0, dict.fromkeys(range(4), 0), 10**6)]
    assert len(found) > printed, f"{printed} was acknowledged, and there are {len(found)} records"
    assert found == run_of(found[-1].pass_no)[: len(found)]
    return len(found)


def test_nothing_that_was_acknowledged_is_missing_after_kill_9(tmp_path):
    path, draw, printed = tmp_path / "log.sqlite", random.Random(9), -1
    for _ in range(6):
        with start(path, 10_000) as process:
            for _ in range(draw.randrange(1, 200)):
                printed = int(process.stdout.readline())
            process.kill()
            # What it said before it died was said after the commit, whoever read it when.
            rest, err = process.communicate(timeout=60)
            assert process.returncode == -signal.SIGKILL, err
            # Its first line may be the end of one that was read ahead, its last one the beginning of another.
            whole = [line for line in rest.splitlines(keepends=True)[1:] if line.endswith("\n")]
            printed = max([printed, *map(int, whole)])
        count = check(path, printed)
    ledger, log = new_ledger(path), new_log()
    for record in run_of(count)[:count]:
        log.append(record)
    assert (ledger.sha256(0), ledger.last(0)[3]) == (log.sha256(), log.passes)
    ledger.store.close()


def test_a_full_disk_is_said_so_and_what_was_acknowledged_before_is_kept(tmp_path):
    path = tmp_path / "log.sqlite"
    limit = """signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))"""
    process = start(path, 10_000, limit)
    out, err = process.communicate(timeout=60)
    *numbers, sentence = out.splitlines()
    assert process.returncode == 3, err
    assert "log.sqlite cannot be written: " in sentence
    assert "What was acknowledged before is kept; make room, and go on with `mapek resume`." in sentence
    count = check(path, int(numbers[-1]))
    # With room again it is gone on with.
    with start(path, count // 4 + 3) as process:
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert int(out.splitlines()[0]) == count
    with Store(path, readonly=True) as store:
        assert isinstance(from_json(store.body(0, count // 4 + 3, 3)), ChangePlan)
