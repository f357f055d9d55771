"""`mapek list`: what there is, one line each."""

from __future__ import annotations

import argparse

from adapters.cli.common import prepare
from adapters.systems import SYSTEMS
from mape import registry


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    prepare()
    rows = [("system", name, summary) for name, summary in SYSTEMS.items()]
    rows += [(kind, name, entry.summary) for kind, parts in registry.PARTS.items() for name, entry in parts.items()]
    width = max(len(name) for _, name, _ in rows)
    for kind, name, summary in rows:
        print(f"{kind:<9} {name:<{width}}  {summary}")
    return 0
