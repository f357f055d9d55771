"""Which agents can be held against one another: trial by trial, as samples only, or not at all."""

from __future__ import annotations

import importlib
from typing import Any, Literal, NamedTuple

import gymnasium
from gymnasium.envs.registration import load_env_creator

from mape.config import Config, SystemConfig
from mape.tables import first_difference

PROCESS = ("id", "options", "max_steps", "discretise")
"""What of a system's config says what is controlled. The rest says how it is seen, played or begun again."""


class Pairing(NamedTuple):
    """How a second agent is held against the first.

    Attributes
    ----------
    kind : ``"paired"``, trial by trial, as both share the luck of their trial's seed; ``"independent"``, as samples
        that share nothing; ``"apart"``, not at all.
    reason : why it is not paired, as a clause.
    """

    kind: Literal["paired", "independent", "apart"]
    reason: str = ""


def pairing(first: Config, second: Config) -> Pairing:
    """Say how `second` is held against `first`, whose seeds, trials and episodes are equal."""
    here, there = (
        {name: value for name, value in config.system.model_dump(mode="json").items() if name in PROCESS}
        for config in (first, second)
    )
    if here != there:
        what, one, other = first_difference(here, there)
        return Pairing("apart", f"system.{what} is {one!r} of the first and {other!r} of this one")
    for config in (first, second):
        if not reached_by_seeds(config.system):
            return Pairing("independent", f"{config.system.id} is not redrivable, and no seed reaches its luck")
    if first.system.tabulated != second.system.tabulated:
        return Pairing("independent", "only one of them is played from its transition table, by other random numbers")
    return Pairing("paired")


def reached_by_seeds(config: SystemConfig) -> bool:
    """Whether a trial's seed decides what the system does: not so where no episode can be had again."""
    if config.redrivable is not None:
        return config.redrivable
    module, _, name = config.id.rpartition(":")
    if module:
        importlib.import_module(module)
    spec = gymnasium.registry.get(name)
    if spec is None or spec.entry_point is None:
        return True
    maker: Any = spec.entry_point
    return bool(getattr(load_env_creator(maker) if isinstance(maker, str) else maker, "redrivable", True))
