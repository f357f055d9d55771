"""Configs: TOML (or JSON) -> frozen pydantic models. An experiment is data: what runs, how long, which seeds.

A file may name another one to start from (``extends``), and hold overlays: ``[profiles.NAME]`` and ``[agents.NAME]``
are tables laid over the rest when that profile or agent is chosen; those of the file that is extended are among them,
and one of the same name is laid over the other's. Overrides (``plan.alpha=0.2``) come last. A table
that names a part or system (``name = ...``, ``id = ...``) takes the place of one that names another; else tables are
merged.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from mape import registry
from mape.errors import ConfigError, UnknownName
from mape.parts import owner, parts_in, place_of, with_part
from mape.specs import PartConfig, PartSpec, explain
from mape.tables import TOO_DEEP, Table, merge, parse_override, read_table, refuse_infinity


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
            if math.isinf(high - low):
                raise ValueError(f"low = {low}, high = {high}: they are too far apart for a float; bring them together")
        return self


class SystemConfig(PartConfig):
    """The managed system: a Gymnasium id, its keyword arguments, and how it is seen."""

    id: str = Field(min_length=1)
    options: dict[str, Any] = Field(default_factory=dict, description="keyword arguments of the environment")
    max_steps: int | None = Field(
        None,
        ge=1,
        le=1_000_000,
        description="longest episode; at most the system's own cap, and needed where it has none",
    )
    max_actions: int = Field(64, ge=1, le=4096, description="largest number of actions that the records can hold")
    discretise: BoxGrid | None = None
    tabulated: bool = Field(
        False, description="play the environment's own transition table, by rules that can be compiled"
    )
    redrivable: bool | None = Field(
        None, description="whether an episode can be driven again after others; by default as the system says, or true"
    )
    retries: int = Field(
        0, ge=0, le=1_000_000, description="how often an episode that the system broke off is begun again"
    )

    reset_takes: tuple[Literal["seed", "options"], ...] = Field(
        ("seed", "options"),
        description="what the environment's reset is given; leave out what it does not take. Without a seed no episode "
        "can be driven again, if redrivable does not say otherwise",
    )

    @model_validator(mode="after")
    def _one_view(self) -> SystemConfig:
        if self.tabulated and self.discretise is not None:
            raise ValueError(
                "tabulated = true plays a table of states, and discretise makes one of real observations; leave one out"
            )
        return self


class MonitorConfig(PartConfig):
    """What is watched, by which detectors; an empty list watches nothing."""

    detectors: tuple[DetectorSpec, ...] = ()


ENGINES = ("auto", "compiled", "python")
MODES = ("lockstep", "free")


class ExecuteConfig(PartConfig):
    """How episodes are driven."""

    engine: str = "auto"
    mask_greedy: bool = False
    mode: str = Field("lockstep", description="lockstep: an episode waits for its plan; free: it never does")
    rate: float | None = Field(None, gt=0, description="episodes per second of a free-running system")
    backlog: int = Field(1000, ge=1, description="observations that a free-running system holds back before it drops")

    @field_validator("engine")
    @classmethod
    def _known(cls, engine: str) -> str:
        if engine not in ENGINES:
            raise ValueError(str(UnknownName("engine", engine, ENGINES)))
        return engine

    @field_validator("mode")
    @classmethod
    def _either(cls, mode: str) -> str:
        if mode not in MODES:
            raise ValueError(str(UnknownName("mode", mode, MODES)))
        return mode

    @model_validator(mode="after")
    def _paced(self) -> ExecuteConfig:
        if self.mode == "free" and self.rate is None:
            raise ValueError(
                "mode 'free' needs a rate: the system is paced by it, in episodes per second, such as rate = 10.0"
            )
        if self.mode == "lockstep" and self.rate is not None:
            raise ValueError(
                f"rate = {self.rate} paces a free-running system; in lockstep each episode waits for its plan, and "
                "nothing else sets the pace. Leave rate out, or choose mode = 'free'"
            )
        held = type(self).model_fields["backlog"].default
        if self.mode == "lockstep" and self.backlog != held:
            raise ValueError(
                f"backlog = {self.backlog} is of a free-running system; in lockstep no observation is held back. Leave "
                "backlog out, or choose mode = 'free'"
            )
        return self


class SwapConfig(PartConfig):
    """A part that is replaced in the running loop, between two passes."""

    pass_no: int = Field(alias="pass", ge=1, description="first pass that the new part serves")
    part: str = Field(description="monitor, monitor.K, analyze, plan, plan.schedule or learner")
    to: PartSpec

    @field_validator("part")
    @classmethod
    def _known(cls, part: str) -> str:
        try:
            owner(part)
        except UnknownName as error:
            raise ValueError(str(error)) from None
        return part


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
    loops: int = Field(1, ge=1, le=4096, description="loops of each trial, every one over a system of its own")
    swap: tuple[SwapConfig, ...] = Field((), description="parts that are replaced on the way, in order of pass")

    @field_validator("swap")
    @classmethod
    def _in_order(cls, swaps: tuple[SwapConfig, ...]) -> tuple[SwapConfig, ...]:
        return tuple(sorted(swaps, key=lambda swap: swap.pass_no))

    @model_validator(mode="after")
    def _swappable(self) -> Config:
        made: set[tuple[int, str]] = set()
        for swap in self.swap:
            if swap.pass_no > self.episodes:
                raise ValueError(
                    f"a swap of {swap.part} at pass {swap.pass_no} is never made in a run of {self.episodes} episodes"
                )
            try:
                place = place_of(swap.part, self)
            except UnknownName as error:
                raise ValueError(f"swap at pass {swap.pass_no}: {error}") from None
            if (swap.pass_no, place) in made:
                raise ValueError(f"two swaps of {swap.part} at pass {swap.pass_no}; leave one of them")
            made.add((swap.pass_no, place))
        return self

    @property
    def units(self) -> int:
        """Number of independent units of work: each loop of each trial."""
        return self.trials * self.loops

    def unit(self, trial: int, loop: int) -> int:
        """Return the number of a unit, from 0: the number of the loop in the records.

        Raises
        ------
        ConfigError
            The config has no such loop.
        """
        if not 0 <= loop < self.loops:
            raise ConfigError(f"loop {loop} is not one of the {self.loops} loops of a trial, which count from 0")
        return trial * self.loops + loop

    def unit_name(self, trial: int, loop: int) -> str:
        """Return what a unit is called in messages: ``trial 3``, or ``trial 3, loop 1`` where a trial has several."""
        return f"trial {trial}" if self.loops == 1 else f"trial {trial}, loop {loop}"

    def to_json(self) -> str:
        """Write the config as JSON, from which `from_table` makes it again."""
        return json.dumps(self.model_dump(mode="json", by_alias=True), sort_keys=True)


def from_table(table: Mapping[str, Any], where: str = "the config") -> Config:
    """Make a config of a plain table, with every part's options checked, for which its class is imported.

    Raises
    ------
    ConfigError
        Names each field that is wrong, its value, and what is legal.
    """
    config = from_foreign_table(table, where)
    for kind, path, spec in parts_of(config):
        registry.options_of(kind, spec, f"{where}: {path}")
    refuse_infinity(table, f"{where}: ")  # of options that no model has looked at
    return config


def from_foreign_table(table: Mapping[str, Any], where: str = "the config") -> Config:
    """Make a config of a plain table that somebody else may have written: nothing is imported, no option looked at.

    Raises
    ------
    ConfigError
        Names each field that is wrong, its value, and what is legal.
    """
    try:
        # From JSON text, where a list may stand for a tuple even in strict mode.
        return Config.model_validate_json(json.dumps(table, default=lambda value: _refuse(value, where)))
    except ValidationError as error:
        if "recursion limit" in error.errors()[0]["msg"]:  # pydantic's, which is below Python's
            raise ConfigError(f"{where} holds {TOO_DEEP}") from None
        raise ConfigError(explain(error, f"{where}: ", Config)) from None


def parts_of(config: Config) -> Iterable[tuple[str, str, PartSpec]]:
    """Yield kind, path and spec of every part that a config names, those of its swaps as they will stand among them.

    Raises
    ------
    ConfigError
        What a swap names is no part of its kind.
    """
    yield "learner", "learner", config.learner
    for i, detector in enumerate(config.monitor.detectors):
        yield "detector", f"monitor.detectors[{i}]", detector
    yield "analyzer", "analyze", config.analyze
    yield "planner", "plan", config.plan
    yield "schedule", "plan.schedule", config.plan.schedule
    after = config
    for swap in config.swap:
        path = f"swap(pass {swap.pass_no}).to"
        after = with_part(after, swap.part, swap.to)
        kind, spec = parts_in(after)[swap.part]
        yield kind, path, spec
        if isinstance(spec, PlannerSpec):
            yield "schedule", f"{path}.schedule", spec.schedule


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
        The file cannot be read, or what it says is not legal, or an override, which is then named.
    """
    chosen = [f"{kind} {name}" for kind, name in (("profile", profile), ("agent", agent)) if name is not None]
    where, given = ", ".join([str(path), *chosen]), list(overrides)
    try:
        table = _laid_over(path, profile, agent)
        whole = table
        for override in given:
            whole = merge(whole, parse_override(override))
        try:
            return from_table(whole, where)
        except ConfigError:
            _blame(table, given, where)
            raise
    except RecursionError:
        raise ConfigError(f"{path}, with what is laid over it, holds {TOO_DEEP}") from None


def _blame(table: Table, overrides: list[str], where: str) -> None:
    """Raise what is wrong with a config under the name of the override that makes it so; return where none does."""
    said = where
    for override in ["", *overrides]:
        if override:
            table, said = merge(table, parse_override(override)), f"--set {override}, over {where}"
        try:
            from_table(table, said)
        except ConfigError:
            if not override:
                return
            raise


def _laid_over(path: str | Path, profile: str | None, agent: str | None) -> Table:
    table = read_table(path)
    for kind, chosen in (("profile", profile), ("agent", agent)):
        overlays = _overlays(path, table, kind)
        table.pop(f"{kind}s", None)
        if chosen is not None:
            if chosen not in overlays:
                raise UnknownName(kind, chosen, overlays, f"They are the [{kind}s.NAME] tables of {path}.")
            if not isinstance(overlays[chosen], dict):
                raise ConfigError(f"{path}: {kind}s.{chosen} is a table, [{kind}s.{chosen}]")
            table = merge(table, overlays[chosen])
    return table


def overlays_of(path: str | Path, kind: str) -> list[str]:
    """Return the names of a file's profiles or agents, in its order.

    Raises
    ------
    ConfigError
        The file cannot be read, or they are no tables.
    """
    return list(_overlays(path, read_table(path), kind))


def _overlays(path: str | Path, table: Table, kind: str) -> Table:
    overlays: Any = table.get(f"{kind}s", {})
    if not isinstance(overlays, dict):
        raise ConfigError(f"{path}: {kind}s is a table of tables, [{kind}s.NAME]")
    return overlays


def _refuse(value: Any, where: str) -> Any:
    raise ConfigError(f"{where}: {value!r} is not a number, text, true or false, or a list or table of such")
