"""What an environment holds, as a fingerprint of each attribute: to find what it carries from one reset to the next.

After two resets with the same seed and options an environment that carries nothing holds the same, whatever was played
before. What differs then is what no fresh one has, in another process or after a restart.

Looked at are the attributes of the environment and of the wrappers around it, the data of its class and of the module
of that class, and what all these refer to. Wrappers of Gymnasium that only watch (`WATCHERS`) are left out: they count
and time episodes, and change neither observation nor reward. What stands outside of Python's objects, such as the
memory of a library in C, a file, or another process, cannot be looked at.
"""

from __future__ import annotations

import enum
import functools
import hashlib
import itertools
import random
import sys
import types
from collections import deque
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import (
    HumanRendering,
    OrderEnforcing,
    PassiveEnvChecker,
    RecordEpisodeStatistics,
    RecordVideo,
    TimeLimit,
)

from mape.execute.checkpoint import SHARED

WATCHERS = (HumanRendering, OrderEnforcing, PassiveEnvChecker, RecordEpisodeStatistics, RecordVideo, TimeLimit)
"""Wrappers that carry what they have seen, and let nothing of it into an episode; `TimeLimit` counts anew in each."""

NODES, DEPTH = 100_000, 40
"""Values of an attribute that are looked at, and how deep within one another."""

_ATOMS = (types.NoneType, bool, int, float, complex, str, bytes)
_PLAIN = frozenset(_ATOMS) - {str, bytes}
_DATA: tuple[type, ...] = (
    *_ATOMS,
    list,
    tuple,
    dict,
    set,
    frozenset,
    bytearray,
    deque,
    np.ndarray,
    np.generic,
    itertools.count,
)
_DATA += (random.Random, np.random.Generator, np.random.RandomState)
_LEFT_OUT = ("env", "spec", "_cached_spec")  # the layer below, and what the registry says of it
_LIBRARIES = ("builtins", "abc", "typing", "gymnasium")


def held(env: gymnasium.Env[Any, Any], *, base: bool = True) -> dict[str, str]:
    """Return a fingerprint of everything that an environment holds, by name.

    Parameters
    ----------
    env
        Any environment, in its wrappers.
    base
        Whether the innermost environment is looked at too, and not its wrappers alone.

    Returns
    -------
    Name -> 16 hexadecimal digits. An attribute of the environment stands under its name, that of a wrapper under
    ``Wrapper.name``; what all environments of a process share under ``shared Class.name`` or ``shared module.name``.
    """
    found: dict[str, str] = {}
    while isinstance(env, gymnasium.Wrapper):
        if type(env) not in WATCHERS:
            found |= {f"{type(env).__name__}.{name}": fingerprint(value) for name, value in _attributes(env)}
        env = env.env
    if base:
        found |= {name: fingerprint(value) for name, value in _attributes(env)}
        found |= {name: fingerprint(value) for name, value in _shared(type(env))}
    return found


def fingerprint(value: Any) -> str:
    """Return a hash of a value and of what it refers to, the same in every process.

    >>> fingerprint([1, {"a": np.arange(3)}]) == fingerprint([1, {"a": np.arange(3)}])
    True
    >>> fingerprint([1, 2]) == fingerprint((1, 2))
    False
    """
    reader = _Reader()
    reader.read(value, 0)
    return hashlib.blake2b(b"\0".join(reader.read_so_far), digest_size=8).hexdigest()


def _attributes(thing: Any) -> Iterator[tuple[str, Any]]:
    named: dict[str, Any] = dict(getattr(thing, "__dict__", {}))
    for klass in type(thing).__mro__:
        slots = vars(klass).get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            if name not in ("__dict__", "__weakref__") and hasattr(thing, name):
                named.setdefault(name, getattr(thing, name))
    for name, value in named.items():
        if not (isinstance(thing, gymnasium.Env) and name in _LEFT_OUT):
            yield name, value


def _shared(kind: type) -> Iterator[tuple[str, Any]]:
    """Yield the data of a class and of its module, which all environments of a process have in common."""
    for klass in kind.__mro__:
        if klass.__module__.partition(".")[0] not in _LIBRARIES:
            yield from _data(klass.__name__, vars(klass))
            yield from _data(klass.__module__, vars(sys.modules.get(klass.__module__, types.ModuleType(""))))


def _data(of: str, names: Any) -> Iterator[tuple[str, Any]]:
    for name, value in list(names.items()):
        if not name.startswith("__") and isinstance(value, _DATA):
            yield f"{SHARED}{of}.{name}", value


class _Reader:
    """Writes a value down, item by item."""

    def __init__(self) -> None:
        self.read_so_far: list[bytes] = []
        self._left = NODES
        self._within: set[int] = set()  # what is being read: where it comes again, it refers to itself

    def _put(self, *texts: str) -> None:
        for text in texts:
            self.read_so_far.append(f"{len(text)}:{text}".encode("utf-8", "surrogatepass"))

    def read(self, value: Any, depth: int) -> None:
        self._left -= 1
        if self._left < 0 or depth > DEPTH:
            self._put("...")
        elif type(value) in _PLAIN:
            self.read_so_far.append(repr(value).encode())
        elif type(value) is str:
            self._put(value)
        elif id(value) in self._within:
            self._put("itself")
        else:
            self._within.add(id(value))
            try:
                self._put(_name(type(value)))
                self._read(value, depth + 1)
            except Exception as error:  # an attribute of somebody else's class may do anything when it is looked at
                self._put(type(error).__name__)
            self._within.discard(id(value))

    def _read(self, value: Any, depth: int) -> None:
        if isinstance(value, (np.ndarray, np.generic)):
            self._put(str(value.dtype), str(value.shape))
            if value.dtype.hasobject:
                self._each(value.reshape(-1).tolist(), depth)
            else:
                self.read_so_far.append(value.tobytes())
        elif isinstance(value, dict):
            self._put(str(len(value)))
            for key, item in value.items():
                self.read(key, depth)
                self.read(item, depth)
        elif isinstance(value, (list, tuple, deque)):
            self._each(value, depth)
        elif isinstance(value, (set, frozenset)):
            self._put(*sorted(map(fingerprint, value)))
        elif isinstance(value, np.random.Generator):
            self.read(value.bit_generator.state, depth)
        elif isinstance(value, np.random.RandomState):
            self.read(value.get_state(legacy=False), depth)
        elif isinstance(value, random.Random):
            self.read(value.getstate(), depth)
        elif isinstance(value, (type, types.ModuleType, types.BuiltinFunctionType)):
            self._put(_name(value))
        elif isinstance(value, types.FunctionType):
            self._put(_name(value))
            self._each([_content(cell) for cell in value.__closure__ or ()], depth)
        elif isinstance(value, types.MethodType):
            self._put(_name(value.__func__))
            self.read(value.__self__, depth)
        elif isinstance(value, functools.partial):
            self._each([value.func, value.args, value.keywords], depth)
        elif isinstance(value, enum.Enum):
            self._put(value.name)
        elif isinstance(value, (*_ATOMS, bytearray, itertools.count, gymnasium.Space)):
            self._put(repr(value))  # that of a space leaves its own generator out, which no reset seeds
        else:
            for name, item in _attributes(value):
                self._put(name)
                self.read(item, depth)

    def _each(self, items: Any, depth: int) -> None:
        self._put(str(len(items)))
        for item in items:
            if type(item) in _PLAIN and self._left > 0:  # as most are in large tables
                self._left -= 1
                self.read_so_far.append(repr(item).encode())
            else:
                self.read(item, depth)


def _name(thing: Any) -> str:
    return f"{getattr(thing, '__module__', '')}.{getattr(thing, '__qualname__', getattr(thing, '__name__', ''))}"


def _content(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # empty: its variable is not bound yet
        return None
