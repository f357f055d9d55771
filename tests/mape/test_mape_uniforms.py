"""A wide block of uniforms is drawn as far as it is used, and to the same bits as if it were drawn whole."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Discrete
from hypothesis import given
from hypothesis import strategies as st
from mape_runs import config, hashes, loop_of

from adapters.systems import make_system
from mape.config import from_table
from mape.execute import component, uniforms
from mape.execute.uniforms import Drawn, Reaching, Uniforms
from mape.loop import Loop

SEEDS = st.integers(0, 2**63 - 1)


@given(SEEDS, st.integers(1, 5000), st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 10**9)), max_size=20))
def test_a_drawn_uniform_is_that_of_the_whole_block(seed, width, looked_up):
    drawn, whole = Drawn(seed, (0, 3), width), Uniforms(seed, (0, 3), width)
    for passes, place in looked_up:
        for k in (place % width, 0, (place + 1) % width):
            assert drawn.values[drawn.find(passes) + k] == whole.values[whole.find(passes) + k]
        assert (drawn.block(drawn.find(passes), width) == whole.block(whole.find(passes), width)).all()


@given(SEEDS, st.integers(0, 3), st.integers(0, 3), st.integers(1, 3000), st.lists(st.integers(0, 3000), max_size=8))
def test_what_is_reached_of_a_block_stands_where_it_stands_in_the_whole(seed, reset, step, cap, lengths):
    part = Reaching(seed, (1, 0), reset, step, cap)
    whole = Uniforms(seed, (1, 0), part.width)
    for passes, length in enumerate(lengths):
        at, begin = part.find(passes * 7), whole.find(passes * 7)
        assert at == 0
        while True:
            systems = reset + part.reach * step
            expected = whole.values[begin : begin + systems], whole.values[begin + reset + cap * step :]
            assert (part.values[:systems] == expected[0]).all()
            assert (part.values[systems:] == expected[1][: 2 * part.reach]).all()
            if not part.further(min(length, cap)):
                break
        assert part.reach > min(length, cap) or part.reach == cap
        part.settle(min(length, cap))


class Wanders(gymnasium.Env):
    """Ends after a number of steps that depends on the episode and on what is done."""

    observation_space, action_space = Discrete(7), Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 3 + 90 * options["episode"] % 401
        return 0, {}

    def step(self, action):
        self.left -= 1 + int(action)
        return self.left % 7, float(action), self.left <= 0, False, {}


gymnasium.register("Wanders-v0", Wanders)
WIDE = {"id": "Wanders-v0", "max_steps": 30_000}


@pytest.mark.parametrize("engine", ["compiled", "python"])
@pytest.mark.parametrize("max_steps", [60, 700])
def test_a_run_with_a_high_cap_is_the_same_however_much_is_drawn(monkeypatch, engine, max_steps):
    """Episodes shorter and longer than what is drawn at first, with actions that come and go."""
    made = []
    options = {"max_steps": max_steps, "size": [12, 12], "start": [0, 0], "goals": [[11, 11], [0, 11]], "slip": 0.3}
    chosen = config(system={"options": options}, monitor={"detectors": []}, execute={"engine": engine})
    for wide in (10**9, 8):
        monkeypatch.setattr(component, "WIDE", wide)
        loop = loop_of(chosen)
        loop.run(12)
        made.append((type(loop.execute.uniforms), hashes(loop)))
    assert made[0][0] is Uniforms
    assert made[1][0] is {"compiled": Reaching, "python": Drawn}[engine]
    assert made[0][1] == made[1][1]


def test_a_called_system_with_a_high_cap_is_the_same_too_and_draws_what_it_uses(monkeypatch):
    drawn = []
    draw = uniforms._Stream.draw
    monkeypatch.setattr(
        uniforms._Stream, "draw", lambda self, first, out: drawn.append(len(out)) or draw(self, first, out)
    )
    table = {"name": "wide", "episodes": 8, "system": WIDE, "plan": {"name": "q_learning"}}
    made = []
    for wide in (10**9, component.WIDE):
        drawn.clear()
        monkeypatch.setattr(component, "WIDE", wide)
        chosen = from_table(table)
        loop = Loop(chosen, make_system(chosen.system))
        loop.run(8)
        made.append(hashes(loop))
    assert made[0] == made[1]
    steps = sum(seen.observation.steps for seen in loop.log.window)
    assert sum(drawn) <= 2 * steps + 8 * uniforms.PIECE + 8
    assert np.max(drawn) < 60_000
