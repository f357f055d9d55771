"""Binds rules to a template, in plain Python or compiled.

A template is a module-level function in whose globals some names are left to be bound: to rules, or to other
templates' bindings. Plain Python gets a copy of the function with these globals. For Numba a module is written that
imports the rules by name, holds the template's source, and is compiled with ``cache=True``; so that

- no formula and no algorithm stands twice;
- a second process compiles nothing: the rules are module-level globals, not closures or arguments, which Numba could
  not cache;
- no stale code is run: Numba's cache looks only at the file of the function itself, so the folder's name holds a hash
  of the source of every module from which a rule comes, of the values that rules find beside their arguments (Numba
  freezes them), and of the versions of all that compiles.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.util
import inspect
import os
import platform
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

from mape.ctrl_c import CtrlC
from mape.errors import ConfigError
from mape.ownership import not_ones_own

Rule = Callable[..., Any]
Bindings = Mapping[str, "Rule | Composed"]
on_compile: list[Callable[[str], object]] = []
"""Called with a sentence before something is compiled that is not in the cache."""


class Uncompilable(ConfigError):
    """A rule that is no module-level function, or that Numba does not compile."""


class Composed:
    """A template with its free names bound.

    Parameters
    ----------
    template
        A module-level function.
    bindings
        Free name -> rule, or -> another `Composed`.
    apart
        Whether another `Composed`, to which this one is bound, calls it as a function that is compiled by itself, and
        once for all who do. Else it becomes a part of the other, which is faster, and takes longer to compile.
    """

    def __init__(self, template: Rule, bindings: Bindings, *, apart: bool = False) -> None:
        self.template = template
        self.bindings = dict(bindings)
        self.apart = apart

    def python(self) -> Rule:
        """Return the bound function as plain Python."""
        bound = {name: rule.python() if isinstance(rule, Composed) else rule for name, rule in self.bindings.items()}
        plain: Any = self.template
        return FunctionType(plain.__code__, {**plain.__globals__, **bound}, plain.__name__, plain.__defaults__)

    def source(self) -> str:
        """Return the text of a module that defines the bound function, compiled."""
        imports: dict[str, str] = {"njit": "from numba import njit"}
        body: list[str] = []
        self._write(imports, {}, body, self.template.__name__, "@njit(cache=True, _nrt=False)")
        head = ['"""Written by mapek; safe to delete."""', "", "from __future__ import annotations", ""]
        return "\n".join([*head, *imports.values(), "", "", *body])

    def _write(
        self, imports: dict[str, str], means: dict[str, Any], body: list[str], name: str, decorator: str
    ) -> None:
        template: Any = self.template
        definition = inspect.getsource(template).split("(", 1)[1]
        for free, rule in self.bindings.items():
            # A template may be bound several times in one module, each time to something else.
            alias = f"{name}__{free}"
            definition = re.sub(rf"(?<![.\w]){free}\b", alias, definition)
            if isinstance(rule, Composed):
                if not rule.apart:
                    rule._write(imports, means, body, alias, "@njit(forceinline=True, _nrt=False)")
                    continue
                rule = rule.compiled().py_func
            _check_importable(rule)
            imports[alias] = f"from {rule.__module__} import {rule.__qualname__} as {alias}"
        for used in sorted(_names(template.__code__)):
            if used in template.__globals__ and used not in self.bindings:
                value = template.__globals__[used]
                if isinstance(value, ModuleType):
                    imports.setdefault(used, f"import {value.__name__} as {used}")
                else:
                    imports.setdefault(used, f"from {template.__module__} import {used}")
                if means.setdefault(used, value) is not value:
                    raise ConfigError(f"two templates mean different things by {used!r}; rename one")
        body.append(f"{decorator}\ndef {name}({definition}\n")

    def rules(self) -> Iterator[Rule]:
        """Yield the template and every rule that it reaches, each once."""
        seen: set[int] = set()
        for _, rule in self._reached():
            if id(rule) not in seen:
                seen.add(id(rule))
                yield rule

    @property
    def compiled_by_others(self) -> bool:
        """Whether it reaches a function that its author compiled, which a call in plain Python would compile too."""
        return any(found is not rule for found, rule in self._reached())

    def _reached(self) -> Iterator[tuple[Any, Rule]]:
        """Yield each function that is reached: as it is found, and as it is in plain Python."""
        seen: set[int] = set()
        pending: list[Any] = [self]
        while pending:
            found = pending.pop()
            if isinstance(found, Composed):
                pending += found.bindings.values()
                found = found.template
            item = getattr(found, "py_func", found)
            if not isinstance(item, FunctionType):
                continue
            yield found, item
            if id(item) not in seen:
                seen.add(id(item))
                # Of a module's functions only those that their author compiled can be called by way of the module.
                pending += [value for name, value in _found(item) if "." not in name or hasattr(value, "py_func")]

    def compiled(self) -> Any:
        """Return the bound function as a Numba dispatcher, from the cache where it can be.

        Raises
        ------
        ConfigError
            A rule is no module-level function, so that no module could import it: an `Uncompilable`. Or compiled code
            can be kept nowhere.
        KeyboardInterrupt
            After a Ctrl-C, when that is done.
        """
        with CtrlC():
            rules = tuple(self.rules())
            for rule in rules:
                _check_importable(rule)
            text = self.source()
            return _load(text, _fingerprint(text, rules), self.template.__name__, rules)


def _check_importable(rule: Any) -> None:
    name = getattr(rule, "__qualname__", None)
    if name is None:
        raise Uncompilable(
            f"{_without_addresses(repr(rule))} cannot be compiled: a rule is a module-level function. Write one, or "
            "choose the engine 'python'."
        )
    if name != rule.__name__ or name == "<lambda>":
        raise Uncompilable(
            f"{rule.__module__}.{name} cannot be compiled: a rule is a module-level function. Move it out of its class "
            "or function, or choose the engine 'python'."
        )


@functools.cache
def _versions() -> str:
    import llvmlite
    import numba

    parts = (sys.version, numba.__version__, llvmlite.__version__, np.__version__, platform.machine())
    return "\n".join(parts)


def _fingerprint(text: str, rules: tuple[Rule, ...]) -> str:
    digest = hashlib.sha256(f"{_versions()}\n{text}".encode())
    modules: set[str] = set()
    for rule in rules:
        plain: Any = rule
        modules |= {plain.__module__, plain.__globals__["__name__"]}  # two, if the rule is what a decorator returned
        for name, value in _found(plain):
            if isinstance(value, ModuleType):
                modules.add(value.__name__)
            elif isinstance(value, type):
                modules.add(value.__module__)
            elif not callable(value):
                digest.update(f"{rule.__qualname__}.{name}=".encode() + _frozen(value))
    for module in sorted(modules):
        # Built-in modules have no source; their version is Python's.
        with contextlib.suppress(KeyError, OSError, TypeError):
            digest.update(inspect.getsource(sys.modules[module]).encode())
    return digest.hexdigest()[:24]


def _found(function: Any) -> Iterator[tuple[str, Any]]:
    """Yield, with its name, each value that a function finds beside its arguments: wherever that was imported from.

    Those are globals, what it looks up in modules, the defaults of its arguments, and what encloses it.
    """
    names = sorted(_names(function.__code__))
    pending = [(name, function.__globals__[name]) for name in names if name in function.__globals__]
    looked_into: set[str] = set()
    while pending:
        name, value = pending.pop()
        yield name, value
        if isinstance(value, ModuleType) and value.__name__ not in looked_into:
            looked_into.add(value.__name__)
            pending += [(f"{name}.{used}", vars(value)[used]) for used in names if used in vars(value)]
    yield "defaults", function.__defaults__ or ()
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        yield name, cell.cell_contents


def _frozen(value: Any) -> bytes:
    """Return bytes that are others where the value is another; the text of a large array leaves most of it out."""
    if isinstance(value, tuple):
        return b"(" + b",".join(map(_frozen, value)) + b")"
    if isinstance(value, (np.ndarray, np.generic)):
        return f"{value.dtype}{value.shape}".encode() + value.tobytes()
    return repr(value).encode()


def _names(code: CodeType) -> set[str]:
    """Return the global names that a function uses, and those of the functions and comprehensions within it."""
    inner = [_names(constant) for constant in code.co_consts if isinstance(constant, CodeType)]
    return set(code.co_names).union(*inner)


def cache_folder() -> Path:
    """Return the folder of compiled code: ``$MAPEK_CACHE``, or ``mapek`` in the user's cache folder.

    Where neither can be written, a folder in the system's temporary one. What is in it will be run, so it is the user's
    own, and nobody else can write there.

    Raises
    ------
    ConfigError
        ``$MAPEK_CACHE`` is somebody else's, or one in which others can write; or none of them can be used.
    """
    named = os.environ.get("MAPEK_CACHE")
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    fallback = Path(tempfile.gettempdir(), f"mapek-{os.getuid()}")
    for folder in (Path(named) if named else Path(base, "mapek"), fallback):
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            # Anybody may have made the one with a name that can be guessed.
            if folder == fallback and (folder.is_symlink() or not_ones_own(folder, 0o700)):
                continue
            if foreign := not_ones_own(folder):
                if named:
                    raise ConfigError(
                        f"MAPEK_CACHE is {named!r}, and {foreign}; the code in it would be run as yours. Name a folder "
                        "of your own, or one that is new"
                    )
                continue
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    raise ConfigError("no folder for compiled code can be written; name one in MAPEK_CACHE")


@functools.cache
def _load(text: str, key: str, name: str, rules: tuple[Rule, ...]) -> Any:
    from numba.extending import register_jitable

    for rule in rules:
        # Lets compiled code call the rule as it stands, whatever module's globals it is found in. Inlining by force:
        # a call that is left standing counts references to every array, ten times the cost of a step.
        register_jitable(forceinline=True)(rule)
    folder = cache_folder() / key
    folder.mkdir(mode=0o700, exist_ok=True)
    path = folder / "composed.py"
    if not path.exists():
        with tempfile.NamedTemporaryFile("w", dir=folder, suffix=".tmp", delete=False, encoding="utf-8") as file:
            file.write(text)
        os.replace(file.name, path)
    spec = importlib.util.spec_from_file_location(f"_mapek_{key}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return getattr(module, name)


def specialise(dispatcher: Any, arguments: tuple[Any, ...], what: str) -> Rule:
    """Return the machine code of `dispatcher` for the types of `arguments`, compiling it where the cache has none.

    It skips the dispatcher's look at the types of each argument, which would cost more than an episode's arithmetic;
    the caller therefore passes the same types every time. `what` is compiled, it says where it has to be, or where it
    cannot and Numba names no rule.

    Raises
    ------
    Uncompilable
        Numba cannot compile a rule.
    KeyboardInterrupt
        After a Ctrl-C, when it is compiled: LLVM calls Python, and loses what is raised there.
    """
    key = (dispatcher, _kind(arguments))
    if key not in _special:
        with CtrlC() as ctrl_c:
            _special[key] = _specialise(dispatcher, arguments, what, ctrl_c)
    return _special[key]


_special: dict[tuple[Any, Any], Rule] = {}

_NUMBERS = frozenset({bool, int, float})
"""Of these, of which a rule has dozens, the type is all."""


def _kind(argument: Any) -> Any:
    """Return what fixes an argument's type in compiled code; Numba's own answer takes longer than many episodes."""
    if isinstance(argument, tuple):
        kinds = map(type, argument)
        return (
            type(argument),
            *[kind if kind in _NUMBERS else _kind(one) for one, kind in zip(argument, kinds, strict=True)],
        )
    if isinstance(argument, np.ndarray):
        flags = argument.flags
        return argument.dtype, argument.ndim, flags.c_contiguous, flags.f_contiguous, flags.writeable, flags.aligned
    return type(argument)


def _specialise(dispatcher: Any, arguments: tuple[Any, ...], what: str, ctrl_c: CtrlC) -> Rule:
    import numba

    try:
        signature = tuple(numba.typeof(argument) for argument in arguments)  # type: ignore[no-untyped-call]
    except Exception as error:
        raise _uncompilable(error, what) from error
    if signature not in dispatcher.overloads:
        folder = Path(dispatcher.py_func.__code__.co_filename).parent
        if not any(folder.glob("__pycache__/*.nbc")):
            for tell in on_compile:
                tell(f"compiling {what}: some seconds, once")
        try:
            dispatcher.compile(signature)
        except Exception as error:  # Numba's own, and what it meets while it looks at a rule
            if ctrl_c.heard:  # a second one, perhaps in a call by LLVM: lost there, with what was compiled
                raise KeyboardInterrupt from error
            raise _uncompilable(error, what) from error
    return dispatcher.overloads[signature].entry_point  # type: ignore[no-any-return]


def _uncompilable(error: Exception, what: str) -> Uncompilable:
    return Uncompilable(
        f"{_why_not(error, what)} Choose the engine 'python' to run it as it is, or keep to what Numba compiles."
    )


def _without_addresses(text: str) -> str:
    return re.sub(r" at 0x[0-9a-fA-F]+", "", text)


def _why_not(error: Exception, what: str) -> str:
    """Say which rule Numba does not compile, and why, in place of its account of all that it tried."""
    lines = [line.strip() for line in str(error).splitlines()]
    names = re.findall(r"Function\(<function (\w+) at ", str(error))
    rule = f"rule {names[0]}" if names else what
    if any(line.startswith(("NRT required", "Only accept returning of array")) for line in lines):
        return (
            f"{rule} cannot be compiled by Numba: it makes an array, a list or a text, and compiled rules allocate "
            "nothing. Let it work in place on the numbers that it is given."
        )
    # Each attempt is a line of its own, and behind the innermost one stands why it failed; the first of these reasons
    # that is not about a call tells most.
    attempts = [line.endswith(")") and "(step: " in line for line in lines]
    reasons = [lines[k] for k in range(1, len(lines)) if attempts[k - 1] and not attempts[k]]
    calls = [reason for reason in reasons if not reason.startswith("No implementation of function Function(<function ")]
    why = next(iter(calls or reasons or lines), type(error).__name__)
    if why.endswith("found for signature:"):
        why += " " + next((line for line in lines[lines.index(why) :] if line.startswith(">>>")), "")
    return f"{rule} cannot be compiled by Numba: {_without_addresses(why).rstrip('.')}."
