"""mapek: self-adaptive systems as an explicit Monitor - Analyze - Plan - Execute loop over shared Knowledge."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mape.bus import LocalBus
    from mape.config import Config, from_table, load
    from mape.errors import (
        BusError,
        ConfigError,
        ManagedSystemError,
        MapekError,
        NonFiniteError,
        PartError,
        ResultsError,
        UnknownName,
    )
    from mape.loop import Loop
    from mape.specs import PartConfig
    from mape.trials import TrialResult, run_trial

__version__ = "0.2.0.dev1"

_HOMES = {
    "mape.bus": ("LocalBus",),
    "mape.config": ("Config", "from_table", "load"),
    "mape.errors": (
        "BusError",
        "ConfigError",
        "ManagedSystemError",
        "MapekError",
        "NonFiniteError",
        "PartError",
        "ResultsError",
        "UnknownName",
    ),
    "mape.loop": ("Loop",),
    "mape.specs": ("PartConfig",),
    "mape.trials": ("TrialResult", "run_trial"),
}

__all__ = [
    "BusError",
    "Config",
    "ConfigError",
    "LocalBus",
    "Loop",
    "ManagedSystemError",
    "MapekError",
    "NonFiniteError",
    "PartConfig",
    "PartError",
    "ResultsError",
    "TrialResult",
    "UnknownName",
    "from_table",
    "load",
    "run_trial",
]


def __getattr__(name: str) -> Any:
    # On first use: `mapek --help` must not pay for pydantic and NumPy.
    for home, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(home), name)
    raise AttributeError(f"module 'mape' has no attribute {name!r}")
