import json
import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from mape_runs import GRID, config, hashes, loop_of

from mape.compose import Composed, specialise
from mape.errors import ConfigError
from mape.execute.rules import alpha_star, expected_value, max_value
from mape.testing.learners import probe

HELPER = "def half(x):\n    return x / 2.0\n"
RULE = "import math\nfrom a_helper import half\n\n\ndef rule(x):\n    return math.exp(half(x))\n"
TEMPLATE = "def template(x):\n    return rule(x) + 1.0\n"
RUN = """
import json
from numba.core import event
from a_rule import rule
from a_template import template
from mape.compose import Composed, specialise

compiled = event.RecordingListener()
event.register("numba:compile", compiled)
function = specialise(Composed(template, {"rule": rule}).compiled(), (3.0,), "it")
print(json.dumps([function(3.0), len(compiled.buffer)]))
"""


def fresh_process(folder, text, **environment):
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(text)],
        cwd=folder,
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]),
            **environment,
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_second_process_compiles_nothing_and_an_edited_rule_is_compiled_anew(tmp_path):
    for name, text in (("a_helper", HELPER), ("a_rule", RULE), ("a_template", TEMPLATE)):
        (tmp_path / f"{name}.py").write_text(text)
    cache = tmp_path / "cache"

    def run():
        value, events = json.loads(fresh_process(tmp_path, RUN, MAPEK_CACHE=str(cache), PYTHONDONTWRITEBYTECODE="1"))
        return value, events > 0

    def written():
        return {path: path.stat().st_mtime_ns for path in cache.rglob("*.nb?")}

    first = np.exp(1.5) + 1.0
    assert run() == (pytest.approx(first, rel=1e-15), True)
    files = written()
    assert files
    assert run() == (pytest.approx(first, rel=1e-15), False)
    assert written() == files
    (tmp_path / "a_helper.py").write_text(HELPER.replace("2.0", "3.0"))
    assert run() == (pytest.approx(np.e + 1.0, rel=1e-15), True)
    (tmp_path / "a_helper.py").write_text(HELPER)
    assert run() == (pytest.approx(first, rel=1e-15), False)


def test_a_second_process_runs_whole_episodes_without_compiling(tmp_path):
    loop = loop_of(config())  # this process compiles, where nobody has before
    loop.run(3)
    text = f"""
        from numba.core import event
        from adapters.systems import make_system
        from mape import compose
        from mape.config import from_table
        from mape.loop import Loop

        compiled, told = event.RecordingListener(), []
        event.register("numba:compile", compiled)
        compose.on_compile.append(told.append)
        chosen = from_table({GRID!r})
        loop = Loop(chosen, make_system(chosen.system))
        loop.run(3)
        assert loop.execute.compiled
        print(len(compiled.buffer), told, loop.log.sha256(), loop.execute.q_table.sha256())
    """
    assert fresh_process(tmp_path, text).split() == ["0", "[]", *hashes(loop)]


@pytest.mark.parametrize("value", [max_value, expected_value])
def test_plain_and_compiled_give_the_same_bits(value):
    composed = Composed(probe, {"value": value, "step_size": alpha_star})

    def inputs():
        rng = np.random.default_rng(7)
        rates = np.column_stack([rng.random(500), rng.random(500), rng.random(500) * 700.0])
        states, errors = rng.integers(0, 9, 500), rng.normal(0.0, 300.0, 500)
        return (rng.normal(size=(4, 9)), np.array([3, 1, 0]), states, 0.3, errors, rates, np.empty(500), np.empty(500))

    plain, compiled = inputs(), inputs()
    composed.python()(*plain)
    specialise(composed.compiled(), compiled, "it")(*compiled)
    assert plain[6].tobytes() == compiled[6].tobytes()
    assert plain[7].tobytes() == compiled[7].tobytes()
    assert len(set(plain[7].tolist())) > 400


def outer():
    def inner(x):
        return x

    return inner


def plus_one(x):
    return rule(x) + 1  # noqa: F821


@pytest.mark.parametrize("rule", [outer(), lambda x: x, abs], ids=["inner", "lambda", "built in"])
def test_plain_python_takes_any_rule(rule):
    assert Composed(plus_one, {"rule": rule}).python()(2) == 3


@pytest.mark.parametrize("rule", [outer(), lambda x: x], ids=["inner", "lambda"])
def test_a_rule_that_no_module_could_import_is_refused_with_the_way_out(rule):
    with pytest.raises(ConfigError, match=r"cannot be compiled: a rule is a module-level function.*engine 'python'"):
        Composed(plus_one, {"rule": rule}).compiled()


def test_binding_leaves_the_template_as_it_is():
    Composed(plus_one, {"rule": abs}).python()
    with pytest.raises(NameError):
        plus_one(1)


def test_a_constant_that_is_imported_and_edited_is_seen(tmp_path):
    (tmp_path / "a_constant.py").write_text("STEP = 1.0\nTABLE = (1, 2)\n")
    (tmp_path / "a_rule.py").write_text(
        "from a_constant import STEP, TABLE\n\n\ndef rule(x):\n    return x + STEP + TABLE[0]\n"
    )
    (tmp_path / "a_template.py").write_text(TEMPLATE)
    assert fresh_process(tmp_path, RUN).split()[0].strip("[,") == "6.0"
    (tmp_path / "a_constant.py").write_text("STEP = 50.0\nTABLE = (1, 2)\n")
    assert fresh_process(tmp_path, RUN).split()[0].strip("[,") == "55.0"
