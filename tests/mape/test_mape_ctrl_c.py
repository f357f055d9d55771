"""A Ctrl-C at any line of what draws uniforms, or hashes rows, changes no bit of a run that then goes on."""

import itertools
import sys

import pytest
from mape_runs import GRID, config, hashes, loop_of

from knowledge import Log
from mape.execute.uniforms import Uniforms

WIDTH, PASSES = 3, 2000


def block(stream, passes):
    at = stream.find(passes)
    return stream.values[at : at + WIDTH].tolist()


@pytest.fixture(scope="module")
def blocks():
    stream = Uniforms(7, (0, 1), WIDTH)
    return [block(stream, passes) for passes in range(PASSES)]


def stopped_by_ctrl_c(call, code, line):
    """Call, with a KeyboardInterrupt before the line number `line`, of those made, of a function; say if it has one."""
    lines = itertools.count()

    def trace(frame, event, _):
        if event == "line" and next(lines) == line:
            raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(lambda frame, event, _: trace if frame.f_code is code else None)
    try:
        call()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(before)
    return False


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
