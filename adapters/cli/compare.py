"""`mapek compare`: configs, or all agents of one, on the same seeds."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from adapters.cli.common import config_of, finish, looking, open_folder, prepare, say
from adapters.cli.run import aborted_as_json, say_untaught
from adapters.experiments.decimals import number, resolution
from adapters.experiments.pairing import Pairing, pairing
from adapters.experiments.runner import run_agents
from adapters.experiments.statistics import Comparison, compare, holm, of_few, summary
from adapters.systems.lending import Lender
from mape.config import Config, overlays_of
from mape.errors import ConfigError, UnknownName
from mape.trials import combined_hash

DEFAULT_TRIALS = 30


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    prepare()
    configs = _configs(chosen)
    first = next(iter(configs))
    with (
        Lender() as lend,
        open_folder(chosen, "compare", "compare", configs, check=looking(lend)) as folder,
    ):
        results = run_agents(configs, folder, workers=chosen.workers, quiet=chosen.quiet, lend=lend)
        steps = {agent: np.array([r.total_steps for r in found], dtype=float) for agent, found in results.items()}
        returns = {agent: folder.episodes(agent, "return")["return"].sum(axis=1) for agent in configs}
        alarms = {agent: float(np.mean([len(r.alarms) for r in found])) for agent, found in results.items()}
        rows: dict[str, Any] = {}
        for agent in configs:
            rows[agent] = {
                "total_return": summary(returns[agent])._asdict(),
                "total_steps": summary(steps[agent])._asdict(),
                "alarms": alarms[agent],
                **(
                    {"aborted": aborted} if (aborted := [e for r in results[agent] for e in aborted_as_json(r)]) else {}
                ),
                "log_sha256": combined_hash(r.log_sha256 for r in results[agent]),
                "q_table_sha256": combined_hash(r.q_table_sha256 for r in results[agent]),
            }
        pairings = {agent: pairing(configs[first], configs[agent]) for agent in configs if agent != first}
        against = {
            agent: compare(returns[first], returns[agent], paired=how.kind == "paired")
            for agent, how in pairings.items()
            if how.kind != "apart"
        }
        welch = holm([found.p for found in against.values()])
        paired = holm([found.paired_p for found in against.values()])
        for agent, how in pairings.items():
            rows[agent]["pairing"] = how._asdict()
        for (agent, found), p, paired_p in zip(against.items(), welch, paired, strict=True):
            rows[agent]["against_first"] = found._asdict() | {"p_holm": p, "paired_p_holm": paired_p}
        _print_agents(chosen, configs[first], rows)
        _print_paired(chosen, configs[first], first, _of_kind("paired", pairings, against), rows)
        _print_independent(chosen, first, _of_kind("independent", pairings, against), rows, pairings)
        for agent, how in pairings.items():
            if how.kind == "apart":
                say(chosen, f"\n{agent} is not held against {first}: {how.reason}. Two systems have no common scale.")
        for agent, config in configs.items():
            say_untaught(chosen, config, results[agent], folder, agent)
        if (few := of_few(configs[first].trials)) is not None and against:
            say(chosen, f"\n{few}")
        figures = []
        if not chosen.no_figures:
            from adapters.experiments.pictures import pictures_of_compare

            intervals = {agent: row["total_return"]["interval"] for agent, row in rows.items()}
            differences = {agent: found.interval for agent, found in against.items()}
            figures = pictures_of_compare(folder, returns, intervals, differences)
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
            if chosen.trials is None and "trials" not in config.model_fields_set:
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


def _of_kind(kind: str, pairings: dict[str, Pairing], against: dict[str, Comparison]) -> dict[str, Comparison]:
    return {agent: found for agent, found in against.items() if pairings[agent].kind == kind}


def _print_agents(chosen: argparse.Namespace, some: Config, rows: dict[str, Any]) -> None:
    loops = f" with {some.loops:,} loops" if some.loops > 1 else ""
    trials, episodes = _counted(some.trials, "trial"), _counted(some.episodes, "episode")
    say(chosen, f"{len(rows)} agents, {trials}{loops} of {episodes} each, seed {some.seed}\n")
    exact = resolution(row["total_return"]["interval"] for row in rows.values())
    steady = resolution(row["total_steps"]["interval"] for row in rows.values())
    lines: list[tuple[str, ...]] = [("", "total return", "95 % interval", "total steps", "alarms")]
    for agent, row in rows.items():
        total, steps = row["total_return"], row["total_steps"]
        interval = _interval(total["interval"], exact) if total["interval"] else ""
        lines.append((agent, _with_sd(total, exact), interval, _with_sd(steps, steady), f"{row['alarms']:.2f}"))
    _say_table(chosen, lines, (26, 26, 22, 9))
    if some.units > 1:
        say(chosen, f"\nmean ± standard deviation over the {_units(some)}; 95 % bootstrap interval of the mean")


def _units(some: Config) -> str:
    return "trials" if some.loops == 1 else "loops of all trials"


def _print_paired(
    chosen: argparse.Namespace, some: Config, first: str, against: dict[str, Comparison], rows: dict[str, Any]
) -> None:
    if not against:
        return
    unit, units = ("trial", "trials") if some.loops == 1 else ("loop of a trial", "loops of a trial")
    say(chosen, f"\nagainst {first}, total return, paired by {unit}")
    exact = resolution(found.interval for found in against.values())
    lines: list[tuple[str, ...]] = [("", "difference", "95 % interval", "effect size", "Welch t", "paired p (Holm)")]
    for agent, found in against.items():
        t = "-" if found.t is None else f"{found.t:.2f}"
        ends = (_effect(found.paired_effect), t, _p(rows[agent]["against_first"]["paired_p_holm"]))
        lines.append((agent, *_difference(found, exact), *ends))
    _say_table(chosen, lines, (14, 24, 13, 10, 17))
    say(
        chosen,
        "\nThese agents run on the same seeds: interval, effect size (mean / sd of the differences) and paired t test"
        f"\nrest on the differences within {units}. Welch's t takes the samples as independent.",
    )


def _print_independent(
    chosen: argparse.Namespace,
    first: str,
    against: dict[str, Comparison],
    rows: dict[str, Any],
    pairings: dict[str, Pairing],
) -> None:
    if not against:
        return
    say(chosen, f"\nagainst {first}, total return, as independent samples")
    exact = resolution(found.interval for found in against.values())
    lines: list[tuple[str, ...]] = [("", "difference", "95 % interval", "Hedges g", "Welch t", "p (Holm)")]
    for agent, found in against.items():
        t = "-" if found.t is None else f"{found.t:.2f}"
        ends = (_effect(found.hedges_g), t, _p(rows[agent]["against_first"]["p_holm"]))
        lines.append((agent, *_difference(found, exact), *ends))
    _say_table(chosen, lines, (14, 24, 13, 10, 17))
    reasons = "; ".join(dict.fromkeys(pairings[agent].reason for agent in against))
    say(
        chosen,
        f"\nThese trials are no pairs: {reasons}. Interval and Welch's t take the trials as independent samples.",
    )


def _difference(found: Comparison, exact: float) -> tuple[str, str]:
    interval = "-" if found.interval is None else _interval(found.interval, exact, "+")
    return number(found.difference, exact, "+"), interval


def _effect(effect: float | None) -> str:
    return "-" if effect is None else f"{effect:+.2f}"


def _p(p: float | None) -> str:
    return "-" if p is None else f"{p:.2g}"


def _say_table(chosen: argparse.Namespace, lines: Sequence[Sequence[str]], widths: Sequence[int]) -> None:
    """Print lines of cells, the first of each to the left, the others to the right, in columns of at least `widths`."""
    first, *others = zip(*lines, strict=True)
    left = max(map(len, first))
    rights = [max(width, 2 + max(map(len, column))) for width, column in zip(widths, others, strict=True)]
    for name, *cells in lines:
        say(chosen, f"{name:<{left}}" + "".join(f"{cell:>{w}}" for cell, w in zip(cells, rights, strict=True)))


def _counted(count: int, what: str) -> str:
    return f"{count:,} {what}" if count == 1 else f"{count:,} {what}s"


def _interval(ends: tuple[float, float], resolution: float, sign: str = "-") -> str:
    low, high = (number(end, resolution, sign) for end in ends)
    return f"[{low}, {high}]"


def _with_sd(found: dict[str, Any], resolution: float) -> str:
    mean, sd = found["mean"], found["sd"]
    if sd is None:
        return number(mean, resolution)
    # Without an interval of some width the mean alone says how small a number is.
    return f"{number(mean, resolution)} ± {number(sd, resolution or abs(mean) / 10.0)}"
