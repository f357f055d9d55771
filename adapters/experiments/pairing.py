"""Which agents can be held against one another: trial by trial, as samples only, or not at all."""

from __future__ import annotations

from typing import Literal, NamedTuple

from adapters.systems.declared import is_plant
from mape.config import Config
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
        if is_plant(config.system):  # no episode can be had again
            return Pairing("independent", f"{config.system.id} is not redrivable, and no seed reaches its luck")
    if first.system.tabulated != second.system.tabulated:
        return Pairing("independent", "only one of them is played from its transition table, by other random numbers")
    return Pairing("paired")
