"""Configs: TOML (or JSON) -> frozen pydantic models. An experiment is data: what runs, how long, which seeds.

A file may name another one to start from (``extends``), and hold overlays: ``[profiles.NAME]`` and ``[agents.NAME]``
are tables laid over the rest when that profile or agent is chosen. Overrides (``plan.alpha=0.2``) come last. A table
that names a part or system (``name = ...``, ``id = ...``) takes the place of one that names another; else tables are
merged.
"""

from __future__ import annotations

import json
import sysconfig
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError, field_validator, model_validator

from mape import registry
from mape.errors import ConfigError, UnknownName
from mape.specs import PartConfig, PartSpec, explain

Table = dict[str, Any]


class DetectorSpec(PartSpec):
    """A detector and the signal that it watches."""

    signal: str = "return"


class LearnerSpec(PartSpec):
    """A learner."""

    name: str = Field("q_learning", min_length=1)


class AnalyzerSpec(PartSpec):
    """An analyzer."""

    name: str = Field("changes", min_length=1)


class ScheduleSpec(PartSpec):
    """An exploration schedule."""

    name: str = Field("exponential", min_length=1)


class PlannerSpec(PartSpec):
    """A planner and its exploration schedule."""

    name: str = Field("morphin", min_length=1)
    schedule: ScheduleSpec = ScheduleSpec()


class BoxGrid(PartConfig):
    """How a box of real observations becomes a table of states: equal bins per dimension.

    Values outside [low, high] fall into the outer bins.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    bins: tuple[int, ...]

    @model_validator(mode="after")
    def _fits(self) -> BoxGrid:
        if not len(self.low) == len(self.high) == len(self.bins) or not self.bins:
            raise ValueError(
                f"low, high and bins name {len(self.low)}, {len(self.high)} and {len(self.bins)} dimensions; each "
                "needs one number per dimension of the observation"
            )
        for low, high, bins in zip(self.low, self.high, self.bins, strict=True):
            if not low < high or bins < 1:
                raise ValueError(f"low = {low}, high = {high}, bins = {bins}: low is below high, bins at least 1")
        return self


class SystemConfig(PartConfig):
    """The managed system: a Gymnasium id, its keyword arguments, and how it is seen."""

    id: str = Field(min_length=1)
    options: dict[str, Any] = Field(default_factory=dict, description="keyword arguments of the environment")
    max_steps: int | None = Field(
        None, ge=1, le=1_000_000, description="longest episode; needed where the system has no cap"
    )
    max_actions: int = Field(64, ge=1, le=4096, description="largest number of actions that the records can hold")
    discretise: BoxGrid | None = None


class MonitorConfig(PartConfig):
    """What is watched, by which detectors; an empty list watches nothing."""

    detectors: tuple[DetectorSpec, ...] = ()


class ExecuteConfig(PartConfig):
    """How episodes are driven."""

    engine: str = "auto"
    mask_greedy: bool = False

    @field_validator("engine")
    @classmethod
    def _known(cls, engine: str) -> str:
        if engine not in ("auto", "compiled", "python"):
            raise ValueError(f"engine {engine!r} is not one of auto, compiled, python")
        return engine


class Config(PartConfig):
    """A whole run."""

    name: str = Field("run", pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")
    description: str = ""
    episodes: int = Field(ge=1, le=1_000_000_000, description="passes of the loop; one episode each")
    trials: int = Field(1, ge=1, le=10_000_000, description="independent repetitions")
    seed: int = Field(0, ge=0, le=2**63 - 1, description="root of all randomness")
    system: SystemConfig
    learner: LearnerSpec = LearnerSpec()
    monitor: MonitorConfig = MonitorConfig()
    analyze: AnalyzerSpec = AnalyzerSpec()
    plan: PlannerSpec = PlannerSpec()
    execute: ExecuteConfig = ExecuteConfig()

    def to_json(self) -> str:
        """Write the config as JSON, from which `from_table` makes it again."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True)


def from_table(table: Mapping[str, Any], where: str = "the config") -> Config:
    """Make a config of a plain table, with every part's options checked.

    Raises
    ------
    ConfigError
        Names each field that is wrong, its value, and what is legal.
    """
    try:
        # From JSON text, where a list may stand for a tuple even in strict mode.
        config = Config.model_validate_json(json.dumps(table, default=lambda value: _refuse(value, where)))
    except ValidationError as error:
        raise ConfigError(explain(error, f"{where}: ", Config)) from None
    for kind, path, spec in parts_of(config):
        registry.options_of(kind, spec, f"{where}: {path}")
    return config


def parts_of(config: Config) -> Iterable[tuple[str, str, PartSpec]]:
    """Yield kind, path and spec of every part that a config names."""
    yield "learner", "learner", config.learner
    for i, detector in enumerate(config.monitor.detectors):
        yield "detector", f"monitor.detectors[{i}]", detector
    yield "analyzer", "analyze", config.analyze
    yield "planner", "plan", config.plan
    yield "schedule", "plan.schedule", config.plan.schedule


def load(
    path: str | Path,
    *,
    profile: str | None = None,
    agent: str | None = None,
    overrides: Iterable[str] = (),
) -> Config:
    """Read a config file; lay profile, agent and overrides over it, in this order.

    Raises
    ------
    ConfigError
        The file cannot be read, or what it says is not legal.
    """
    table = read_table(path)
    for kind, chosen in (("profile", profile), ("agent", agent)):
        overlays = table.pop(f"{kind}s", {})
        if not isinstance(overlays, dict):
            raise ConfigError(f"{path}: {kind}s is a table of tables, [{kind}s.NAME]")
        if chosen is not None:
            if chosen not in overlays:
                raise UnknownName(kind, chosen, overlays, f"They are the [{kind}s.NAME] tables of {path}.")
            if not isinstance(overlays[chosen], dict):
                raise ConfigError(f"{path}: {kind}s.{chosen} is a table, [{kind}s.{chosen}]")
            table = merge(table, overlays[chosen])
    for override in overrides:
        table = merge(table, parse_override(override))
    return from_table(table, str(path))


def overlays_of(path: str | Path, kind: str) -> list[str]:
    """Return the names of a file's profiles or agents, in its order."""
    return list(read_table(path).get(f"{kind}s", {}))


def read_table(path: str | Path, _seen: tuple[Path, ...] = ()) -> Table:
    """Read a TOML or JSON file and what it extends."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        table = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except FileNotFoundError:
        raise ConfigError(f"no config file {str(path)!r}; ready-made ones stand in {_examples()}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"config file {str(path)!r} cannot be read: {error}") from None
    except (tomllib.TOMLDecodeError, json.JSONDecodeError) as error:
        kind = "JSON" if path.suffix == ".json" else "TOML"
        raise ConfigError(f"{path} is not valid {kind}: {error}") from None
    if not isinstance(table, dict):
        raise ConfigError(f"{path} holds no table")
    base = table.pop("extends", None)
    if base is None:
        return table
    if not isinstance(base, str):
        raise ConfigError(f"{path}: extends = {base!r} is not the path of another config file")
    if path.resolve() in _seen:
        raise ConfigError(f"{path} extends itself, by way of {' -> '.join(p.name for p in _seen)}")
    below = read_table(path.parent / base, (*_seen, path.resolve()))
    # What a file adds to another stands for itself: the other's overlays are not its own.
    below.pop("agents", None)
    below.pop("profiles", None)
    return merge(below, table)


def _examples() -> str:
    installed = Path(sysconfig.get_path("data"), "share", "mapek", "examples")
    return str(installed) if installed.is_dir() else "the folder examples of the project"


def merge(base: Table, over: Table) -> Table:
    """Lay one table over another; see the module.

    >>> merge({"plan": {"name": "morphin", "k": 5}}, {"plan": {"k": 6}})
    {'plan': {'name': 'morphin', 'k': 6}}
    >>> merge({"plan": {"name": "morphin", "k": 5}}, {"plan": "q_learning"})
    {'plan': 'q_learning'}
    """
    return base | {key: _lay(base[key], value) if key in base else value for key, value in over.items()}


def _lay(base: Any, over: Any) -> Any:
    if isinstance(base, str) and isinstance(over, dict):
        base = {"name": base}
    if not isinstance(base, dict) or not isinstance(over, dict):
        return over
    if any(key in base and key in over and base[key] != over[key] for key in ("name", "id")):
        return over  # another part or system: the options of the one before mean nothing to it
    return merge(base, over)


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


def _refuse(value: Any, where: str) -> Any:
    raise ConfigError(f"{where}: {value!r} is not a number, text, true or false, or a list or table of such")
