"""Whose modules a part may come from that somebody else names: over the wire, or in a log.

What a user writes into a config, or types, is the user's own. A part that is asked for while a loop runs, or that a log
holds, names a module as text; to import it is to run it. So it is looked at before: it is one that the config names, it
stands in the working folder, or it is built in or registered.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterable
from pathlib import Path

from mape import registry
from mape.config import Config, parts_of
from mape.errors import ConfigError
from mape.parts import with_part
from mape.specs import PartSpec


def check_part(config: Config, part: str, spec: PartSpec) -> None:
    """Look whether the modules of a part that somebody else names may be imported; nothing is imported here.

    Parameters
    ----------
    config
        The run's, whose modules are allowed.
    part, spec
        What is replaced, and by what; what it has in turn, as a planner has a schedule, is held to the same.

    Raises
    ------
    ConfigError
        A module is not allowed; or the config has no such part.
    """
    named = set(named_modules(config))
    for kind, where, each in parts_of(with_part(config, part, spec)):
        if each.name in registry.PARTS[kind] or ":" not in each.name:  # the second is an unknown name, and told so
            continue
        module = each.name.partition(":")[0]
        if module not in named and not _is_registered(module) and not _stands_here(module):
            raise ConfigError(
                f"{kind} {each.name!r} ({where}) is of the module {module!r}, which is not imported because it was "
                f"asked for: a part from outside is built in or registered, or of a module that the config names "
                f"({', '.join(sorted(named)) or 'it names none'}) or that stands in this working folder, "
                f"{os.getcwd()}. Put it there, or name a part of it in the config"
            )


def named_modules(config: Config) -> Iterable[str]:
    """Yield the modules that a config names: of its parts, of what is planned to be swapped in, and of its system."""
    for kind, _, spec in parts_of(config):
        if spec.name not in registry.PARTS[kind]:
            yield spec.name.partition(":")[0]
    module, colon, _ = config.system.id.rpartition(":")
    if colon:
        yield module


def _is_registered(module: str) -> bool:
    return any(
        entry.target.partition(":")[0] == module for entries in registry.PARTS.values() for entry in entries.values()
    )


def _stands_here(module: str) -> bool:
    """Whether Python would find a module in the present folder, which it looks at last."""
    registry.look_here()
    top = module.partition(".")[0]
    try:
        found = importlib.util.find_spec(top)  # of a name without dots: imports nothing
    except (ImportError, ValueError):
        return False
    if found is None:
        return False
    here = Path.cwd()
    places = [found.origin] if found.has_location else [*(found.submodule_search_locations or ())]
    allowed = {here / f"{top}.py", here / top / "__init__.py", here / top}
    return bool(places) and all(place is not None and Path(place) in allowed for place in places)
