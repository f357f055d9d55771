"""The fixed layout in which a pass is logged: one little-endian struct per pass.

The same bytes are hashed by the log, read as a NumPy structured array by metrics and tables, and written by any
engine that runs passes; so a per-episode table is the log itself, seen by column.
"""

from __future__ import annotations

import functools
import json
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from knowledge.records import ChangePlan, ChangeRequest, Direction, Drift, Observation, Reading, Symptom

DOWN, UP, UNKNOWN = 1, 2, 3

DIRECTIONS: dict[Direction, int] = {"down": DOWN, "up": UP, "unknown": UNKNOWN}
"""Codes of a drift's direction in a row; 0 stands for no drift."""

SIDES: dict[int, Direction] = {code: direction for direction, code in DIRECTIONS.items()}
"""The directions by their codes."""

PASS, PLAN, STEPS, EPSILON, NEXT_EPSILON, SIGNALS = range(6)
"""Places in a row's head: the first three are integers; from SIGNALS on the signals, the values, the statistics."""

_WORD = (1 << 64) - 1


class RowLayout:
    """Layout of the rows of one run.

    Parameters
    ----------
    signals
        Names of the signals, in order.
    detectors
        Number of detectors.
    rates
        Number of learning-rate parameters in a plan.
    max_actions
        Actions have ids from 0 to ``max_actions - 1``; a set of them is a bit mask of ``ceil(max_actions / 64)`` words.

    Attributes
    ----------
    dtype : of a row, as NumPy reads it.
    head : number of the leading fields that are eight bytes each; what follows differs between few passes.
    """

    def __init__(self, signals: tuple[str, ...], detectors: int, rates: int, max_actions: int = 64) -> None:
        self.signals = signals
        self.detectors = detectors
        self.rates = rates
        self.max_actions = max_actions
        self.head = SIGNALS + len(signals) + 2 * detectors
        words = -(-max_actions // 64)
        hot: list[tuple[str, str, int | None]] = [
            # (name, struct code, how many; None for a scalar): what changes with every pass
            ("pass", "q", None),
            ("plan", "q", None),
            ("steps", "q", None),
            ("epsilon", "d", None),
            ("next_epsilon", "d", None),
            ("signals", "d", len(signals)),
            ("value", "d", detectors),
            ("statistic", "d", detectors),
            ("alarm", "?", detectors),
        ]
        rare: list[tuple[str, str, int | None]] = [
            # what stays the same over most passes, and is packed only when it changes
            ("direction", "B", detectors),
            ("drift", "B", len(signals)),
            ("reset_detector", "?", None),
            ("next_reset_detector", "?", None),
            ("available", "Q", words),
            ("known", "Q", words),
            ("added", "Q", words),
            ("removed", "Q", words),
            ("add", "Q", words),
            ("drop", "Q", words),
            ("enable", "Q", words),
            ("learning_rate", "d", rates),
            ("adopt", "32s", None),
        ]
        self._rare = _struct(rare)
        self.struct = struct.Struct(f"{_struct(hot).format}{self._rare.size}s")
        self.dtype = np.dtype([_column(*field) for field in hot + rare])
        assert self.dtype.itemsize == self.struct.size
        self._words = words
        self._last: tuple[tuple[Any, ...], bytes] = ((), b"")
        self._packed = functools.lru_cache(maxsize=256)(self._pack_rare)

    @property
    def schema(self) -> bytes:
        """Canonical text of the layout; the log's hash begins with it."""
        head = {"signals": self.signals, "detectors": self.detectors, "rates": self.rates, "actions": self.max_actions}
        return json.dumps(head, sort_keys=True, separators=(",", ":")).encode()

    def pack_into(
        self,
        buffer: bytearray,
        offset: int,
        seen: Observation,
        symptom: Symptom,
        request: ChangeRequest,
        plan: ChangePlan,
    ) -> None:
        """Write one pass at `offset`.

        Raises
        ------
        ValueError
            An action id outside ``0 .. max_actions - 1``, a record whose width is not the run's, or a value of another
            type than its field's.
        """
        readings = symptom.readings
        if self.detectors == 1:  # the common case, without a transposition
            try:
                ((_, value, statistic, alarm, direction),) = readings
            except ValueError:
                raise self._misfit(seen, f"it has {len(readings)} readings") from None
            numbers: tuple[Any, ...] = (value, _NO_STATISTIC if statistic is None else statistic, alarm)
            directions: tuple[Direction, ...] = (direction,)
        else:
            directions = tuple(r.direction for r in readings)
            numbers = (
                *[r.value for r in readings],
                *[_NO_STATISTIC if r.statistic is None else r.statistic for r in readings],
                *[r.alarm for r in readings],
            )
        _, number, in_force, epsilon, reset, steps, available, known, signals = seen
        _, _, drifts, added, removed, _ = request
        _, _, next_epsilon, rate, add, drop, enable, next_reset, adopt = plan
        key = (directions, drifts, reset, next_reset, available, known, added, removed, add, drop, enable, rate, adopt)
        try:
            last_key, rare = self._last
            if key != last_key:
                rare = self._packed(*key)
                self._last = key, rare
            self.struct.pack_into(
                buffer,
                offset,
                number,
                in_force,
                steps,
                epsilon,
                next_epsilon,
                *signals.values(),
                *numbers,
                rare,
            )
        except (struct.error, TypeError, OverflowError) as error:
            why = f"{error} (sets of actions are tuples of ints, drifts a tuple of Drift, rates a tuple of floats)"
            raise self._misfit(seen, why) from error

    def of_heads(
        self,
        passed: tuple[Observation, Symptom, ChangeRequest, ChangePlan],
        heads: npt.NDArray[np.float64],
        directions: npt.NDArray[np.int64],
    ) -> npt.NDArray[np.void]:
        """Return rows with given heads and directions, and all else as in the row of one pass.

        Parameters
        ----------
        passed
            The records of that pass.
        heads
            Shape (rows, `head`): what the heads hold, byte for byte.
        directions
            Shape (rows, detectors): their codes.
        """
        one = bytearray(self.struct.size)
        self.pack_into(one, 0, *passed)
        rows = np.empty((len(heads), len(one)), np.uint8)
        rows[:] = np.frombuffer(one, np.uint8)
        rows[:, : 8 * self.head] = heads.view(np.uint8)
        found: npt.NDArray[np.void] = rows.view(self.dtype)[:, 0]
        if self.detectors:
            found["direction"] = directions
        return found

    def _misfit(self, seen: Observation, why: str) -> ValueError:
        return ValueError(
            f"pass {seen.pass_no} does not fit the run's layout of {len(self.signals)} signals, "
            f"{self.detectors} detectors and {self.rates} learning-rate parameters: {why}"
        )

    def pack_start(self, plan: ChangePlan) -> bytes:
        """Pack plan 0, which starts a run, as a pass in which nothing else happened."""
        nothing = Observation(plan.loop, 0, 0, 0.0, False, 0, (), (), dict.fromkeys(self.signals, 0.0))
        quiet = (Reading("", 0.0, None, False, "unknown"),) * self.detectors
        buffer = bytearray(self.struct.size)
        self.pack_into(
            buffer,
            0,
            nothing,
            Symptom(plan.loop, 0, nothing.signals, (), (), quiet),
            ChangeRequest(plan.loop, 0, (), (), (), nothing.signals),
            plan,
        )
        return bytes(buffer)

    def _pack_rare(
        self,
        directions: tuple[Direction, ...],
        drifts: tuple[Drift, ...],
        reset: bool,
        next_reset: bool,
        available: tuple[int, ...],
        known: tuple[int, ...],
        added: tuple[int, ...],
        removed: tuple[int, ...],
        add: tuple[int, ...],
        drop: tuple[int, ...],
        enable: tuple[int, ...],
        rate: tuple[float, ...],
        adopt: str | None,
    ) -> bytes:
        masks = [
            word
            for actions in (available, known, added, removed, add, drop, enable)
            for word in _mask(actions, self._words, self.max_actions)
        ]
        return self._rare.pack(
            *[_code(direction) for direction in directions],
            *self._drift_codes(drifts),
            reset,
            next_reset,
            *masks,
            *[number + 0.0 for number in rate],  # -0.0 equals 0.0, so the bytes of either may have been kept
            b"" if adopt is None else _hash_bytes(adopt),
        )

    def _drift_codes(self, drifts: tuple[Drift, ...]) -> list[int]:
        codes = dict.fromkeys(self.signals, 0)
        for signal, direction in drifts:
            if signal not in codes:
                raise ValueError(f"drift of signal {signal!r}; the run's signals are {', '.join(self.signals)}")
            if codes[signal]:
                raise ValueError(f"two drifts of signal {signal!r} in one request; say it once")
            codes[signal] = _code(direction)
        return list(codes.values())


def _code(direction: Direction) -> int:
    if direction not in DIRECTIONS:
        raise ValueError(f"the direction {direction!r} of a reading or drift is not one of {', '.join(DIRECTIONS)}")
    return DIRECTIONS[direction]


def _hash_bytes(text: str) -> bytes:
    try:
        digest = bytes.fromhex(text)
    except ValueError:
        digest = b""
    if len(digest) != 32:
        raise ValueError(f"{text!r} is no SHA-256: that has 64 hexadecimal digits")
    return digest


_NUMPY_CODES = {"q": "<i8", "d": "<f8", "?": "?", "Q": "<u8", "B": "u1", "32s": "V32"}


def _struct(fields: list[tuple[str, str, int | None]]) -> struct.Struct:
    return struct.Struct("<" + "".join(code if count is None else f"{count}{code}" for _, code, count in fields))


def _column(name: str, code: str, count: int | None) -> tuple[Any, ...]:
    kind = _NUMPY_CODES[code]
    return (name, kind) if count is None else (name, kind, (count,))


_NO_STATISTIC = float("nan")


def _mask(actions: tuple[int, ...], words: int, max_actions: int) -> tuple[int, ...]:
    bits = 0
    for action in actions:
        if not 0 <= action < max_actions:
            raise ValueError(
                f"action id {action} is outside 0 .. {max_actions - 1}; raise system.max_actions if the system has more"
            )
        bits |= 1 << action
    return tuple((bits >> (64 * word)) & _WORD for word in range(words))
