"""`mapek run`: one config, one agent, any number of trials, each of one or several loops."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import numpy.typing as npt

from adapters.cli.common import config_of, finish, looking, open_folder, prepare, say
from adapters.cli.sentences import sentence
from adapters.experiments.decimals import plain
from adapters.experiments.runner import run_agents
from adapters.experiments.statistics import summary
from adapters.results import RunFolder
from adapters.systems.lending import Lender
from knowledge import STAGES, QTable, Record
from mape.config import Config
from mape.errors import ConfigError
from mape.loop import Loop
from mape.swap import swap_sentence
from mape.trials import TrialResult, combined_hash


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    prepare()
    config = config_of(chosen.config, chosen, chosen.agent)
    label = chosen.agent or config.name
    for option, span in (("--show", chosen.show), ("--trace", chosen.trace)):
        if span is not None and span[1] > config.episodes:
            raise ConfigError(f"{option} {span[0]}:{span[1]} goes beyond the run's {config.episodes} episodes")
    watch = None if chosen.show is None else _shower(chosen, *chosen.show)
    with (
        Lender() as lend,
        open_folder(chosen, "run", config.name, {label: config}, chosen.trace, looking(lend)) as folder,
    ):
        results = run_agents(
            {label: config},
            folder,
            workers=chosen.workers,
            trace=chosen.trace,
            quiet=chosen.quiet,
            prepare=watch,
            lend=lend,
        )[label]
        result = as_json(config, results)
        report(chosen, config, results, folder.last_episodes(label, "return", min(100, config.episodes)))
        say_untaught(chosen, config, results, folder, label)
        figures = []
        if not chosen.no_figures:
            from adapters.experiments.pictures import pictures_of_run

            figures = pictures_of_run(folder, label)
        finish(chosen, folder, result, figures)
    return 0


def as_json(config: Config, results: list[TrialResult]) -> dict[str, Any]:
    """Return what `run --json` writes: every unit, the loops of trial 0 first; its loop where a trial has several."""
    swaps = [
        {"pass": swap.pass_no, "part": swap.part, "to": swap.to.model_dump(mode="json"), "handed_over": kept}
        for swap, kept in zip(config.swap, results[0].handed_over, strict=True)
    ]
    return {
        "name": config.name,
        "passes": config.episodes,
        "seed": config.seed,
        **({"loops": config.loops} if config.loops > 1 else {}),
        **({"swaps": swaps} if swaps else {}),
        "trials": [
            {
                "trial": r.trial,
                **({"loop": r.loop} if config.loops > 1 else {}),
                "alarms": list(r.alarms),
                "total_steps": r.total_steps,
                **({"dropped": r.dropped} if config.execute.mode == "free" else {}),
                **({"aborted": aborted_as_json(r)} if r.aborted else {}),
                "log_sha256": r.log_sha256 or None,
                "q_table_sha256": r.q_table_sha256,
            }
            for r in results
        ],
        "log_sha256": None if config.execute.mode == "free" else combined_hash(r.log_sha256 for r in results),
        "q_table_sha256": combined_hash(r.q_table_sha256 for r in results),
    }


def aborted_as_json(result: TrialResult) -> list[dict[str, Any]]:
    """Return the attempts at episodes that the system broke off in one unit."""
    return [{"episode": number, "why": why} for number, why in result.aborted]


def say_aborted(chosen: argparse.Namespace, config: Config, results: list[TrialResult], of: str = "") -> None:
    """Print which episodes were begun again, where any were."""
    aborted = [(r, number, why) for r in results for number, why in r.aborted]
    if not aborted:
        return
    attempts = "1 attempt at an episode was" if len(aborted) == 1 else f"{len(aborted):,} attempts at episodes were"
    say(chosen, f"aborted:  {attempts} broken off by the system, and begun again{of}; the first:")
    for r, number, why in aborted[:3]:
        unit = f"{config.unit_name(r.trial, r.loop)}, " if config.units > 1 else ""
        say(chosen, f"          {unit}episode {number}: {why}")


def say_untaught(
    chosen: argparse.Namespace, config: Config, results: list[TrialResult], folder: RunFolder, agent: str
) -> None:
    """Print how many units learned nothing, where any did: those whose Q-table ends as a fresh one, all zeros."""
    values, actions = folder.q_table(agent, 0)
    fresh = QTable(actions, values.shape[1]).sha256()
    if not (untaught := sum(r.q_table_sha256 == fresh for r in results)):
        return
    of = "" if config.units == 1 else f" in {untaught:,} of {config.units:,} {_units(config)}"
    say(
        chosen,
        f"learned:  nothing{of}: no reward but 0 was met, and the Q-table of {agent} is as it began. More exploration "
        "(plan.schedule), longer episodes (system.max_steps) or more of them may meet one",
    )


def _units(config: Config) -> str:
    return "trials" if config.loops == 1 else "loops of all trials"


def report(chosen: argparse.Namespace, config: Config, results: list[TrialResult], last: npt.NDArray[Any]) -> None:
    """Print what came out; `last` are the returns of the last episodes of each unit, NaN where one was dropped."""
    steps = summary(np.array([r.total_steps for r in results]))
    say(chosen, f"{config.name}: {config.description or config.system.id}")
    say(chosen, f"system:   {config.system.id}")
    loops = f", loops of each: {config.loops:,}" if config.loops > 1 else ""
    say(chosen, f"episodes: {config.episodes:,}, trials: {config.trials:,}{loops}, seed: {config.seed}")
    if dropped := sum(r.dropped for r in results):
        say(chosen, f"dropped:  {dropped:,} episodes of which there is no record: what follows is of the others")
    for swap, handed_over in zip(config.swap, results[0].handed_over, strict=True):
        say(chosen, swap_sentence(swap, handed_over))
    say_aborted(chosen, config, results)
    unit, units = "trial" if config.loops == 1 else "loop", _units(config)
    of_all = f" (of all {units})" if config.units > 1 else ""
    if config.units == 1:
        say(chosen, f"steps:    {results[0].total_steps:,} in total")
    else:
        say(chosen, f"steps:    {_with_sd(steps)} per {unit}")
    if (recorded := ~np.isnan(last)).any(axis=1).all():
        late = summary(np.mean(last, axis=1, where=recorded))
        say(chosen, f"return:   {_with_sd(late)}, mean of the last {last.shape[1]} episodes")
    else:
        say(chosen, f"return:   of none of the last {last.shape[1]} episodes there is a record")
    if config.units == 1:
        alarms = ", ".join(map(str, results[0].alarms)) or "none"
        say(chosen, f"alarms:   {alarms}" + (" (episodes)" if results[0].alarms else ""))
    else:
        say(chosen, f"alarms:   {np.mean([len(r.alarms) for r in results]):.2f} per {unit}")
    if config.units > 1:
        say(chosen, f"          (mean ± standard deviation over the {units})")
    if config.execute.mode == "free":
        say(chosen, "log:      no hash, as no free-running loop is the same twice")
    else:
        say(chosen, f"log:      {combined_hash(r.log_sha256 for r in results)}{of_all}")
    tables = "Q-table: " if config.units == 1 else "Q-tables:"
    say(chosen, f"{tables} {combined_hash(r.q_table_sha256 for r in results)}{of_all}")


def _with_sd(found: Any) -> str:
    return plain(found.mean) if found.sd is None else f"{plain(found.mean)} ± {plain(found.sd)}"


def _shower(chosen: argparse.Namespace, first: int, last: int) -> Any:
    def show(record: Record) -> None:
        if first <= record.pass_no <= last:
            if type(record) is STAGES[0]:
                say(chosen, f"--- pass {record.pass_no}")
            say(chosen, sentence(record))

    def watch(loop: Loop) -> None:
        if loop.log.loop == 0:  # unit 0: the first loop of trial 0
            for kind in STAGES:
                loop.bus.subscribe(kind, show)

    return watch
