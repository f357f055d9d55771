"""Where mapek cannot run, each command says so in one sentence, which names what is wrong, where, and the way out."""

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from wheel_of_mapek import ROOT, typed

COMMANDS = [
    ("--version",),
    ("--help",),
    ("list",),
    ("run", "frozen_lake"),
    ("swap", "plan", "q_learning", "--connect", "tcp/a:1"),
]
WINDOWS = (
    "import os, signal; sys.platform = 'win32'; sys.modules['fcntl'] = None; "
    "del os.getuid, signal.pthread_sigmask, signal.SIGKILL"
)


def refused(done, *says):
    assert done.returncode == 1, done.stdout + done.stderr
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("mapek: ")
    assert [part for part in says if part not in line] == [], line


def install_another(site, files, name="PyMAPE", version="0.1.0"):
    """Put another project's files among ours, as pip does: in place, with a RECORD of its own."""
    about = site / f"{name}-{version}.dist-info"
    about.mkdir()
    (about / "RECORD").write_text("".join(f"{path},,\n" for path in files))
    for path, text in files.items():
        (site / path).write_text(text)


@pytest.mark.parametrize("arguments", COMMANDS, ids=" ".join)
def test_a_package_that_was_overwritten_by_another_project_is_named_by_every_command(site, empty, arguments):
    install_another(site, {"mape/__init__.py": "import fastapi_of_another_project\n", "mape/knowledge.py": ""})
    refused(typed(site, *arguments, cwd=empty), f"mape/__init__.py in {site}", "PyMAPE 0.1.0", "virtual environment")


@pytest.mark.parametrize("package", ["adapters", "knowledge", "managed_systems", "mape"])
def test_whichever_package_it_is(site, empty, package):
    install_another(site, {f"{package}/__init__.py": ""}, "others", "7")
    refused(typed(site, "list", cwd=empty), f"{package}/__init__.py in {site}", "others 7")


def test_content_of_the_same_length_is_told_by_its_hash(site, empty):
    init = site / "mape" / "__init__.py"
    init.write_bytes(b"#" * init.stat().st_size)
    refused(typed(site, "list", cwd=empty), f"mape/__init__.py in {site}", "SHA-256")


def test_what_another_project_adds_beside_ours_is_in_nobodys_way(site, empty):
    install_another(site, {"mape/theirs.py": "import nowhere_at_all\n"})
    assert typed(site, "--version", cwd=empty).returncode == 0


@pytest.mark.parametrize("path", ["mape/config.py", "adapters/cli/list.py", "knowledge/__init__.py"])
@pytest.mark.parametrize("damage", [Path.unlink, lambda path: path.write_text("x = (")], ids=["gone", "cut short"])
def test_a_damaged_installation_is_told_by_the_file(site, empty, path, damage):
    damage(site / path)
    refused(typed(site, "list", cwd=empty), f"{path} in {site}", "install it here again")


def test_a_folder_of_a_packages_name_in_its_place_is_told(site, empty):
    (record,) = site.glob("mapek-*.dist-info/RECORD")
    record.unlink()
    shutil.rmtree(site / "knowledge")
    (site / "knowledge").mkdir()
    said = (str(site / "knowledge"), "'knowledge'", "virtual environment")
    # Of this checkout's own, which comes later on the path, no half is taken.
    refused(
        typed(site, "list", cwd=empty, before="sys.meta_path[:] = [f for f in sys.meta_path if isinstance(f, type)]"),
        *said,
    )


def test_another_projects_package_before_ours_on_the_path_is_told(site, empty):
    theirs = empty / "knowledge" / "__init__.py"
    theirs.parent.mkdir()
    theirs.write_text("import nowhere_at_all")
    refused(typed(site, "list", cwd=empty, path=[empty]), "'knowledge'", f"at {theirs}", "PYTHONPATH")


def test_a_module_that_is_gone_is_told_where_nothing_is_written_down_of_the_installation(site, empty):
    (record,) = site.glob("mapek-*.dist-info/RECORD")
    record.unlink()
    (site / "adapters" / "cli" / "list.py").unlink()
    refused(typed(site, "list", cwd=empty), "'adapters.cli.list'", "install it here again")


def test_an_example_that_was_changed_in_place_is_no_damage(site, empty):
    with open(site / "mape" / "examples" / "frozen_lake.toml", "a") as example:
        example.write("# tried with another seed\n")
    assert typed(site, "--version", cwd=empty).returncode == 0


@pytest.mark.parametrize("package", ["numpy", "pydantic", "tqdm", "gymnasium"])
def test_a_package_that_is_needed_and_missing_is_named(site, empty, package):
    done = typed(site, "run", "frozen_lake", cwd=empty, before=f"sys.modules[{package!r}] = None")
    refused(done, f"'{package}'", "not installed", "pip check")
    assert list(empty.iterdir()) == []


def test_a_package_of_another_version_is_told_by_what_it_lacks(site, empty):
    (empty / "pydantic.py").write_text("")
    done = typed(site, "run", "frozen_lake", cwd=empty, path=[empty])
    refused(done, "cannot import name", "pydantic.py", "pip check")


@pytest.mark.parametrize("arguments", [line for line in COMMANDS if line[0][0] != "-"], ids=" ".join)
def test_windows_is_told_in_a_sentence_by_every_command(site, empty, arguments):
    done = typed(site, *arguments, cwd=empty, before=WINDOWS)
    refused(done, "Windows does not have", "fcntl", "os.getuid", "signal.pthread_sigmask", "WSL")


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("--help",), 0, "usage: mapek"),
        (("run", "--help"), 0, "usage: mapek run"),
        ((), 2, "usage: mapek"),
        (("--version",), 0, "numba "),
    ],
)
def test_help_and_versions_are_there_on_windows(site, empty, arguments, code, says):
    done = typed(site, *arguments, cwd=empty, before=WINDOWS)
    assert (done.returncode, done.stderr) == (code, "")
    assert says in done.stdout


def test_a_system_without_a_part_of_posix_is_told_by_its_name(site, empty):
    before = "import signal; sys.platform = 'emscripten'; del signal.pthread_sigmask"
    done = typed(site, "list", cwd=empty, before=before)
    refused(done, "emscripten", "pthread_sigmask", "Linux")
    assert "fcntl" not in done.stderr


def test_an_older_python_reads_the_front_door_and_is_told(site, empty):
    ast.parse((ROOT / "mapek.py").read_text(encoding="utf-8"), feature_version=(3, 8))
    older = "import platform; sys.version_info = (3, 9, 1, 'final', 0); sys.version = '3.9.1 (of old)'"
    refused(typed(site, "list", cwd=empty, before=older), "3.11 or newer", "3.9.1", sys.executable)


def test_the_front_door_alone_loads_nothing_of_ours_nor_of_others(site, empty):
    code = (
        "import sys, mapek; loaded = {name.partition('.')[0] for name in sys.modules};"
        "print(sorted(loaded - set(sys.stdlib_module_names) - {'__main__'}))"
    )
    done = subprocess.run(
        [sys.executable, "-S", "-c", code], cwd=site, capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == "['mapek']"


def test_every_package_says_that_it_is_typed(site):
    assert [(site / name / "py.typed").exists() for name in ("adapters", "knowledge", "managed_systems", "mape")] == [
        True
    ] * 4
