"""The versions on which the bits of a run depend. `mapek --version` says them, where no run can be made among it."""

from __future__ import annotations

import platform
from importlib import metadata

from mape import __version__


def versions() -> dict[str, str]:
    """Return the versions on which the bits of a run depend, and the processor's architecture."""
    return {
        "mapek": __version__,
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in ("numpy", "numba", "llvmlite", "gymnasium")},
        "libc": "-".join(platform.libc_ver()),
        "architecture": platform.machine(),
    }
