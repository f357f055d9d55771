"""`mapek check`: a part, a system, or the system of a config, against the contract of its port."""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

from adapters.cli.common import config_of, prepare
from mape import registry, testing
from mape.config import SystemConfig
from mape.errors import ConfigError, UnknownName
from mape.specs import PartSpec
from mape.testing import Finding

# The members by which a class of one's own is told; the first kind that has them all.
_MEMBERS = {
    "detector": ("update", "reset"),
    "analyzer": ("analyze",),
    "planner": ("plan", "start"),
    "schedule": ("advance", "reset"),
    "learner": ("value", "step_size"),
}


def execute(chosen: argparse.Namespace) -> int:
    """Run the command; exit code 1 where a clause is broken."""
    prepare()
    if Path(chosen.name).suffix in (".toml", ".json"):
        kind, name, findings = _of_config(chosen)
    else:
        kind, name = chosen.kind or _kind_of(chosen.name), chosen.name
        if chosen.profile or chosen.overrides:
            raise ConfigError(f"--profile and --set are laid over a config; {name!r} is the name of a {kind}")
        findings = _default_system(name) if kind == "system" else testing.CHECKS[kind](_maker(kind, name))
    print(f"{kind} {name}")
    for finding in findings:
        print(f"  {finding}")
    broken = sum(finding.verdict == "failed" for finding in findings)
    print(f"{len(findings)} checks, {broken} failed" if broken else f"{len(findings)} checks, all kept")
    return 1 if broken else 0


def _of_config(chosen: argparse.Namespace) -> tuple[str, str, list[Finding]]:
    if chosen.kind not in (None, "system"):
        raise ConfigError(f"of a config the system is checked; give the name of the {chosen.kind} itself")
    config = config_of(chosen.name, chosen).system
    played = ", from its transition table" if config.tabulated else ""
    return "system", f"{config.id} of {chosen.name}{played}", _system(config)


def _kind_of(name: str) -> str:
    kinds = [kind for kind, parts in registry.PARTS.items() if name in parts]
    if len(kinds) > 1:
        raise ConfigError(f"{name!r} is a {' and a '.join(kinds)}; say which with --kind")
    if kinds:
        return kinds[0]
    _, _, attribute = name.partition(":")
    if not attribute or "/" in name:
        from adapters.systems.checking import is_registered

        if is_registered(name):
            return "system"
        known = {part for parts in registry.PARTS.values() for part in parts}
        raise UnknownName(
            "part or system", name, known, 'A part of your own is "module:Class", a system a Gymnasium id.'
        )
    registry.look_here()
    if _registers(name):
        return "system"
    part = registry.find("detector", name)
    if inspect.isclass(part) and any(base.__module__.startswith("gymnasium.") for base in part.__mro__):
        raise ConfigError(
            f"{name!r} is a Gymnasium environment: have its module register it, and check it under its id, "
            f"{name.partition(':')[0]}:NAME-v0"
        )
    if inspect.isclass(part):
        for kind, members in _MEMBERS.items():
            if all(hasattr(part, member) for member in members):
                return kind
    raise ConfigError(
        f"{name!r} has the members of no part: "
        + "; ".join(f"a {kind} has {', '.join(members)}" for kind, members in _MEMBERS.items())
        + ". Name the kind with --kind to see what is missing."
    )


def _registers(name: str) -> bool:
    """Whether a module, once imported, registers the environment that is named behind the colon."""
    import importlib

    from adapters.systems.checking import is_registered

    module, _, identifier = name.partition(":")
    try:
        importlib.import_module(module)
    except Exception:  # what is wrong with it is said where the part is looked for
        return False
    return is_registered(identifier)


def _maker(kind: str, name: str) -> Callable[[], Any]:
    def make() -> Any:
        schedule = registry.build("schedule", PartSpec(name="exponential"))
        return registry.build(kind, PartSpec(name=name), **({"schedule": schedule} if kind == "planner" else {}))

    make()  # what is wrong with the options is the user's to know, not a broken contract
    return make


def _default_system(name: str) -> list[Finding]:
    from adapters.systems.checking import default_view

    registry.look_here()
    return _system(default_view(name))


def _system(config: SystemConfig) -> list[Finding]:
    from adapters.systems import make_system
    from adapters.systems.checking import check_environment

    registry.look_here()
    return [check_environment(config), *testing.check_system(lambda: make_system(config))]
