"""A compiled episode and the same rules through `step` of the environment are one algorithm with the same bits."""

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from mape_configs import EPISODES, configs, gridworlds, junctions
from mape_runs import hashes, loop_of

from mape.config import from_table
from mape.errors import ConfigError, ManagedSystemError


def outcome(table, engine, trial):
    """Hashes and steps of a run, or what it was refused with."""
    chosen = from_table(table | {"execute": {**table["execute"], "engine": engine}})
    steps = []
    try:
        loop = loop_of(chosen, trial=trial)
    except ConfigError:
        return None  # no such grid: a goal that cannot be reached, say
    assert loop.execute.compiled == (engine == "compiled")
    loop.execute.record_trace(1, EPISODES, lambda number, trace: steps.append((number, trace.tobytes())))
    try:
        loop.run(EPISODES)
    except ManagedSystemError as error:
        return str(error), loop.log.passes, steps
    return hashes(loop), loop.log.passes, steps


@pytest.mark.parametrize("systems", [gridworlds(), junctions()], ids=["gridworld", "junction"])
@settings(max_examples=25)
@given(st.data())
def test_compiled_and_called_episodes_are_the_same_bit_for_bit(systems, data):
    table, trial = data.draw(configs(systems)), data.draw(st.integers(0, 3))
    compiled = outcome(table, "compiled", trial)
    assume(compiled is not None)
    assert compiled == outcome(table, "python", trial)
