"""A Ctrl-C at any line changes no bit of a run that then goes on."""

import itertools
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mape_interrupts import stopped_by_ctrl_c
from mape_runs import GRID, TRAFFIC, config, hashes, loop_of

import knowledge
import mape
from knowledge import Log
from mape.ctrl_c import CtrlC
from mape.execute.uniforms import Uniforms

WIDTH, PASSES = 3, 2000


def block(stream, passes):
    at = stream.find(passes)
    return stream.values[at : at + WIDTH].tolist()


@pytest.fixture(scope="module")
def blocks():
    stream = Uniforms(7, (0, 1), WIDTH)
    return [block(stream, passes) for passes in range(PASSES)]


def test_blocks_are_found_in_any_order(blocks):
    stream = Uniforms(7, (0, 1), WIDTH)
    for passes in (0, PASSES - 1, 5, 511, 512, 1023, 0, 1024):
        assert block(stream, passes) == blocks[passes]


def test_a_ctrl_c_while_blocks_are_drawn_changes_none_of_them(blocks):
    for line in itertools.count():
        stream = Uniforms(7, (0, 1), WIDTH)
        stream.find(0)
        if not stopped_by_ctrl_c(lambda: stream.find(600), Uniforms.find.__code__, line):  # noqa: B023
            break
        assert [block(stream, passes) for passes in (601, 3, 1400, 600)] == [blocks[k] for k in (601, 3, 1400, 600)]
    assert line > 4


def test_a_ctrl_c_while_rows_are_handed_on_leaves_all_of_them_hashed_once():
    whole = loop_of(config(GRID, episodes=40))
    whole.run(40)
    for line in itertools.count():
        loop, heard = loop_of(config(GRID, episodes=40)), []
        loop.log.on_rows(lambda rows: heard.extend(rows["pass"].tolist()))  # noqa: B023
        loop.run(20)
        before = loop.log.sha256()
        if not stopped_by_ctrl_c(loop.log.flush, Log._flush.__code__, line):
            break
        assert loop.log.sha256() == before
        loop.run(20)
        loop.log.flush()
        assert hashes(loop) == hashes(whole)
        assert sorted(set(heard)) == list(range(1, 41))
    assert line > 4


# A real Ctrl-C, between whatever two lines

OURS = tuple(str(Path(package.__file__).parent) for package in (mape, knowledge))
SWAP = {"pass": 20, "part": "plan.schedule", "to": {"name": "constant"}}
SYSTEMS = {
    "compiled": config(GRID, episodes=40, execute={"engine": "compiled"}),
    "called": config(GRID, episodes=40, execute={"engine": "python"}),
    "reserve": config(TRAFFIC, episodes=40, swap=[SWAP]),
}


def with_ctrl_c(call, at):
    """Call, with a Ctrl-C before line number `at` of those of the loop; return how many of them were made."""
    made = 0

    def trace(frame, event, _):
        nonlocal made
        if event == "line":
            if made == at:
                signal.raise_signal(signal.SIGINT)
            made += 1
        return trace

    before = sys.gettrace()
    sys.settrace(lambda frame, event, _: trace if frame.f_code.co_filename.startswith(OURS) else None)
    try:
        call()
    finally:
        sys.settrace(before)
    return made


def undisturbed(kind):
    loop = loop_of(SYSTEMS[kind])
    made = with_ctrl_c(lambda: loop.run(40), -1)
    return made, hashes(loop)


@pytest.mark.parametrize("kind", SYSTEMS)
def test_after_a_ctrl_c_at_any_line_the_same_loop_goes_on(kind):
    lines, expected = undisturbed(kind)

    @given(at=st.integers(0, lines - 1))
    def holds(at):
        loop = loop_of(SYSTEMS[kind])
        try:
            with_ctrl_c(lambda: loop.run(40), at)
        except KeyboardInterrupt:
            assert loop.log.passes == loop.execute.passes
        loop.run(40 - loop.execute.passes)
        assert hashes(loop) == expected

    holds()


def test_stepping_is_stopped_between_two_records():
    whole = loop_of(SYSTEMS["reserve"])
    whole.run(40)
    loop, stopped = loop_of(SYSTEMS["reserve"]), 0
    while loop.log.passes < 40:
        try:
            with_ctrl_c(loop.advance, 10)
        except KeyboardInterrupt:
            stopped += 1
    assert stopped > 100
    assert hashes(loop) == hashes(whole)


def test_a_second_ctrl_c_is_heard_at_once():
    def twice():
        with CtrlC():
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            pytest.fail("the second one was not heard")

    with pytest.raises(KeyboardInterrupt):
        twice()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_who_handles_the_signal_otherwise_is_left_alone():
    heard = []
    before = signal.signal(signal.SIGINT, lambda *_: heard.append(1))
    try:
        with CtrlC() as ctrl_c:
            signal.raise_signal(signal.SIGINT)
            ctrl_c.check()
    finally:
        signal.signal(signal.SIGINT, before)
    assert heard == [1]


def test_a_loop_runs_in_a_thread_too():
    loop = loop_of(SYSTEMS["compiled"])
    thread = threading.Thread(target=loop.run, args=(40,))
    thread.start()
    thread.join()
    assert hashes(loop) == undisturbed("compiled")[1]


COMPILED = """
import signal
import sys
from numba.core.codegen import JITCodeLibrary
from composed_rules import root, scaled
from mape.compose import Composed, specialise
from mape.ctrl_c import CtrlC

hook, presses = JITCodeLibrary._object_compiled_hook, int(sys.argv[1])


def pressed(library, module, code):
    # Called by LLVM, through which no exception can go.
    global presses
    while presses and module.name == "scaled":
        presses -= 1
        signal.raise_signal(signal.SIGINT)
    hook(module, code)


JITCodeLibrary._object_compiled_hook = classmethod(pressed)
bound = Composed(scaled, {"rule": root})


def compiled():
    try:
        return specialise(bound.compiled(), (1.0,), "it")
    except KeyboardInterrupt:
        return "stopped"


if sys.argv[2] == "alone":
    told = [compiled()]
else:
    told = []
    try:
        with CtrlC():
            told.append(compiled())
        told.append("swallowed")
    except KeyboardInterrupt:
        told.append("stopped afterwards")
function = compiled()
print(*(each if isinstance(each, str) else "compiled" for each in told), function(4.0) == bound.python()(4.0), sep=", ")
"""


@pytest.mark.parametrize(
    ("presses", "where", "told"),
    [
        (1, "alone", "stopped, True"),
        (1, "within", "compiled, stopped afterwards, True"),
        (2, "alone", "stopped, True"),
        (2, "within", "stopped, stopped afterwards, True"),
    ],
)
def test_a_ctrl_c_while_code_is_compiled_is_neither_lost_nor_taken_for_a_fault_of_the_rule(
    tmp_path, presses, where, told
):
    done = subprocess.run(
        [sys.executable, "-c", COMPILED, str(presses), where],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), str(Path(mape.__file__).parents[1])]),
            "MAPEK_CACHE": str(tmp_path),
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == told
    if presses == 1:
        assert done.stderr == ""
