"""The randomness of a run: one stream of uniforms, of which each pass has a block of fixed size."""

from __future__ import annotations

import numpy as np

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
        self._bits = np.random.PCG64(np.random.SeedSequence(entropy=seed, spawn_key=key))
        self._start = self._bits.state
        self._generator = np.random.Generator(self._bits)
        self.values = np.empty(self._held * width)
        self._first = -self._held  # finished passes before the first block that is held; none is

    def find(self, passes: int) -> int:
        """Return where in `values` the block begins of the pass that follows `passes` finished ones."""
        turn = passes - self._first
        if not 0 <= turn < self._held:
            turn = passes % self._held
            # From the start each time: where the generator stands is not known after a Ctrl-C.
            self._first = -self._held
            self._bits.state = self._start
            self._bits.advance((passes - turn) * self.width)  # a double takes one draw
            self._generator.random(out=self.values)
            self._first = passes - turn
        return turn * self.width
