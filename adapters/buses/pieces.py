"""Large messages in pieces, each of them acknowledged: after a link was lost the next piece is sent, not all again.

What is sent is named by the SHA-256 of the whole. Who takes pieces says how far it has come; who gives them keeps the
newest few wholes, so that a further piece is cut from the same one. Between two pieces other messages go their way.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from typing import NamedTuple

from adapters.buses.messages import Piece
from knowledge import MalformedRecord

PIECE = 32 << 10
"""Bytes of a piece; a message up to this size is sent as it is. At 64 kbit/s it takes four seconds."""

AT_ONCE = 4
"""Most wholes of one role that are held at the same time; of more, the one untouched for longest goes."""

_PIECE = b'{"schema":"Piece/'


class Cut(NamedTuple):
    """A piece, and its bytes."""

    piece: Piece
    data: bytes


def cut(data: bytes, whole: str, at: int) -> bytes:
    """Write the piece of `data` that begins at `at`; `whole` is the SHA-256 of all."""
    return Piece(whole=whole, size=len(data), at=at).pack() + b"\n" + data[at : at + PIECE]


def read(payload: bytes) -> Cut:
    """Read what `cut` wrote.

    Raises
    ------
    MalformedRecord
        It is none, or does not lie within its whole.
    """
    line, _, data = payload.partition(b"\n")
    piece, _ = Piece.unpack(line)
    if not 0 < len(data) <= PIECE or piece.at + len(data) > piece.size:
        raise MalformedRecord(f"a piece of {len(data)} bytes at {piece.at} of {piece.size}")
    return Cut(piece, data)


def is_piece(payload: bytes) -> bool:
    """Whether an answer is a piece of one, and not all of it."""
    return payload.startswith(_PIECE)


def sha256(data: bytes | bytearray) -> str:
    """Return the name of a whole."""
    return hashlib.sha256(data).hexdigest()


class Assembled:
    """An answer that may come in pieces.

    Attributes
    ----------
    whole : by what it is named, "" before the first piece.
    """

    def __init__(self) -> None:
        self.whole = ""
        self._got = bytearray()

    @property
    def at(self) -> int:
        """How many bytes there are: the next piece begins there."""
        return len(self._got)

    def take(self, answer: bytes) -> bytes | None:
        """Take an answer, or a piece of it; return all of it once it is here.

        Raises
        ------
        MalformedRecord
            It is no piece, or the pieces do not make what they say.
        """
        if not is_piece(answer):
            return answer
        piece, data = read(answer)
        if piece.whole != self.whole:  # the first, or what is asked for is something else by now
            self.whole, self._got = piece.whole, bytearray()
        if piece.at == len(self._got):
            self._got += data
        if len(self._got) < piece.size:
            return None
        if sha256(self._got) != self.whole:
            raise MalformedRecord(f"the pieces of {self.whole[:12]} do not make what it is the hash of")
        return bytes(self._got)


class Given:
    """Wholes that are handed out in pieces: the newest few."""

    def __init__(self) -> None:
        self._wholes: OrderedDict[str, bytes] = OrderedDict()

    def answer(self, data: bytes) -> bytes:
        """Return an answer as it is, or the first piece of it."""
        if len(data) <= PIECE:
            return data
        whole = sha256(data)
        self._wholes[whole] = data
        while len(self._wholes) > AT_ONCE:
            self._wholes.popitem(last=False)
        return cut(data, whole, 0)

    def further(self, whole: str, at: int) -> bytes | None:
        """Return the piece at `at` of an answer that was begun; None where it is not held any more."""
        data = self._wholes.get(whole)
        if data is None or not 0 <= at < len(data):
            return None
        self._wholes.move_to_end(whole)
        if at + PIECE >= len(data):  # the last one may get lost and be asked for again: it is the next to go
            self._wholes.move_to_end(whole, last=False)
        return cut(data, whole, at)


class Gathered:
    """Wholes that come in pieces.

    Parameters
    ----------
    most
        Bytes of the largest whole, and of all that are held, that are taken.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._parts: OrderedDict[str, bytearray] = OrderedDict()
        self._sizes: dict[str, int] = {}

    def take(self, payload: bytes) -> int:
        """Take a piece if it is the next one of its whole; return how many bytes of that there are now.

        Raises
        ------
        MalformedRecord
            It is no piece, or of a whole that is too large, or the whole is not what its name says.
        """
        piece, data = read(payload)
        if piece.size > self._most:
            raise MalformedRecord(f"a message of {piece.size} bytes; at most {self._most} are taken here")
        part = self._parts.setdefault(piece.whole, bytearray())
        self._parts.move_to_end(piece.whole)
        if self._sizes.setdefault(piece.whole, piece.size) != piece.size:
            raise MalformedRecord(f"{piece.whole[:12]} has {self._sizes[piece.whole]} bytes, and not {piece.size}")
        if piece.at == len(part):
            part += data
            if len(part) == piece.size and sha256(part) != piece.whole:
                self._drop(piece.whole)
                raise MalformedRecord(f"the pieces of {piece.whole[:12]} do not make what it is the hash of")
        while len(self._parts) > AT_ONCE or sum(map(len, self._parts.values())) > self._most:
            self._drop(next(iter(self._parts)))
        return len(part)

    def whole(self, whole: str) -> bytes | None:
        """Return a message of which all pieces have come; None where some have not."""
        part = self._parts.get(whole)
        return bytes(part) if part is not None and len(part) == self._sizes[whole] else None

    def forget(self, whole: str) -> None:
        """Let go of a message that was dealt with."""
        if whole in self._parts:
            self._drop(whole)

    def _drop(self, whole: str) -> None:
        del self._parts[whole], self._sizes[whole]
