"""`mapek schema`: the wire as an AsyncAPI document."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

from adapters.buses.asyncapi import document
from adapters.results.files import write_json
from mape.errors import ConfigError


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    if chosen.out is None:
        print(json.dumps(document(), indent=2))
        return 0
    path = Path(chosen.out)
    if os.path.isdir(path):
        raise ConfigError(f"--out {chosen.out!r} is a folder; name a file")
    if not os.path.isdir(path.absolute().parent):
        raise ConfigError(f"--out {chosen.out!r}: there is no folder {str(path.parent)!r} to hold it; make it first")
    write_json(path, document(), "Make room, or choose another place for --out.")
    return 0
