"""One flipped bit, wherever on disk: it is told, or nothing of a result rests on it. Never is a result another one."""

import random
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from damaged_folders import CONFIG, QUIETLY, copied, hashes, logged, mapek
from replay_logs import small

from adapters.cli.main import main
from adapters.results import read_episodes
from adapters.results.chunk import run_chunk
from adapters.results.folder import RunFolder
from adapters.stores import Store, Swap
from mape.errors import ResultsError

SEED = 9


def flip(path: Path, bit: int) -> None:
    data = bytearray(path.read_bytes())
    data[bit // 8] ^= 1 << (bit % 8)
    path.write_bytes(data)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders of runs: logged, killed (with a -wal), chunked, and finished."""
    place = tmp_path_factory.mktemp("whole")
    for name in ("logged", "killed"):
        (place / name).mkdir()
        logged(place / name / "out", open_wal=name == "killed")
    with Store(place / "logged" / "out" / "log.sqlite") as store:
        store.keep_swap(Swap(0, 3, "plan.schedule", {"name": "geometric"}, False, True))
        store.event("plan", "note", "something that happened")
        store.commit()
    several = small(trials=4, episodes=20)
    (place / "small.json").write_text(several.to_json())
    (place / "chunked").mkdir()
    command = ["run", str(place / "small.json"), *QUIETLY, "--workers", "1", "--trace", "1:5"]
    with RunFolder(place / "chunked" / "out", "run", {"small": several}, (1, 5), command) as folder:
        for first in (0, 2):
            run_chunk(several.to_json(), first, 2, folder.chunk_stem("small", first, 2), (1, 5))
    (place / "finished").mkdir()
    assert main([*command, "--out", str(place / "finished" / "out")]) == 0
    return place


@pytest.fixture(scope="module")
def right(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[str, str]]:
    """What each of them comes to when it is left alone."""
    place = tmp_path_factory.mktemp("right")
    found = {}
    for name in ("logged", "killed", "chunked", "finished"):
        folder = copied(whole / name / "out", place / name)
        assert name == "finished" or mapek("resume", folder).code == 0
        assert mapek("verify", folder).code == 0
        found[name] = hashes(folder)
    return found


def told_or_harmless(folder: Path, name: str, right: dict[str, tuple[str, str]], place: str) -> str:
    """Hold a damaged folder to the promise; return whether it was told."""
    verified = mapek("verify", folder)
    assert verified.code in (0, 1), (place, verified)
    again = mapek("replay", folder, "-q", "--workers", "1") if name == "finished" else mapek("resume", folder)
    assert again.code in (0, 1), (place, again)
    for said in (verified, again):
        assert "Traceback" not in said.err, (place, said)
        assert said.code == 0 or said.err.startswith("mapek: ") or name == "finished", (place, said)
    if verified.code == 0:
        assert again.code == 0, (place, again)
    if again.code == 0:
        # What it does not read it cannot tell: then it comes to the same.
        assert hashes(folder) == right[name], place
    return "told" if verified.code else "harmless"


def flips(whole: Path, name: str, count: int) -> Iterator[tuple[Path, int]]:
    """Draw bits of a folder's files, each file as often as the next."""
    draw = random.Random(f"{SEED} {name}")
    folder = whole / name / "out"
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.stat().st_size]
    files = [path for path in files if path.name != "log.sqlite-shm"]  # which is made anew
    for at in range(count):
        path = files[at % len(files)]
        yield path.relative_to(folder), draw.randrange(8 * path.stat().st_size)


def hold(whole: Path, right: dict[str, tuple[str, str]], scratch: Path, name: str, count: int) -> None:
    tally = {"told": 0, "harmless": 0}
    for path, bit in flips(whole, name, count):
        folder = copied(whole / name / "out", scratch / "out")
        flip(folder / path, bit)
        tally[told_or_harmless(folder, name, right, f"{name}: {path}, bit {bit}")] += 1
    print(f"{name}, seed {SEED}: {tally}")
    assert tally["told"]


FOLDERS = ["logged", "killed", "chunked", "finished"]


@pytest.mark.parametrize("name", FOLDERS)
def test_a_flipped_bit_is_told_or_harmless(
    whole: Path, right: dict[str, tuple[str, str]], tmp_path: Path, name: str
) -> None:
    hold(whole, right, tmp_path, name, 8)


@pytest.mark.long
@pytest.mark.parametrize("name", FOLDERS)
def test_sixty_flipped_bits_are_told_or_harmless(
    whole: Path, right: dict[str, tuple[str, str]], tmp_path: Path, name: str
) -> None:
    hold(whole, right, tmp_path, name, 60)


KINDS = {
    "body": ("SELECT CAST(body AS BLOB) FROM records WHERE pass = 5 AND stage = 1", "Symptom 5 of loop 0"),
    "row": ("SELECT row FROM records WHERE pass = 7 AND stage = 3", "ChangePlan 7 of loop 0"),
    "the checksum of a record": ("SELECT sum FROM records WHERE pass = 7 AND stage = 0", "Observation 7 of loop 0"),
    "state": ("SELECT CAST(state AS BLOB) FROM snapshots", "in its table snapshots the row of loop 0, role execute"),
    "Q-table": ("SELECT body FROM q_tables", "in its table q_tables the row of sha256"),
    "config": ("SELECT CAST(value AS BLOB) FROM run WHERE name = 'config'", "in its table run the row of name config"),
    "swap": ("SELECT CAST(spec AS BLOB) FROM swaps", "in its table swaps the row of loop 0, pass 3"),
    "event": ("SELECT CAST(text AS BLOB) FROM events", "in its table events the row of number"),
    "total": ("SELECT total FROM seal", "its table seal"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_flipped_bit_of_each_kind_of_place_is_told_by_its_place(whole: Path, tmp_path: Path, kind: str) -> None:
    folder = copied(whole / "logged" / "out", tmp_path / "out")
    log = folder / "log.sqlite"
    query, named = KINDS[kind]
    with closing(sqlite3.connect(log)) as db:
        value = bytes(db.execute(query).fetchone()[0])
    data = log.read_bytes()
    # Somewhere in the value: there may be others that begin in the same way, and a long one is not in one piece.
    parts = [value[at : at + 24] for at in range(0, len(value), 24)]
    value = next(part for part in parts if data.count(part) == 1)
    flip(log, 8 * data.index(value) + random.Random(SEED).randrange(8 * len(value)))
    for command in ("verify", "resume", "replay", "log"):
        said = mapek(command, folder)
        assert (said.code, named in said.err) == (1, True), (command, said)


def test_a_column_and_a_q_table_of_a_finished_run_that_were_changed_are_told_by_who_reads_them(
    whole: Path, tmp_path: Path
) -> None:
    folder = copied(whole / "finished" / "out", tmp_path / "out")
    for name, column in (("episodes-small.npz", "return"), ("q_tables-small.npz", "q_1")):
        with np.load(folder / name) as archive:
            arrays = dict(archive)
        arrays[column][3] += 1.0
        np.savez(folder / name, **arrays)  # a whole archive, whose own checksums fit
        for command in ("verify", "replay"):
            said = mapek(command, folder)
            assert said.code == 1
            assert f"{name} was changed after it was written" in said.err
        if column == "return":
            with pytest.raises(ResultsError, match="was changed after it was written"):
                read_episodes(folder / name)
        shutil.copy(whole / "finished" / "out" / name, folder / name)
    assert mapek("verify", folder).code == 0


@pytest.mark.parametrize("endings", [(".rows",), (".npz",), (".json",), (".rows", ".npz"), (".rows", ".npz", ".json")])
def test_chunks_of_two_trials_that_were_swapped_are_told(whole: Path, tmp_path: Path, endings: tuple[str, ...]) -> None:
    folder = copied(whole / "chunked" / "out", tmp_path / "out")
    first, second = sorted((folder / "chunks" / "small").glob("*.json"))
    for ending in endings:
        one, other = first.with_suffix(ending), second.with_suffix(ending)
        one.rename(folder / "kept")
        other.rename(one)
        (folder / "kept").rename(other)
    for command in ("verify", "resume"):
        said = mapek(command, folder)
        assert said.code == 1
        assert "was changed after it was written" in said.err or "stands in the wrong place" in said.err
    assert not (folder / "result.json").exists()


def test_a_chunk_of_another_run_is_told(whole: Path, tmp_path: Path) -> None:
    folder = copied(whole / "chunked" / "out", tmp_path / "out")
    other = small(trials=4, episodes=20, seed=7)
    stem = sorted((folder / "chunks" / "small").glob("*.json"))[0].with_suffix("")
    for ending in (".json", ".rows", ".npz"):
        stem.with_suffix(ending).unlink()
    run_chunk(other.to_json(), 0, 2, str(stem), (1, 5))
    for command in ("verify", "resume"):
        assert "stands in the wrong place" in mapek(command, folder).err


def test_verify_says_what_it_held_and_what_has_no_checksum(whole: Path, tmp_path: Path) -> None:
    finished = mapek("verify", whole / "finished" / "out").out
    assert "no records: `mapek run` keeps none" in finished
    folder = copied(whole / "logged" / "out", tmp_path / "out")
    (folder / "logs").mkdir()
    (folder / "logs" / "plan.log").write_text("hello")
    said = mapek("verify", folder)
    assert f"log.sqlite: {4 * CONFIG.episodes + 1} records, 1 states, 1 Q-tables" in said.out
    assert "logs/plan.log: has no checksum" in said.out
    assert "no result: the run is unfinished" in said.out


def test_a_finished_run_that_lost_its_log_is_told(whole: Path, tmp_path: Path) -> None:
    folder = copied(whole / "logged" / "out", tmp_path / "out")
    assert mapek("resume", folder).code == 0
    (folder / "log.sqlite").unlink()
    for command in ("verify", "replay", "log"):
        said = mapek(command, folder)
        assert (said.code, "log.sqlite is gone or empty" in said.err) == (1, True), (command, said)


@pytest.mark.parametrize("name", ["manifest.json", "result.json", "config-small.json"])
def test_json_that_was_changed_is_told(whole: Path, tmp_path: Path, name: str) -> None:
    folder = copied(whole / "finished" / "out", tmp_path / "out")
    path = folder / name
    text = path.read_text()
    assert '"seed": 0' in text
    path.write_text(text.replace('"seed": 0', '"seed": 1', 1))
    said = mapek("verify", folder)
    assert (said.code, f"{path} was changed after it was written" in said.err) == (1, True), said
    if name != "config-small.json":  # which nobody else reads
        assert mapek("replay", folder, "-q").code == 1


def test_a_folder_of_an_older_layout_is_refused_with_the_version_that_reads_it(whole: Path, tmp_path: Path) -> None:
    folder = copied(whole / "chunked" / "out", tmp_path / "out")
    text = (folder / "manifest.json").read_text()
    (folder / "manifest.json").write_text(text.replace('"format": 3', '"format": 2', 1))
    for command in ("verify", "resume", "replay"):
        assert "mapek 0.2.0.dev0 reads it" in mapek(command, folder).err
