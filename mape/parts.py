"""The parts of a run by the names under which they can be replaced: whose they are, made of their specs.

monitor       the detector, where there is exactly one
monitor.K     the detector number K, from 0
analyze       the analyzer
plan          the planner
plan.schedule its exploration schedule
learner       the learner, which is Execute's
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from mape import registry
from mape.errors import ConfigError, UnknownName
from mape.specs import PartSpec, explain

if TYPE_CHECKING:
    from mape.config import Config

PART_OWNER = {
    "monitor": "monitor",
    "analyze": "analyze",
    "plan": "plan",
    "plan.schedule": "plan",
    "learner": "execute",
}
"""The component that holds a part; ``monitor.K`` is Monitor's too."""


_KINDS = {"analyze": "analyzer", "plan": "planner", "plan.schedule": "schedule", "learner": "learner"}


def kind_of(part: str) -> str:
    """Return the kind that a part is of, whatever run it is in.

    Raises
    ------
    UnknownName
        There is no such part.

    >>> kind_of("monitor.1"), kind_of("plan")
    ('detector', 'planner')
    """
    return "detector" if owner(part) == "monitor" else _KINDS[part]


def owner(part: str) -> str:
    """Return the component that holds a part.

    Raises
    ------
    UnknownName
        There is no such part.

    >>> owner("monitor.1"), owner("learner")
    ('monitor', 'execute')
    """
    if part in PART_OWNER:
        return PART_OWNER[part]
    if re.fullmatch(r"monitor\.(0|[1-9][0-9]*)", part, re.ASCII):
        return "monitor"
    raise UnknownName("part", part, {*PART_OWNER, "monitor.0"}, "monitor.K is the detector number K, from 0.")


def parts_in(config: Config) -> dict[str, tuple[str, PartSpec]]:
    """Return kind and spec of every part of a config that can be replaced, by its name.

    The only detector has two names.
    """
    watched: list[tuple[str, PartSpec]] = [("detector", spec) for spec in config.monitor.detectors]
    return {
        **({"monitor": watched[0]} if len(watched) == 1 else {}),
        **{f"monitor.{k}": one for k, one in enumerate(watched)},
        "analyze": ("analyzer", config.analyze),
        "plan": ("planner", config.plan),
        "plan.schedule": ("schedule", config.plan.schedule),
        "learner": ("learner", config.learner),
    }


def place_of(part: str, config: Config) -> str:
    """Return the one name of a part of `config`: that of the only detector is ``monitor.0``.

    Raises
    ------
    UnknownName
        The config has no such part.
    """
    parts = parts_in(config)
    if part not in parts:
        count = len(config.monitor.detectors)
        raise UnknownName("part", part, parts, f"The run has {count} detectors, a number that is fixed.")
    return "monitor.0" if part == "monitor" else part


def with_part(config: Config, part: str, spec: PartSpec) -> Config:
    """Return the config that has `spec` in the place of a part.

    A detector watches the signal of the one before it, and a planner has the schedule of the one before it, unless
    the spec names another.

    Raises
    ------
    ConfigError
        There is no such part, or the spec is none of its kind. Its options are not looked at.
    """
    place = place_of(part, config)
    kind, before = parts_in(config)[place]
    table = spec.model_dump(exclude_unset=True)
    for kept in ("signal", "schedule"):
        if hasattr(before, kept):
            table.setdefault(kept, before.model_dump()[kept])
    try:
        after: Any = type(before).model_validate(table)
    except ValidationError as error:
        raise ConfigError(explain(error, f"{kind} {spec.name!r} for {part}: ", type(before))) from None
    if kind == "detector":
        k = int(place.removeprefix("monitor."))
        detectors = (*config.monitor.detectors[:k], after, *config.monitor.detectors[k + 1 :])
        return config.model_copy(update={"monitor": config.monitor.model_copy(update={"detectors": detectors})})
    if kind == "schedule":
        return config.model_copy(update={"plan": config.plan.model_copy(update={"schedule": after})})
    return config.model_copy(update={place: after})


def config_at(config: Config, pass_no: int) -> Config:
    """Return the config whose parts serve pass `pass_no`: with every swap up to it made.

    A component that is to go on after that many passes is built from it.

    >>> from mape.config import from_table
    >>> swap = {"pass": 3, "part": "plan", "to": "q_learning"}
    >>> config = from_table({"episodes": 5, "system": {"id": "any"}, "swap": [swap]})
    >>> [config_at(config, number).plan.name for number in (2, 3)]
    ['morphin', 'q_learning']
    """
    for swap in config.swap:
        if swap.pass_no <= pass_no:
            config = with_part(config, swap.part, swap.to)
    return config


def cautions(config: Config) -> list[str]:
    """Return what its detectors say, in sentences, of the signals that they are to watch; those of swaps among them.

    A detector may have a method ``caution(signal)``, which returns such a sentence or None.

    Raises
    ------
    ConfigError
        A detector cannot be made.
    """
    said: list[str] = []
    stages = [config, *(config_at(config, swap.pass_no) for swap in config.swap)]
    watching = {spec.model_dump_json(): spec for at in stages for spec in at.monitor.detectors}
    for spec in watching.values():
        caution = getattr(make("detector", spec), "caution", None)
        if caution is not None and (sentence := caution(spec.signal)) is not None:
            said.append(f"detector {spec.name!r} on signal {spec.signal!r}: {sentence}")
    return said


def make(kind: str, spec: Any) -> Any:
    """Make a part of its spec, a planner with its schedule.

    Raises
    ------
    ConfigError
        Its options are not legal, or it cannot be made.
    """
    if kind == "planner":
        return registry.build(kind, spec, schedule=registry.build("schedule", spec.schedule))
    return registry.build(kind, spec)
