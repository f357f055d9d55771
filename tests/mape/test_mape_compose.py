import json
import os
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path

import composed_rules
import numpy as np
import pytest
from composed_rules import below, both, less, root, scaled
from mape_runs import GRID, config, hashes, loop_of
from numba import njit

from mape.compose import Composed, cache_folder, specialise
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


FOUND = """
import numpy as np

STEP, OF_MODULE, OF_DECORATOR = 1.0, 2.0, 3.0
TABLES = (np.arange(3000.0), np.arange(6.0).reshape(2, 3))
"""
LOOKED_INTO = """
import numba
from a_constant import OF_MODULE
from a_helper import half

halved = numba.njit(half)
"""
DECORATOR = """
import functools


def plus(number):
    def decorated(rule):
        @functools.wraps(rule)
        def inner(x):
            return half(x) + number

        return inner

    return decorated


from a_helper import half
"""
FINDING = """
import a_module
from a_constant import OF_DECORATOR, STEP, TABLES
from a_decorator import plus


@plus(OF_DECORATOR)
def decorated(x):
    return x


def with_default(x, step=STEP):
    return x + step


def rule(x):
    tables = TABLES[0][1500] + TABLES[1][1, 0]
    return decorated(x) + with_default(x) + a_module.OF_MODULE + a_module.halved(x) + tables
"""


@pytest.mark.long
def test_all_that_rules_find_beside_their_arguments_is_seen_when_it_is_edited(tmp_path):
    texts = {
        "a_helper": HELPER, "a_constant": FOUND, "a_module": LOOKED_INTO, "a_decorator": DECORATOR, "a_rule": FINDING,
        "a_template": TEMPLATE,
    }  # fmt: skip

    def run(edited="a_rule", old="", new=""):
        for name, text in texts.items():
            (tmp_path / f"{name}.py").write_text(text.replace(old, new) if name == edited else text)
        text = fresh_process(tmp_path, RUN, MAPEK_CACHE=str(tmp_path / "cache"), PYTHONDONTWRITEBYTECODE="1")
        return json.loads(text)[0]

    first = run()
    assert first == (1.5 + 3.0) + (3.0 + 1.0) + 2.0 + 1.5 + (1500.0 + 3.0) + 1.0
    assert run("a_constant", "STEP, OF_MODULE, OF_DECORATOR = 1.0", "STEP, OF_MODULE, OF_DECORATOR = 9.0") == first + 8
    assert run("a_constant", "= 1.0, 2.0", "= 1.0, 9.0") == first + 7.0
    assert run("a_constant", "2.0, 3.0", "2.0, 9.0") == first + 6.0
    assert run("a_constant", "(3000.0)", "(3000.0)[::-1].copy()") == first - 1.0
    assert run("a_constant", "(2, 3)", "(3, 2)") == first - 1.0
    assert run("a_helper", "/ 2.0", "/ 4.0") == first - 1.5
    assert run("a_decorator", "+ number", "- number") == first - 6.0
    assert run() == first


def scaled_by(rule, **options):
    return Composed(scaled, {"rule": rule}, **options)


BOUND = {
    "one rule": scaled_by(root),
    "one template twice": Composed(both, {"first": scaled_by(root), "second": scaled_by(less)}),
    "one binding twice": Composed(both, {"first": scaled_by(root), "second": scaled_by(root)}),
    "one within another": scaled_by(Composed(both, {"first": scaled_by(below), "second": below})),
    "one apart": Composed(both, {"first": scaled_by(root, apart=True), "second": less}),
    "both apart": Composed(both, {"first": scaled_by(root, apart=True), "second": scaled_by(less, apart=True)}),
    "apart from what is apart": scaled_by(
        Composed(both, {"first": scaled_by(below, apart=True), "second": scaled_by(root)}, apart=True)
    ),
    "itself apart": scaled_by(less, apart=True),
}


@pytest.mark.parametrize("bound", BOUND)
def test_bindings_of_bindings_are_the_same_compiled_and_plain(bound):
    plain, compiled = BOUND[bound].python(), specialise(BOUND[bound].compiled(), (1.0,), "it")
    for x in (-3.5, 0.0, 0.1, 7.0, 1e300):
        assert compiled(x) == plain(x)


def test_what_is_apart_has_a_module_of_its_own_from_which_others_import_it():
    apart = scaled_by(root, apart=True)
    others = [Composed(both, {"first": apart, "second": less}), Composed(both, {"first": less, "second": apart})]
    for other in others:
        assert f"from {apart.compiled().py_func.__module__} import scaled as both__" in other.source()
        assert "SCALE" not in other.source()


def test_it_is_known_whether_an_author_compiled_a_function_himself():
    assert not scaled_by(root).compiled_by_others
    assert scaled_by(njit(root)).compiled_by_others
    assert Composed(both, {"first": root, "second": scaled_by(njit(root))}).compiled_by_others


def test_two_templates_that_mean_different_things_by_one_name_are_told_apart(tmp_path):
    (tmp_path / "a_rule.py").write_text("SCALE = 3.0\n\n\ndef rule(x):\n    return x\n")
    (tmp_path / "a_template.py").write_text(
        "from a_rule import SCALE\n\n\ndef template(x):\n    return SCALE * inner(x)\n"
    )
    text = f"""
        import sys
        sys.path.append({str(Path(__file__).parent)!r})
        from a_template import template
        from composed_rules import root, scaled
        from mape.compose import Composed
        from mape.errors import ConfigError

        try:
            Composed(template, {{"inner": Composed(scaled, {{"rule": root}})}}).compiled()
        except ConfigError as error:
            print(error)
    """
    assert fresh_process(tmp_path, text) == "two templates mean different things by 'SCALE'; rename one\n"


@pytest.mark.parametrize(
    ("rule", "why"),
    [
        *[
            (name, "it makes an array, a list or a text, and compiled rules allocate nothing. Let it work in place on")
            for name in ("makes_an_array", "makes_zeros", "makes_a_list", "makes_a_text")
        ],
        (
            "adds_a_text",
            "No implementation of function Function(<built-in function add>) found for signature: >>> add(",
        ),
        ("sums_a_generator", "The use of yield in a closure is unsupported. Choose the engine 'python' to run it as"),
    ],
)
def test_a_rule_that_numba_does_not_compile_is_named_with_the_reason_and_the_way_out(rule, why):
    with pytest.raises(ConfigError) as refused:
        specialise(scaled_by(getattr(composed_rules, rule)).compiled(), (1.0,), "it")
    assert str(refused.value).startswith(f"rule {rule} cannot be compiled by Numba: {why}")
    assert str(refused.value).endswith("Choose the engine 'python' to run it as it is, or keep to what Numba compiles.")


def test_the_reason_is_that_of_the_rule_which_is_called_by_the_one_that_is_named():
    with pytest.raises(ConfigError, match=r"^rule calls_another cannot be compiled.*<built-in function add>.*>>> add"):
        specialise(scaled_by(composed_rules.calls_another).compiled(), (1.0,), "it")


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_the_reason_is_told_however_deep_the_rule_is_bound(depth):
    bound = composed_rules.asks_math
    for _ in range(depth):
        bound = scaled_by(bound)
    with pytest.raises(ConfigError, match=r"^rule asks_math cannot be compiled by Numba: Unknown attribute 'fmod' of"):
        specialise(bound.compiled(), (1.0,), "it")


def test_a_name_that_numpy_does_not_have_is_refused_too():
    with pytest.raises(ConfigError, match=r"cannot be compiled by Numba: module 'numpy' has no attribute 'median_of_"):
        specialise(scaled_by(composed_rules.asks_numpy).compiled(), (1.0,), "it")


def test_a_detector_whose_rule_allocates_is_refused_before_the_first_pass():
    loop = loop_of(config(monitor={"detectors": ["stretch_parts:Allocating"]}))
    with pytest.raises(
        ConfigError, match=r"^detector monitor.0 Allocating: rule allocates cannot be compiled by .* makes an array"
    ):
        loop.run(1)
    assert loop.log.passes == 0
    plain = loop_of(config(monitor={"detectors": ["stretch_parts:Allocating"]}, execute={"engine": "python"}))
    plain.run(10)
    assert plain.log.passes == 10


WATCH = """
import math
from knowledge.rows import UNKNOWN
from mape.ports import QuietRule


def watch(state, params, x):
    state[0] = 0.5 * state[0] + x
    return False, state[0], UNKNOWN


class Watch:
    direction = "unknown"
    quiet = property(lambda self: QuietRule(watch, self.numbers))
    statistic = property(lambda self: self.numbers[0])

    def __init__(self):
        self.numbers = [0.0]

    def update(self, x):
        return watch(self.numbers, (), x)[0]

    def reset(self):
        self.numbers[0] = 0.0
"""
WATCHED = """
    import json
    from numba.core import event
    from adapters.systems import make_system
    from mape.config import from_table
    from mape.loop import Loop

    compiled, hashes = event.RecordingListener(), []
    event.register("numba:compile", compiled)
    for engine in ("auto", "python"):
        table = {table!r}
        table["execute"] = {{"engine": engine}}
        loop = Loop(chosen := from_table(table), make_system(chosen.system))
        loop.run(9)
        assert (loop.stretches() is not None) == (engine == "auto")
        hashes.append(loop.log.sha256())
    print(json.dumps([len(compiled.buffer), hashes]))
"""


def test_an_edited_rule_of_a_detector_is_seen_by_stretches_and_a_second_process_compiles_nothing(tmp_path):
    text = WATCHED.format(table={**GRID, "monitor": {"detectors": ["a_watch:Watch"]}})

    def run(factor):
        (tmp_path / "a_watch.py").write_text(WATCH.replace("0.5", factor))
        events, (compiled, plain) = json.loads(fresh_process(tmp_path, text, PYTHONDONTWRITEBYTECODE="1"))
        assert compiled == plain
        return events, plain

    (_, first), (_, edited) = run("0.5"), run("0.25")
    assert first != edited
    assert run("0.25") == (0, edited)
    assert run("0.5") == (0, first)


@pytest.fixture
def nowhere_else(tmp_path, monkeypatch):
    """Let the user's own folders be unusable, and return the one in the temporary folder."""
    (tmp_path / "file").touch()
    monkeypatch.setenv("MAPEK_CACHE", str(tmp_path / "file" / "below"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path / f"mapek-{os.getuid()}"


def test_where_nothing_else_can_be_written_compiled_code_is_kept_in_a_temporary_folder(nowhere_else):
    assert cache_folder() == nowhere_else
    assert nowhere_else.stat().st_mode & 0o777 == 0o700
    assert cache_folder() == nowhere_else


@pytest.mark.parametrize("planted", [lambda path: path.mkdir(mode=0o755), lambda path: path.symlink_to(path.parent)])
def test_a_temporary_folder_in_which_others_could_put_code_is_not_used(nowhere_else, planted):
    planted(nowhere_else)
    with pytest.raises(ConfigError, match="name one in MAPEK_CACHE"):
        cache_folder()


@pytest.fixture
def named_cache(tmp_path, monkeypatch):
    folder = tmp_path / "named"
    folder.mkdir(mode=0o700)
    monkeypatch.setenv("MAPEK_CACHE", str(folder))
    return folder


def test_a_cache_that_others_can_write_is_refused(named_cache):
    named_cache.chmod(0o770)
    with pytest.raises(ConfigError, match=r"MAPEK_CACHE is '.*named'.*open to others.*new"):
        cache_folder()
    named_cache.chmod(0o755)
    assert cache_folder() == named_cache


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a folder to somebody else")
def test_a_cache_of_another_owner_is_refused(named_cache):
    os.chown(named_cache, 65534, 65534)
    with pytest.raises(ConfigError, match=r"MAPEK_CACHE is '.*named'.*belongs to the user with the number 65534"):
        cache_folder()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a folder to somebody else")
def test_a_users_cache_folder_of_another_owner_is_passed_by(nowhere_else, tmp_path, monkeypatch):
    monkeypatch.delenv("MAPEK_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    (tmp_path / "home" / "mapek").mkdir(parents=True)
    os.chown(tmp_path / "home" / "mapek", 65534, 65534)
    assert cache_folder() == nowhere_else
