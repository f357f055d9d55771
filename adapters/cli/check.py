"""`mapek check`: a part with its options, a system, or the system of a config, against the contract of its port."""

from __future__ import annotations

import argparse
import contextlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from adapters.cli.common import config_of, prepare
from adapters.systems import SYSTEMS
from mape import registry, testing
from mape.config import PlannerSpec, SystemConfig
from mape.config_files import SUFFIXES, find_config, shipped
from mape.errors import ConfigError, UnknownName
from mape.parts import make
from mape.specs import PartSpec, explain
from mape.tables import Table, merge, parse_override
from mape.testing import Finding


def execute(chosen: argparse.Namespace) -> int:
    """Run the command; exit code 1 where a clause is broken."""
    prepare()
    if _is_config(chosen.name):
        kind, name, findings = _of_config(chosen)
    else:
        kind, name, findings = _of_name(chosen)
    print(f"{kind} {name}")
    for finding in findings:
        print(f"  {finding}")
    broken = sum(finding.verdict == "failed" for finding in findings)
    print(f"{len(findings)} checks, {broken} failed" if broken else f"{len(findings)} checks, all kept")
    return 1 if broken else 0


def _is_config(name: str) -> bool:
    """Whether a name is that of a config: by its suffix, or a bare one that no part has."""
    if Path(name).suffix in SUFFIXES:
        return True
    if ":" in name or any(name in parts for parts in registry.PARTS.values()):
        return False
    with contextlib.suppress(ConfigError):
        find_config(name)
        return True
    return False


def _of_config(chosen: argparse.Namespace) -> tuple[str, str, list[Finding]]:
    if chosen.kind not in (None, "system"):
        raise ConfigError(f"of a config the system is checked; give the name of the {chosen.kind} itself")
    config = config_of(chosen.name, chosen).system
    played = ", from its transition table" if config.tabulated else ""
    return "system", f"{config.id} of {chosen.name}{played}", _system(config, chosen.drive)


def _of_name(chosen: argparse.Namespace) -> tuple[str, str, list[Finding]]:
    kind, name = chosen.kind or _kind_of(chosen.name), chosen.name
    if chosen.profile or (chosen.overrides and kind == "system"):
        option = "--profile" if chosen.profile else "--set"
        raise ConfigError(f"{option} is laid over a config; {name!r} is the name of a {kind}")
    if kind == "system":
        return kind, name, _system(SystemConfig(id=name), chosen.drive, by_name=True)
    if chosen.drive is not None:
        raise ConfigError(f"--drive {chosen.drive} is of a system, whose episodes are driven; {name!r} is a {kind}")
    spec = _spec(kind, name, chosen.overrides)
    options = ", ".join(f"{option} = {value!r}" for option, value in spec.options.items())
    return kind, f"{name} ({options})" if options else name, testing.CHECKS[kind](_maker(kind, spec))


def _spec(kind: str, name: str, overrides: list[str]) -> PartSpec:
    """Return a part as a config would have it, with what --set says as its options."""
    table: Table = {}
    for override in overrides:
        table = merge(table, parse_override(override))
    model = PlannerSpec if kind == "planner" else PartSpec
    try:
        return model.model_validate({**table, "name": name})
    except ValidationError as error:
        raise ConfigError(explain(error, f"{kind}.", model)) from None


def _kind_of(name: str) -> str:
    kinds = [kind for kind, parts in registry.PARTS.items() if name in parts]
    if len(kinds) > 1:
        raise ConfigError(f"{name!r} is a {' and a '.join(kinds)}; say which with --kind")
    if kinds:
        return kinds[0]
    from adapters.systems.checking import is_registered

    module, _, attribute = name.partition(":")
    if not attribute or "/" in module:
        if is_registered(name):
            return "system"
        known = {part for parts in registry.PARTS.values() for part in parts}
        raise UnknownName(
            "part, system or config", name, {*known, *SYSTEMS, *shipped()},
            'A part of your own is "module:Class", a system a Gymnasium id, a config a file.',
        )  # fmt: skip
    if module:
        registry.import_for(f"part or system {name!r}", module)  # which registers its environments
    if is_registered(attribute):
        return "system"
    part = registry.find("detector", name)
    if inspect.isclass(part) and any(base.__module__.startswith("gymnasium.") for base in part.__mro__):
        raise ConfigError(
            f"{name!r} is a Gymnasium environment: have its module register it, and check it under its id, "
            f"{module}:NAME-v0"
        )
    if inspect.isclass(part):
        for kind in registry.METHODS:
            if not registry.lacks(kind, part):
                return kind
    raise ConfigError(
        f"{name!r} has the members of no part: "
        + "; ".join(f"a {kind} has {', '.join(methods)}" for kind, methods in registry.METHODS.items())
        + ". Name the kind with --kind to see what is missing."
    )


def _maker(kind: str, spec: PartSpec) -> Callable[[], Any]:
    try:
        make(kind, spec)  # what is wrong with the options is the user's to know, not a broken contract
    except ConfigError as error:
        if spec.options or not isinstance(error.__cause__, TypeError):
            raise
        raise ConfigError(f"{error}; give its options with --set KEY=VALUE") from error
    return lambda: make(kind, spec)


def _system(config: SystemConfig, episodes: int | None, *, by_name: bool = False) -> list[Finding]:
    from adapters.systems.checking import check_managed

    registry.look_here()
    return check_managed(config, episodes, by_name=by_name)
