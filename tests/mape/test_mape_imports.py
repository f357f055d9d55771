"""Arrows point one way, and a package's `__all__` is what it offers."""

import ast
import importlib
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import adapters
import knowledge
import managed_systems
import mape

OURS = {"adapters", "knowledge", "managed_systems", "mape"}
OUTSIDE = {"zenoh", "gymnasium", "matplotlib", "scipy", "river", "tqdm"}
FORBIDDEN = {
    knowledge: (OUTSIDE | OURS | {"mapek"}) - {"knowledge"},
    mape: OUTSIDE | {"adapters", "managed_systems", "mapek"},
    managed_systems: (OUTSIDE | OURS | {"mapek"}) - {"gymnasium", "managed_systems"},
    adapters: {"mapek"},
}
EXCEPTION = ("mape/__main__.py", "mapek")
PACKAGES = [
    "knowledge", "managed_systems", "mape", "mape.monitor", "mape.analyze", "mape.plan", "mape.execute",
    "adapters.systems",
]  # fmt: skip


def files_of(package):
    folder = Path(package.__file__).parent
    return [(path.relative_to(folder.parent).as_posix(), path) for path in sorted(folder.rglob("*.py"))]


def imported(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            yield node.module.partition(".")[0]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            yield from (a.value.partition(".")[0] for a in node.args if isinstance(a, ast.Constant))


@pytest.mark.parametrize("package", FORBIDDEN, ids=lambda package: package.__name__)
def test_a_package_imports_nothing_that_it_must_not_know_at_any_level(package):
    files = files_of(package)
    assert len(files) >= 5
    found = {(name, module) for name, path in files for module in imported(path) if module in FORBIDDEN[package]}
    assert found - {EXCEPTION} == set()


def test_only_the_command_line_entry_leads_from_the_loop_to_the_front_door():
    assert EXCEPTION[1] in set(imported(Path(mape.__file__).parent / "__main__.py"))


def test_running_the_loops_modules_loads_no_environment_and_no_transport():
    script = (
        "import sys, mape.loop, mape.trials, mape.testing, mape.config, knowledge;"
        f"print(sorted({(OUTSIDE | OURS) - {'mape', 'knowledge'}!r} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_importing_the_package_alone_loads_neither_numpy_nor_pydantic():
    script = "import sys, mape; print(sorted({'numpy', 'pydantic', 'numba'} & set(sys.modules)), mape.__version__)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]", mape.__version__]


@pytest.mark.parametrize("name", PACKAGES)
def test_all_names_what_a_package_offers_and_nothing_else(name):
    module = importlib.import_module(name)
    exported = module.__all__
    assert len(set(exported)) == len(exported)
    for public in exported:
        assert getattr(module, public) is not None
    in_sight = {
        public
        for public, value in vars(module).items()
        if not public.startswith("_")
        and (inspect.isclass(value) or inspect.isfunction(value))
        and value.__module__.partition(".")[0] in OURS
    }
    assert in_sight <= set(exported)


def test_the_lazy_homes_of_the_loops_names_are_their_homes():
    homes = {name: home for home, names in mape._HOMES.items() for name in names}
    assert sorted(homes) == sorted(mape.__all__)
    for name, home in homes.items():
        assert getattr(mape, name) is getattr(importlib.import_module(home), name)


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'Lopo'"):
        mape.Lopo  # noqa: B018
