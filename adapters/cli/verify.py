"""`mapek verify`: what is on disk, held against its checksums."""

from __future__ import annotations

import argparse
from pathlib import Path

from adapters.replay.records import log_of
from adapters.replay.verification import verified, verified_log


def execute(chosen: argparse.Namespace) -> int:
    """Run the command; 1, with the first file that is not as it was written, where there is one."""
    folder = Path(chosen.folder)
    path = log_of(folder)
    found = verified_log(path) if path is not None and path == folder else verified(folder)
    for name, said in found:
        print(f"{name}: {said}", flush=True)
    print(f"{folder} is as it was written")
    return 0
