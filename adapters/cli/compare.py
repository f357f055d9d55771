"""`mapek compare`: configs, or all agents of one, on the same seeds."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from adapters.cli.common import config_of, finish, open_folder, prepare, say
from adapters.experiments.runner import run_agents
from adapters.experiments.statistics import Comparison, compare, holm, summary
from mape.config import Config, overlays_of
from mape.errors import ConfigError, UnknownName
from mape.trials import combined_hash

DEFAULT_TRIALS = 30


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    prepare()
    configs = _configs(chosen)
    first = next(iter(configs))
    with open_folder(chosen, "compare", "compare", configs) as folder:
        results = run_agents(configs, folder, workers=chosen.workers, quiet=chosen.quiet)
        steps = {agent: np.array([r.total_steps for r in found], dtype=float) for agent, found in results.items()}
        returns = {agent: folder.episodes(agent, "return")["return"].sum(axis=1) for agent in configs}
        alarms = {agent: float(np.mean([len(r.alarms) for r in found])) for agent, found in results.items()}
        rows: dict[str, Any] = {}
        for agent in configs:
            rows[agent] = {
                "total_return": summary(returns[agent])._asdict(),
                "total_steps": summary(steps[agent])._asdict(),
                "alarms": alarms[agent],
                "log_sha256": combined_hash(r.log_sha256 for r in results[agent]),
                "q_table_sha256": combined_hash(r.q_table_sha256 for r in results[agent]),
            }
        against = {agent: compare(returns[first], returns[agent]) for agent in configs if agent != first}
        welch = holm([found.p for found in against.values()])
        paired = holm([found.paired_p for found in against.values()])
        for (agent, found), p, paired_p in zip(against.items(), welch, paired, strict=True):
            rows[agent]["against_first"] = found._asdict() | {"p_holm": p, "paired_p_holm": paired_p}
        _print(chosen, configs, first, rows, against, paired)
        figures = []
        if not chosen.no_figures:
            from adapters.experiments.pictures import pictures_of_compare

            figures = pictures_of_compare(folder, returns, {a: rows[a]["total_return"]["interval"] for a in rows})
        finish(chosen, folder, {"first": first, "agents": rows}, figures)
    return 0


def _configs(chosen: argparse.Namespace) -> dict[str, Config]:
    wanted = None if chosen.agents is None else [name.strip() for name in chosen.agents.split(",")]
    found: dict[str, Config] = {}
    unused = set(wanted or ())
    for path in chosen.configs:
        agents = overlays_of(path, "agent")
        # Several configs are compared as they are; one alone, or named agents, over its [agents.*] tables.
        picked: list[str | None] = [a for a in wanted if a in agents] if wanted else []
        if not picked:
            picked = list(agents) if wanted is None and len(chosen.configs) == 1 and agents else [None]
        if wanted and picked == [None]:
            raise UnknownName("agent", wanted[0], agents, f"They are the [agents.NAME] tables of {path}.")
        for agent in picked:
            unused.discard(str(agent))
            config = config_of(path, chosen, agent)
            if chosen.trials is None and config.trials == 1:
                config = config_of(path, chosen, agent, trials=DEFAULT_TRIALS)
            label = agent or config.name
            if label in found:
                label = f"{Path(path).stem}-{label}"
            if label in found:
                raise ConfigError(f"two configs are called {label!r}; give one of them another name")
            found[label] = config
    if unused:
        raise UnknownName("agent", sorted(unused)[0], [a for p in chosen.configs for a in overlays_of(p, "agent")])
    if len(found) < 2:
        raise ConfigError(
            f"compare needs two things to compare, and found {next(iter(found))!r} alone. Give several configs, or one "
            "with [agents.NAME] tables, all of which are compared unless --agents names some."
        )
    for what in ("seed", "trials", "loops", "episodes"):
        values = {label: getattr(config, what) for label, config in found.items()}
        if len(set(values.values())) > 1:
            given = ", ".join(f"{label} {value}" for label, value in values.items())
            hint = f"--{what} N" if what in ("seed", "trials") else f"--set {what}=N"
            named = what if what == "seed" else f"number of {what}"
            raise ConfigError(f"a fair comparison has one {named} for all: {given}. Give {hint}.")
    return found


def _print(
    chosen: argparse.Namespace,
    configs: dict[str, Config],
    first: str,
    rows: dict[str, Any],
    against: dict[str, Comparison],
    corrected: list[float | None],
) -> None:
    some = configs[first]
    loops = f" with {some.loops:,} loops" if some.loops > 1 else ""
    say(
        chosen,
        f"{len(rows)} agents, {some.trials:,} trials{loops} of {some.episodes:,} episodes each, seeds from "
        f"{some.seed}\n",
    )
    width = max(len(agent) for agent in rows)
    say(chosen, f"{'':<{width}}{'total return':>26}{'95 % interval':>26}{'total steps':>22}{'alarms':>9}")
    for agent, row in rows.items():
        total, steps = row["total_return"], row["total_steps"]
        interval = "" if total["interval"] is None else "[{:,.0f}, {:,.0f}]".format(*total["interval"])
        say(
            chosen,
            f"{agent:<{width}}{_with_sd(total):>26}{interval:>26}{_with_sd(steps):>22}{row['alarms']:>9.2f}",
        )
    unit = "trial" if some.loops == 1 else "loop of a trial"
    say(chosen, f"\nagainst {first}, total return, paired by {unit}")
    titles = f"{'difference':>14}{'95 % interval':>24}{'effect size':>13}{'Welch t':>10}{'paired p (Holm)':>17}"
    say(chosen, f"{'':<{width}}{titles}")
    for (agent, found), p in zip(against.items(), corrected, strict=True):
        interval = "-" if found.interval is None else "[{:+,.0f}, {:+,.0f}]".format(*found.interval)
        effect = "-" if found.paired_effect is None else f"{found.paired_effect:+.2f}"
        t = "-" if found.t is None else f"{found.t:.2f}"
        said = "-" if p is None else f"{p:.2g}"
        say(chosen, f"{agent:<{width}}{found.difference:>+14,.0f}{interval:>24}{effect:>13}{t:>10}{said:>17}")
    say(
        chosen,
        "\nAll agents run on the same seeds: interval, effect size (mean / sd of the differences) and paired t test"
        f"\nrest on the differences within {unit if some.loops > 1 else 'trials'}. Welch's t takes the samples as "
        "independent.",
    )


def _with_sd(found: dict[str, Any]) -> str:
    return f"{found['mean']:,.0f}" + ("" if found["sd"] is None else f" ± {found['sd']:,.0f}")
