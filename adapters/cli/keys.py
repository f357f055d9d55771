"""`mapek keys`: the keys and certificates of a deployment."""

from __future__ import annotations

import argparse
from pathlib import Path

from adapters.buses import certificates
from adapters.buses.security import ROLES
from adapters.roles import KNOWLEDGE


def execute(chosen: argparse.Namespace) -> int:
    """Run the command: make all keys, or with `--renew` those of one role."""
    folder = Path(chosen.folder)
    if chosen.renew:
        key, certificate = certificates.renew(folder, chosen.renew, chosen.host, chosen.days)
        print(f"{key}, {certificate}: good for up to {chosen.days:,} days, once {chosen.renew} is started with them.")
        return 0
    certificates.make(folder, chosen.host, chosen.days)
    print(f"{folder}: an authority, and keys and certificates for {', '.join(ROLES)}; good for {chosen.days:,} days.")
    print(f"{KNOWLEDGE} is reached as {', '.join(dict.fromkeys((*certificates.LOCAL_HOSTS, *chosen.host)))}.")
    print("A host needs ca.pem, and the .pem and .key of its roles. Keep ca.key apart: who has it can be any role.")
    return 0
