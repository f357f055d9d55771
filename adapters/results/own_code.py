"""Which version of the user's own code a run is made with: what decides its bits, and stands in no config."""

from __future__ import annotations

import hashlib
import importlib.util
import site
import sysconfig
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import gymnasium

from mape import registry
from mape.allowed import named_modules
from mape.config import Config

_OURS = ("adapters", "knowledge", "managed_systems", "mape")


def own_modules(configs: Iterable[Config]) -> dict[str, str]:
    """Return module -> SHA-256 of its source file, of each module of the user's own that the configs name.

    Those are the modules of parts, of what is swapped in on the way, and of systems with the class of their
    environment; installed packages are not among them, nor is what a module imports itself.
    """
    found = {}
    for name in sorted({name for config in configs for name in _named(config)}):
        file = _source_of(name)
        if file is not None and not _is_installed(name, file):
            found[name] = _sha256_of(file)
    return found


class OtherVersion(NamedTuple):
    """A module that is not the one that it was: its SHA-256 then and now, None where it is nowhere any more."""

    module: str
    file: Path | None
    then: str
    now: str | None

    def __str__(self) -> str:
        hashes = f"SHA-256 {self.then[:12]} then, {self.now[:12] if self.now else 'none'} now"
        return f"another version of module {self.module!r} ({self.file or 'nowhere now'}): {hashes}"


def other_versions(begun_with: Mapping[str, str]) -> list[OtherVersion]:
    """Return which of these modules, with their hashes, are not the ones that they were; see `own_modules`."""
    files = {name: _source_of(name) for name in begun_with}
    now = {name: None if file is None else _sha256_of(file) for name, file in files.items()}
    return [OtherVersion(name, files[name], then, now[name]) for name, then in begun_with.items() if now[name] != then]


def _source_of(module: str) -> Path | None:
    """Return the file of a module, or None where it is nowhere, or has none."""
    registry.look_here()
    try:
        spec = importlib.util.find_spec(module)
    except Exception:  # of the package around it; what is wrong with that is said where it is imported
        return None
    file = None if spec is None or not spec.has_location or spec.origin is None else Path(spec.origin)
    return file if file is not None and file.is_file() else None


def _sha256_of(file: Path) -> str:
    with open(file, "rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _named(config: Config) -> Iterator[str]:
    """Yield the modules that a config names, and that of its environment's class where it is registered."""
    yield from named_modules(config)
    identifier = config.system.id.rpartition(":")[2]
    if identifier in gymnasium.registry:
        made = gymnasium.registry[identifier].entry_point
        yield made.partition(":")[0] if isinstance(made, str) else str(getattr(made, "__module__", ""))


def _is_installed(module: str, file: Path) -> bool:
    if module.partition(".")[0] in _OURS:
        return True
    paths = (sysconfig.get_path(name) for name in ("purelib", "platlib", "stdlib"))
    return any(file.resolve().is_relative_to(Path(path).resolve()) for path in (*paths, site.getusersitepackages()))
