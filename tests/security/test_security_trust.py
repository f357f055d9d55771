"""A folder that somebody else may have written runs nothing of theirs before one has said yes to a list of it."""

import os
import pty
import shutil
import subprocess
import sys
import threading

import pytest
from real_processes import SHORT, write_config

from adapters.cli.main import main
from adapters.cli.terminal import cleaned
from adapters.results import RunFolder
from adapters.results.files import write_sealed
from adapters.results.folder import read_manifest
from adapters.stores import Store
from adapters.stores.sqlite_store import Swap
from mape import load

MARKED = """
from pathlib import Path

import gymnasium

from mape.monitor.page_hinkley import PageHinkley

Path(__file__).with_name("mark").touch()


class Own(PageHinkley):
    pass


gymnasium.register("Theirs-v0", "gymnasium.envs.toy_text.frozen_lake:FrozenLakeEnv", max_episode_steps=20)
"""
SYSTEM = {"id": "mapek/Gridworld-v0"}
TABLE = {"name": "small", "episodes": 5, "system": SYSTEM, "monitor": {"detectors": ["page_hinkley"]}}
OF_A_PART = {**TABLE, "monitor": {"detectors": ["strangers:Own"]}}
OF_A_SYSTEM = {**TABLE, "system": {"id": "strangers:Theirs-v0"}}
OF_A_SWAP = {**TABLE, "swap": [{"pass": 3, "part": "monitor", "to": "strangers:Own"}]}


@pytest.fixture
def here(own_folder):
    (own_folder / "strangers.py").write_text(MARKED)
    return own_folder


def mapek(capsys, *arguments):
    capsys.readouterr()
    code = main([str(argument) for argument in arguments])
    return code, capsys.readouterr().err


def begun(here, table, command="run"):
    """A folder of a run that was stopped before its first trial."""
    config = write_config(here, table)
    options = ["--workers", "1"] if command == "run" else []
    RunFolder(here / "out", command, {"small": load(config)}, None, [command, str(config), *SHORT, *options]).close()
    (here / "mark").unlink(missing_ok=True)
    return here / "out"


def finished(here, table, command="run"):
    """The folder of a run that another process has made."""
    config = write_config(here, table)
    whole = [sys.executable, "-m", "mape", command, str(config), "--out", "out", *SHORT]
    subprocess.run(whole, cwd=here, check=True, timeout=300)
    (here / "mark").unlink(missing_ok=True)
    return here / "out"


def open_to_others(folder):
    folder.chmod(0o777)


def given_by_another(folder):
    if os.getuid() != 0:
        pytest.skip("only root can give a folder away")
    os.chown(folder / "manifest.json", 65534, 65534)


WAYS = [open_to_others, given_by_another]


@pytest.mark.parametrize("table", [OF_A_PART, OF_A_SYSTEM, OF_A_SWAP], ids=["part", "system", "swap"])
@pytest.mark.parametrize("way", WAYS)
def test_resume_lists_what_a_foreign_folder_runs_and_imports_nothing(here, capsys, way, table):
    folder = begun(here, table)
    way(folder)
    code, said = mapek(capsys, "resume", folder)
    assert code == 2
    assert all(word in said for word in ("'strangers'", "config.json", str(here), "--trust"))
    assert not (here / "mark").exists()


@pytest.mark.parametrize("command", ["run", pytest.param("up", marks=pytest.mark.long)])
def test_replay_lists_what_a_foreign_folder_runs_and_imports_nothing(here, capsys, command):
    folder = finished(here, OF_A_PART, command)
    open_to_others(folder)
    names = [folder, folder / "log.sqlite"] if command == "up" else [folder]
    (folder / "result.json").chmod(0o666)
    if command == "up":
        (folder / "log.sqlite").chmod(0o666)
    for name in names:
        code, said = mapek(capsys, "replay", name)
        assert code == 2
        assert "'strangers'" in said
        assert "--trust" in said
        assert not (here / "mark").exists()
    code, said = mapek(capsys, "replay", folder, "--trust", "-q", *(["--workers", 1] if command == "run" else []))
    assert (code, (here / "mark").exists()) == (0, True), said


def test_verify_and_log_import_nothing(here, capsys):
    folder = finished(here, {**OF_A_PART, **OF_A_SWAP}, "up")
    open_to_others(folder)
    assert mapek(capsys, "verify", folder)[0] == 0
    assert mapek(capsys, "log", folder)[0] == 0
    assert not (here / "mark").exists()


@pytest.mark.parametrize("command", ["run", pytest.param("up", marks=pytest.mark.long)])
def test_who_continues_a_foreign_folder_by_out_is_asked_too(here, capsys, command):
    folder = begun(here, OF_A_PART, command)
    (folder / "manifest.json").chmod(0o666)
    code, said = mapek(capsys, command, "config.json", "--out", folder, *SHORT)
    assert code == 2
    assert "'strangers'" in said
    assert not (here / "mark").exists()
    assert mapek(capsys, command, "config.json", "--out", folder, "--trust", *SHORT)[0] == 0


def test_a_part_that_a_log_says_was_swapped_in_is_listed(here, capsys):
    folder = finished(here, TABLE, "up")
    with Store(folder / "log.sqlite") as store:
        store.keep_swap(Swap(0, 3, "monitor", {"name": "strangers:Own"}, False, False))
        store.commit()
    open_to_others(folder)
    code, said = mapek(capsys, "replay", folder)
    assert code == 2
    assert "'strangers'" in said
    assert not (here / "mark").exists()


def test_a_package_around_a_module_whose_source_is_to_be_compared_is_listed(here, capsys):
    folder = begun(here, TABLE)
    (here / "around").mkdir()
    (here / "around" / "__init__.py").write_text(MARKED.replace('name("mark")', 'name("mark").with_name("mark")'))
    manifest = read_manifest(folder)
    write_sealed(folder / "manifest.json", {**manifest, "modules": {"around.inner": "0" * 64}})
    open_to_others(folder)
    code, said = mapek(capsys, "run", "config.json", "--out", folder, *SHORT)
    assert code == 2
    assert "'around.inner'" in said
    assert not (here / "around" / "mark").exists()


def test_a_link_that_somebody_else_made_is_theirs(here, capsys):
    if os.getuid() != 0:
        pytest.skip("only root can give a link away")
    folder = finished(here, OF_A_PART)
    link = here / "link"
    link.symlink_to(folder)
    os.chown(link, 65534, 65534, follow_symlinks=False)
    assert mapek(capsys, "replay", link)[0] == 2
    assert not (here / "mark").exists()


def test_nothing_is_asked_of_ones_own_folder_nor_of_one_that_runs_nothing_of_a_strangers(here, capsys):
    own = begun(here, OF_A_PART)
    assert mapek(capsys, "resume", own, "--workers", 1)[0] == 0
    assert mapek(capsys, "replay", own, "--workers", 1)[0] == 0
    shutil.rmtree(own)
    ready_made = begun(here, TABLE)
    open_to_others(ready_made)
    assert mapek(capsys, "run", "config.json", "--out", ready_made, *SHORT)[0] == 0
    assert mapek(capsys, "replay", ready_made)[0] == 0


def test_a_foreign_folder_does_not_choose_where_its_run_listens(here, capsys):
    config = write_config(here, TABLE)
    command = ["up", str(config), "--listen", "tcp/0.0.0.0:7447", "--insecure", "--trust"]
    RunFolder(here / "out", "up", {"small": load(config)}, None, command).close()
    open_to_others(here / "out")
    code, said = mapek(capsys, "resume", here / "out")
    assert code == 2
    assert "--listen tcp/0.0.0.0:7447 --insecure" in said


@pytest.mark.parametrize("answer", ["y", "", "n"])
def test_at_a_terminal_it_is_asked_for(here, answer):
    folder = begun(here, OF_A_PART)
    open_to_others(folder)
    said, code = at_a_terminal(here, answer, "resume", str(folder), "--workers", "1", "-q")
    assert "'strangers'" in said
    assert (code, (here / "mark").exists(), (folder / "result.json").exists()) == (
        (0, True, True) if answer == "y" else (2, False, False)
    ), said


def at_a_terminal(here, answer, *arguments):
    """What a command says on a terminal, where it is answered when it asks."""
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "mape", *arguments]
    process = subprocess.Popen(command, cwd=here, stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    deadline = threading.Timer(120, process.kill)
    deadline.start()
    said, answered = b"", False
    try:
        while True:
            try:
                said += os.read(ours, 65536)
            except OSError:  # the end of the process
                break
            if not answered and b"[y/N]" in said:
                answered = True
                os.write(ours, f"{answer}\n".encode())
    finally:
        deadline.cancel()
        os.close(ours)
        code = process.wait(60)
    return said.decode(), code


def test_names_in_the_list_are_cleaned(here, capsys):
    folder = begun(here, TABLE)
    manifest = read_manifest(folder)
    write_sealed(folder / "manifest.json", {**manifest, "modules": {"\x1b[2Jhidden": "0"}, "cwd": "\x1b[8m/tmp"})
    open_to_others(folder)
    code, said = mapek(capsys, "resume", folder)
    assert code == 2
    assert "\x1b" not in said
    assert cleaned("\x1b[8m/tmp") in said
