"""The randomness of a run: one stream of uniforms, of which each pass has a block of fixed size."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

WIDE = 8192
"""Uniforms per pass beyond which a block is drawn as far as it is used: short episodes may have a high cap."""

PIECE = 128
"""Uniforms of a wide block that are drawn in one go where an episode goes on from where it asks."""

LEAST_REACH = 64
"""Steps for which a compiled episode has uniforms at least."""

PASSES_AT_ONCE, DRAWS_AT_ONCE = 512, 65_536
"""Blocks drawn in one go, and how many uniforms they are at most: cheaper per pass, and the same stream."""


class Uniforms:
    """Uniforms on [0, 1), a block per pass; the block of any pass can be found again.

    Parameters
    ----------
    seed, key
        Entropy and spawn key of the stream.
    width
        Uniforms per pass, at least 1.

    Attributes
    ----------
    values : float64 array, of the blocks of passes that follow one another; the same object for good, filled anew when
        a pass is asked for whose block is not in it.
    width : uniforms per pass.

    Examples
    --------
    >>> stream, again = Uniforms(7, (0, 0), 3), Uniforms(7, (0, 0), 3)
    >>> blocks = [stream.values[at : at + 3].tolist() for at in map(stream.find, range(5000))]
    >>> at = again.find(4321)
    >>> again.values[at : at + 3].tolist() == blocks[4321]
    True
    """

    def __init__(self, seed: int, key: tuple[int, ...], width: int) -> None:
        self.width = width
        self._held = max(1, min(PASSES_AT_ONCE, DRAWS_AT_ONCE // width))  # passes whose blocks are held together
        self._stream = _Stream(seed, key)
        self.values = np.empty(self._held * width)
        self._first = -self._held  # finished passes before the first block that is held; none is

    def find(self, passes: int) -> int:
        """Return where in `values` the block begins of the pass that follows `passes` finished ones."""
        turn = passes - self._first
        if not 0 <= turn < self._held:
            turn = passes % self._held
            self._first = -self._held  # none, should a Ctrl-C come
            self._stream.draw((passes - turn) * self.width, self.values)
            self._first = passes - turn
        return turn * self.width

    def block(self, at: int, count: int) -> FloatArray:
        """Return a copy of the `count` uniforms from `at` on."""
        return self.values[at : at + count].copy()


class Drawn:
    """The same stream for blocks that are wide: a piece is drawn when one of its uniforms is looked up.

    For an episode in plain Python, which goes on from where it asks.

    Attributes
    ----------
    values : itself; ``values[i]`` is the uniform number i of the stream, from 0.
    width : uniforms per pass.

    Examples
    --------
    >>> drawn, stream = Drawn(7, (0, 0), 30_000), Uniforms(7, (0, 0), 30_000)
    >>> [bool(drawn.values[drawn.find(3) + k] == stream.values[stream.find(3) + k]) for k in (0, 29_999)]
    [True, True]
    """

    def __init__(self, seed: int, key: tuple[int, ...], width: int) -> None:
        self.width = width
        self.values = self
        self._stream = _Stream(seed, key)
        self._first = 0  # of the piece that is held
        self._piece: list[float] = []

    def find(self, passes: int) -> int:
        """Return the number of the first uniform of the pass that follows `passes` finished ones."""
        return passes * self.width

    def __getitem__(self, i: int) -> float:
        at = i - self._first
        if not 0 <= at < len(self._piece):
            self._piece, self._first = self._stream.draw(i, np.empty(PIECE)).tolist(), i
            return self._piece[0]
        return self._piece[at]

    def block(self, at: int, count: int) -> FloatArray:
        """Return the `count` uniforms from number `at` on."""
        return self._stream.draw(at, np.empty(count))


class Reaching:
    """The same stream for blocks that are wide: of one pass's block what its first `reach` steps take.

    For compiled episodes. One that comes to the end of that is driven again with more, to the same bits: `further`.

    Parameters
    ----------
    seed, key
        Entropy and spawn key of the stream.
    reset_draws, step_draws, cap
        What the system takes at a reset and at a step, and the steps of the longest episode. A block holds all of these
        and, behind them, two uniforms a step for exploration.

    Attributes
    ----------
    values : float64 array of the first `reach` steps, in the order of a block; another object when `reach` changes.
    reach : steps, from `LEAST_REACH` to `cap`.
    width : uniforms per pass.
    """

    def __init__(self, seed: int, key: tuple[int, ...], reset_draws: int, step_draws: int, cap: int) -> None:
        self.width = reset_draws + cap * (step_draws + 2)
        self._stream = _Stream(seed, key)
        self._reset_draws, self._step_draws, self._cap = reset_draws, step_draws, cap
        self._passes = 0
        self._set(LEAST_REACH)

    def find(self, passes: int) -> int:
        """Draw what is held of the block of the pass that follows `passes` finished ones; return 0, where it begins."""
        self._passes = passes
        begin, systems = passes * self.width, self._reset_draws + self.reach * self._step_draws
        self._stream.draw(begin, self.values[:systems])
        self._stream.draw(begin + self._reset_draws + self._cap * self._step_draws, self.values[systems:])
        return 0

    def further(self, steps: int) -> bool:
        """Hold more of the block if an episode of so many steps may have come to the end of what is held."""
        if steps < self.reach or self.reach == self._cap:
            return False
        self._set(4 * self.reach)
        self.find(self._passes)
        return True

    def settle(self, steps: int) -> None:
        """Hold from now on as much as another episode of so many steps takes."""
        wanted = LEAST_REACH
        while wanted <= steps:
            wanted *= 4
        if min(wanted, self._cap) != self.reach:
            self._set(wanted)

    def _set(self, reach: int) -> None:
        self.reach = min(reach, self._cap)
        self.values = np.empty(self._reset_draws + self.reach * (self._step_draws + 2))

    def block(self, at: int, count: int) -> FloatArray:
        """Return the `count` uniforms from `at` on of the block that is held in part."""
        return self._stream.draw(self._passes * self.width + at, np.empty(count))


class _Stream:
    def __init__(self, seed: int, key: tuple[int, ...]) -> None:
        self._bits = np.random.PCG64(np.random.SeedSequence(entropy=seed, spawn_key=key))
        self._start = self._bits.state
        self._generator = np.random.Generator(self._bits)

    def draw(self, first: int, out: FloatArray) -> FloatArray:
        """Fill `out` with the uniforms from number `first` on, and return it."""
        # From the start each time: where the generator stands is not known after a Ctrl-C.
        self._bits.state = self._start
        self._bits.advance(first)  # a double takes one draw
        self._generator.random(out=out)
        return out
