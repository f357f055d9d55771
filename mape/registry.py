"""Parts by name: short names for what is built in, ``"module:Class"`` for everything else, imported when used."""

from __future__ import annotations

import functools
import importlib
import inspect
import json
import os
import sys
from collections.abc import Iterable, Sequence
from types import ModuleType
from typing import Any, NamedTuple

from pydantic import BaseModel, ValidationError

from mape.config_files import examples
from mape.errors import ConfigError, UnknownName
from mape.specs import PartSpec, explain
from mape.states import faults, told


class Entry(NamedTuple):
    """Where a part is, and what it is in one line."""

    target: str
    summary: str


PARTS: dict[str, dict[str, Entry]] = {
    "detector": {
        "page_hinkley": Entry("mape.monitor.page_hinkley:PageHinkley", "one-sided test for a fall of the mean"),
        "two_window": Entry("mape.monitor.two_window:TwoWindow", "z-test of two sliding windows, both sides"),
        "oracle": Entry(
            "mape.monitor.oracle:Oracle", "alarms at the episodes it is given; bounds detection, not return"
        ),
        # Of the adapters, by name alone: a config means the same to a program of one's own and to the command.
        "river": Entry(
            "adapters.detectors.river_detector:RiverDetector",
            "any drift detector of River by name; DDM, EDDM, HDDMA, HDDMW take 1 as an error (invert = true for a "
            "return of 0 and 1); needs the package river",
        ),
        "adwin": Entry(
            "adapters.detectors.river_detector:Adwin",
            "River's ADWIN: adaptive window, both sides; needs the package river",
        ),
    },
    "analyzer": {
        "changes": Entry("mape.analyze.changes:Changes", "every alarm is a drift; action sets are compared"),
    },
    "planner": {
        "morphin": Entry("mape.plan.morphin:Morphin", "resets exploration on change; learning rate by TD error"),
        "q_learning": Entry("mape.plan.q_learning:QLearningPlanner", "fixed learning rate, no response to change"),
    },
    "schedule": {
        "exponential": Entry("mape.plan.exponential:Exponential", "exponential decay since the last response"),
        "success": Entry("mape.plan.success:Success", "exponential, and the success rule after the first response"),
        "geometric": Entry("mape.plan.geometric:Geometric", "a factor per episode since the last response"),
        "constant": Entry("mape.plan.constant:Constant", "one exploration rate for ever"),
    },
    "learner": {
        "q_learning": Entry("mape.execute.rules:QLearning", "Q-learning with the step size alpha*"),
        "expected_sarsa": Entry("mape.execute.rules:ExpectedSarsa", "Expected Sarsa with the step size alpha*"),
    },
}

METHODS: dict[str, tuple[str, ...]] = {
    "detector": ("update", "reset"),
    "analyzer": ("analyze",),
    "planner": ("start", "plan"),
    "schedule": ("advance", "reset"),
    "learner": ("value", "step_size"),
}
"""What the loop calls of a part, and its class therefore has; a class without is never called."""

VALUES: dict[str, tuple[str, ...]] = {
    "detector": ("direction", "statistic"),
    "schedule": ("epsilon",),
    "learner": ("rate_names", "discount", "bootstrap_terminal"),
}
"""What the loop reads of a part besides, once it is made. `mapek check` asks for more."""


def register(kind: str, name: str, target: str, summary: str) -> None:
    """Give a part a short name."""
    PARTS.setdefault(kind, {})[name] = Entry(target, summary)


def look_here() -> None:
    """Let modules in the present folder be found, after installed ones, and after all others those of the examples."""
    for folder in (os.getcwd(), last := str(examples())):
        if folder not in sys.path:
            sys.path.insert(sys.path.index(last) if last in sys.path else len(sys.path), folder)


def import_for(named: str, module_name: str) -> ModuleType:
    """Import the module of what is `named` in messages, from the present folder too.

    Raises
    ------
    ConfigError
        There is no such module, it lacks another one, or it raises.
    """
    if module_name not in sys.modules:  # as it is for all trials but the first
        look_here()
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is not None and (module_name == error.name or module_name.startswith(error.name + ".")):
            raise ConfigError(
                f"{named}: there is no module {error.name!r} in this folder, {os.getcwd()}, nor on Python's path "
                "(installed packages, PYTHONPATH)"
            ) from None
        raise ConfigError(f"{named} needs the package {error.name!r}, which is not installed") from error
    except faults() as error:
        raise ConfigError(f"{named}: its module raised {told(error)}") from error


def entry(kind: str, name: str) -> Entry:
    """Return what stands behind a short name.

    Raises
    ------
    UnknownName
        Nothing does.
    """
    if name not in PARTS[kind]:
        raise UnknownName(kind, name, PARTS[kind], 'A part of your own is named "module:Class".')
    return PARTS[kind][name]


def find(kind: str, name: str) -> Any:
    """Return the class behind a short name or ``"module:Class"``.

    Raises
    ------
    ConfigError
        No such short name, module or class, or the module cannot be imported.
    """
    target = name if ":" in name and name not in PARTS[kind] else entry(kind, name).target
    module_name, _, attribute = target.partition(":")
    if not module_name or not attribute:
        raise ConfigError(f'{kind} {name!r} is not of the form "module:Class", such as "my_parts:MyDetector"')
    module = import_for(f"{kind} {name!r}", module_name)
    try:
        return getattr(module, attribute)
    except AttributeError:
        classes = [n for n, value in vars(module).items() if inspect.isclass(value) and value.__module__ == module_name]
        raise UnknownName(f"class of {module_name}", attribute, classes) from None


def lacks(kind: str, part: Any) -> tuple[str, ...]:
    """Return which methods of a kind a class does not have; it is looked at, and not called.

    >>> import subprocess
    >>> lacks("detector", subprocess.Popen)
    ('update', 'reset')
    """
    return tuple(name for name in METHODS.get(kind, ()) if not callable(inspect.getattr_static(part, name, None)))


@functools.cache  # asked for each part of each trial
def _lacks(kind: str, part: Any) -> tuple[str, ...]:
    return lacks(kind, part)


def _check_class(kind: str, name: str, part: Any) -> None:
    # Before anything of it is called: what a name leads to may be any class or function that can be imported.
    if not inspect.isclass(part):
        raise ConfigError(
            f"{kind} {name!r} is a {type(part).__name__}, and a part is made of a class. Name the class of it, "
            '"module:Class"'
        )
    made: Any = part  # mypy knows no hash of a class
    if missing := _lacks(kind, made):
        unseen = [value for value in VALUES.get(kind, ()) if not hasattr(part, value)]
        raise ConfigError(_incomplete(kind, name, [*unseen, *missing]))


def _incomplete(kind: str, name: str, missing: Sequence[str]) -> str:
    return f"{kind} {name!r} has no {', '.join(missing)}; see {kind.capitalize()} in mape.ports"


def options_of(kind: str, spec: PartSpec, where: str) -> tuple[Any, Any]:
    """Return the class of a part, and its options: a checked model, or a table where the class declares none.

    Raises
    ------
    ConfigError
        It is no class with the methods of its kind, or an option is not legal.
    """
    part = find(kind, spec.name)
    _check_class(kind, spec.name, part)
    model = getattr(part, "Config", None)
    if isinstance(model, type) and issubclass(model, BaseModel):
        try:
            return part, model.model_validate_json(json.dumps(spec.options))
        except ValidationError as error:
            raise ConfigError(explain(error, f"{where}.", model)) from None
    return part, spec.options


def _refuse_unread(kind: str, spec: Any, names: Iterable[str]) -> None:
    """Refuse what a config says of a part of this part, a planner's schedule, where that takes none."""
    for name in names:
        said = getattr(spec, name, None)
        if said is not None and said != type(spec).model_fields[name].get_default(call_default_factory=True):
            raise ConfigError(
                f"{kind} {spec.name!r} takes no {name}, and the config gives it {said.name!r}, which nothing would "
                f"read. Leave it out, or let the class take an argument {name}"
            )


def build(kind: str, spec: PartSpec, **extra: Any) -> Any:
    """Make a part; `extra` (a planner's schedule) is passed on by name where the part takes it.

    Raises
    ------
    ConfigError
        It is no class with the methods of its kind, the options are not legal, or the part cannot be made.
    """
    part, options = options_of(kind, spec, kind)
    try:
        if isinstance(options, BaseModel):
            made = part(options, **extra)
        else:
            taken = {name: value for name, value in extra.items() if name in inspect.signature(part).parameters}
            _refuse_unread(kind, spec, extra.keys() - taken.keys())
            made = part(**options, **taken)
        missing = [value for value in VALUES.get(kind, ()) if not hasattr(made, value)]
    except ConfigError:
        raise
    except faults() as error:
        raise ConfigError(
            f"{kind} {spec.name!r} cannot be made with {options or 'no options'}: {told(error)}"
        ) from error
    if missing:
        raise ConfigError(_incomplete(kind, spec.name, missing))
    return made
