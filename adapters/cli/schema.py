"""`mapek schema`: the wire as an AsyncAPI document."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from adapters.buses.asyncapi import document
from adapters.results.files import write_json


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    if chosen.out is None:
        print(json.dumps(document(), indent=2))
    else:
        write_json(Path(chosen.out), document())
    return 0
