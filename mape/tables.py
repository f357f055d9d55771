"""Tables of a config: read from TOML or JSON files, laid over one another, overridden."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mape.config_files import find_config
from mape.errors import ConfigError

Table = dict[str, Any]

TOO_DEEP = "tables or lists within one another, more than can be read; a config has a few levels"
"""What is said of them."""


def read_table(named: str | Path, _from: Path | None = None, _seen: tuple[Path, ...] = ()) -> Table:
    """Read a TOML or JSON file, or one of the examples by its bare name, and what it extends."""
    path = find_config(named, _from)
    try:
        text = path.read_text(encoding="utf-8")
        table = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except (tomllib.TOMLDecodeError, json.JSONDecodeError) as error:
        kind = "JSON" if path.suffix == ".json" else "TOML"
        raise ConfigError(f"{path} is not valid {kind}: {error}") from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"config file {str(path)!r} cannot be read: {error}") from None
    except RecursionError:
        raise ConfigError(f"{path} holds {TOO_DEEP}") from None
    if not isinstance(table, dict):
        raise ConfigError(f"{path} holds no table")
    base = table.pop("extends", None)
    if base is None:
        return table
    if not isinstance(base, str):
        raise ConfigError(f"{path}: extends = {base!r} is not the path of another config file")
    if path.resolve() in _seen:
        raise ConfigError(f"{path} extends itself, by way of {' -> '.join(p.name for p in _seen)}")
    below = read_table(base, path.parent, (*_seen, path.resolve()))
    return merge(below, table)


def merge(base: Table, over: Table) -> Table:
    """Lay one table over another; see the module.

    >>> merge({"plan": {"name": "morphin", "k": 5}}, {"plan": {"k": 6}})
    {'plan': {'name': 'morphin', 'k': 6}}
    >>> merge({"plan": {"name": "morphin", "k": 5}}, {"plan": "q_learning"})
    {'plan': 'q_learning'}
    >>> merge({"detectors": ["adwin", {"name": "oracle"}]}, {"detectors": {"0": {"delta": 0.01}}})
    {'detectors': [{'name': 'adwin', 'delta': 0.01}, {'name': 'oracle'}]}
    """
    return base | {key: _lay(base[key], value) if key in base else value for key, value in over.items()}


def _lay(base: Any, over: Any) -> Any:
    if isinstance(base, str) and isinstance(over, dict):
        base = {"name": base}
    if isinstance(base, list) and isinstance(over, dict) and over and all(_counts(key, base) for key in over):
        # By number, as `monitor.detectors.0.threshold=50` names them.
        return [_lay(one, over[str(i)]) if str(i) in over else one for i, one in enumerate(base)]
    if not isinstance(base, dict) or not isinstance(over, dict):
        return over
    if any(key in base and key in over and base[key] != over[key] for key in ("name", "id")):
        return over  # another part or system: the options of the one before mean nothing to it
    return merge(base, over)


def _counts(key: str, entries: list[Any]) -> bool:
    return key in map(str, range(len(entries)))


def parse_override(text: str) -> Table:
    """Read ``a.b=VALUE``; VALUE is TOML, or else a string.

    >>> parse_override("plan.alpha=0.2"), parse_override("plan=q_learning")
    ({'plan': {'alpha': 0.2}}, {'plan': 'q_learning'})
    """
    key, equals, text_value = text.partition("=")
    path = key.strip().split(".")
    if not equals or not all(path):
        raise ConfigError(f"--set {text!r} is not KEY=VALUE with a dotted key, such as plan.alpha=0.2")
    try:
        value = tomllib.loads(f"value = {text_value.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        value = text_value.strip()
    for part in reversed(path):
        value = {part: value}
    table: Table = value
    return table


def refuse_infinity(table: Mapping[str, Any], where: str) -> None:
    """Refuse a table with a number that is not finite: written as JSON, to be kept or sent, it would become another.

    Raises
    ------
    ConfigError
        Names the number and where it stands, after `where`.
    """
    for name, number in _floats(table):
        if not math.isfinite(number):
            raise ConfigError(
                f"{where}{name} = {number} is no finite number, and JSON, as which options are kept and sent, has no "
                "other; give a very large number for infinity, or leave the option out"
            )


def _floats(value: Any, at: str = "") -> Iterator[tuple[str, float]]:
    if isinstance(value, float):
        yield at, value
    elif isinstance(value, Mapping):
        for key, one in value.items():
            yield from _floats(one, f"{at}.{key}" if at else str(key))
    elif isinstance(value, (list, tuple)):
        for i, one in enumerate(value):
            yield from _floats(one, f"{at}[{i}]")


class _Nothing:
    def __repr__(self) -> str:
        return "nothing"


NOTHING = _Nothing()
"""Stands for the value of a name that a table does not have; None is a value."""


def first_difference(one: Any, other: Any, at: str = "") -> tuple[str, Any, Any]:
    """Return the dotted name at which two tables first differ, and what stands there in each, `NOTHING` among it.

    >>> first_difference({"plan": {"alpha": 0.1, "k": 5}}, {"plan": {"alpha": 0.2, "k": 5}})
    ('plan.alpha', 0.1, 0.2)
    >>> first_difference({"plan": {"k": None}}, {"plan": {}})
    ('plan.k', None, nothing)
    """
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        for key in [*one, *other]:
            here, there = (table.get(key, NOTHING) for table in (one, other))
            if here != there:
                return first_difference(here, there, f"{at}.{key}" if at else str(key))
    return at, one, other
