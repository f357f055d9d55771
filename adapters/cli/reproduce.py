"""`mapek reproduce`: the paper's experiments beside the paper's numbers."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from adapters.cli.common import config_of, finish, looking, open_folder, prepare, say
from adapters.experiments import paper
from adapters.experiments.decimals import plain
from adapters.experiments.metrics import (
    Detection,
    convergence,
    detection,
    greedy_length,
    recovery,
    shortest_path,
    trailing_mean,
)
from adapters.experiments.runner import drifts_of, run_agents
from adapters.experiments.statistics import Comparison, compare, of_few, summary
from adapters.results import RunFolder
from adapters.systems import make_system
from adapters.systems.lending import Lender
from mape.config import Config
from mape.config_files import shipped
from mape.errors import ConfigError
from mape.trials import TrialResult, combined_hash

Results = dict[str, list[TrialResult]]


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    prepare()
    kind, file, agents, trials, profile, trace = _EXPERIMENTS[chosen.experiment]
    path = shipped()[file]
    profile = chosen.profile or profile
    configs = {agent: config_of(path, chosen, agent, trials=trials, profile=profile) for agent in agents}
    for config in configs.values():
        if config.loops > 1:
            raise ConfigError(
                f"reproduce counts independent trials, as the paper does, and loops = {config.loops} would count each "
                "trial several times; leave loops out, and give --trials N for more"
            )
    traced = None if chosen.no_figures or trace is None else (1, configs[agents[0]].episodes)
    what = f"reproduce {chosen.experiment}"
    with (
        Lender() as lend,
        open_folder(chosen, what, chosen.experiment, configs, traced, looking(lend)) as folder,
    ):
        results = run_agents(configs, folder, workers=chosen.workers, trace=traced, quiet=chosen.quiet, lend=lend)
        say(chosen)
        result = {"experiment": chosen.experiment, "profile": profile, "trials": configs[agents[0]].trials}
        if chosen.no_statistics:
            result |= _steps(chosen, results)
        else:
            result |= kind(chosen, folder, configs, results)
            if (few := of_few(configs[agents[0]].trials)) is not None:
                say(chosen, f"\n{few}")
        result |= {
            "log_sha256": combined_hash(r.log_sha256 for agent in agents for r in results[agent]),
            "q_table_sha256": combined_hash(r.q_table_sha256 for agent in agents for r in results[agent]),
        }
        say(chosen, f"\nlog:      {result['log_sha256']}")
        say(chosen, f"Q-tables: {result['q_table_sha256']}")
        figures: list[Path] = []
        if not chosen.no_figures:
            from adapters.experiments import pictures

            figures = getattr(pictures, f"pictures_of_{chosen.experiment}")(folder)
        finish(chosen, folder, result, figures)
    return 0


def _steps(chosen: argparse.Namespace, results: Results) -> dict[str, Any]:
    steps = {agent: sum(r.total_steps for r in found) for agent, found in results.items()}
    for agent, total in steps.items():
        say(chosen, f"{agent}: {len(results[agent]):,} trials, {total:,} steps")
    return {"agents": {agent: {"steps": total} for agent, total in steps.items()}}


def _alarms(results: list[TrialResult]) -> list[tuple[int, ...]]:
    return [r.alarms for r in results]


# Table 1


def _table1(
    chosen: argparse.Namespace, folder: RunFolder, configs: Mapping[str, Config], results: Results
) -> dict[str, Any]:
    drifts = drifts_of(configs["morphin"])
    totals = {agent: np.array([r.total_steps for r in found], dtype=float) for agent, found in results.items()}
    by_stage, recovered = {}, {}
    for agent in configs:
        columns = folder.episodes(agent, "q_change", "steps")
        by_stage[agent] = convergence(columns["q_change"], drifts)
        recovered[agent] = recovery(columns["steps"], drifts)
    against = compare(totals["morphin"], totals["q_learning"])
    met, initial = detection(_alarms(results["morphin"]), drifts, configs["morphin"].episodes, window=300)

    trials = configs["morphin"].trials
    profile = chosen.profile or "reference"
    say(chosen, f"Table 1 of arXiv 2601.20714, profile {profile}, {trials:,} trial{'s' * (trials > 1)} per agent")
    for agent, title in (("morphin", "MORPHIN"), ("q_learning", "Q-learning")):
        say(
            chosen,
            f"\n{title:<13}{'conv.':>7}{'perf.':>7}{'found':>21}{'95 % interval':>23}{'paper':>21}{'d':>7}{'z':>8}",
        )
        _line(chosen, f"{'  total steps':<27}", totals[agent], paper.TABLE1_TOTAL[agent])
        for i, (rest, back) in enumerate(zip(by_stage[agent], recovered[agent], strict=True)):
            name = f"{f'  stage {i + 1}':<13}{rest.share:>7.3f}{back.share:>7.3f}"
            _line(chosen, name, rest.converged, _printed(agent, i), "-" if i < 3 else "")
    _print_comparison(chosen, against)
    say(chosen, "\nDetection (Page-Hinkley on the return, MORPHIN)")
    say(chosen, f"{'drift after episode':<23}{'recall':>10}{'mean delay':>14}{'false alarms/trial':>22}")
    say(chosen, f"{'(before the first)':<23}{'':>10}{'':>14}{initial:>22.3f}")
    for drift, found in zip(drifts, met, strict=True):
        _detection_line(chosen, drift, found)
    say(chosen, _DELAY)
    if profile == "paper":
        say(
            chosen,
            "\nProfile paper is Algorithm 1 as printed. It does not give the paper's Table 1; the profile reference, "
            "which adds\nthe success rule of the authors' published code, does.",
        )
    say(
        chosen,
        "\nconv.: share of trials that converge: first episode of the stage at whose end max|change of Q| < 0.01,"
        "\n  counted only where the stage before converged; one that did not converge is censored, not late."
        "\nperf.: share of trials that recover by performance: 10 episodes in a row of at most 18 steps."
        "\nfound, paper: mean ± standard deviation over the trials; the interval is that of the mean, by bootstrap."
        "\nd: difference of the means in the paper's standard deviations of one trial."
        "\nz: difference of the means in our standard errors, sd / sqrt(n); the paper's own n is not known."
        "\nWhat the ratio does not say: it is mostly a weak baseline (README, What is honest to claim).",
    )
    return {
        "agents": {
            agent: {
                "total_steps": {"mean": totals[agent].mean(), "sd": _sd(totals[agent])}
                | paper.against(totals[agent], paper.TABLE1_TOTAL[agent]),
                "stages": [
                    {
                        "share": stage.share,
                        "mean": stage.converged.mean() if len(stage.converged) else None,
                        "sd": _sd(stage.converged),
                        "restricted_mean": stage.restricted_mean(),
                        "performance_share": back.share,
                    }
                    | paper.against(stage.converged, _printed(agent, i))
                    for i, (stage, back) in enumerate(zip(by_stage[agent], recovered[agent], strict=True))
                ],
            }
            for agent in configs
        },
        "ratio": against.ratio,
        "ratio_interval": against.ratio_interval,
        "welch": {"t": against.t, "df": against.df, "p": against.p},
        "hedges_g": against.hedges_g,
        "paired": {
            "effect": against.paired_effect,
            "t": against.paired_t,
            "df": against.paired_df,
            "p": against.paired_p,
        },
        "detection": [found._asdict() for found in met],
        "detection_initial": initial,
    }


def _printed(agent: str, stage: int) -> paper.Printed | None:
    printed = paper.TABLE1_STAGES[agent]
    return printed[stage] if stage < len(printed) else None


def _line(
    chosen: argparse.Namespace, name: str, values: npt.NDArray[Any], printed: paper.Printed | None, missing: str = ""
) -> None:
    theirs = missing if printed is None else _with_sd(printed.mean, printed.sd)
    ours, interval, d, z = "-", "", "", ""
    if len(values):
        found = summary(values)
        ours = _with_sd(found.mean, found.sd)
        interval = "" if found.interval is None else f"[{_short(found.interval[0])}, {_short(found.interval[1])}]"
        distance = paper.against(values, printed)
        d = "" if distance["d"] is None else f"{distance['d']:+.2f}"
        z = "" if distance["z"] is None else f"{distance['z']:+.1f}"
    say(chosen, f"{name}{ours:>21}{interval:>23}{theirs:>21}{d:>7}{z:>8}".rstrip())


def _with_sd(mean: float, sd: float | None) -> str:
    return _short(mean) + ("" if sd is None else f" ± {_short(sd)}")


def _short(number: float) -> str:
    """Leave out the decimals of what is so long that the columns would not hold it."""
    return plain(number, 2 if abs(number) < 1e5 else 0)


def _print_comparison(chosen: argparse.Namespace, against: Comparison) -> None:
    ratio = "-" if against.ratio is None else f"{against.ratio:.3f}"
    interval = ""
    if against.ratio_interval is not None:
        interval = (
            f", 95 % paired bootstrap interval [{against.ratio_interval[0]:.3f}, {against.ratio_interval[1]:.3f}]"
        )
    say(chosen, f"\nratio of total steps, Q-learning / MORPHIN: {ratio}{interval}; paper {paper.TABLE1_RATIO}")
    if against.t is not None:
        p = f"p = {against.p:.3g}" if against.p else "p < 1e-300"
        say(chosen, f"Welch t = {against.t:.1f}, df = {against.df:.0f}, {p}; effect size g = {against.hedges_g:.1f}")


def _detection_line(chosen: argparse.Namespace, drift: int, found: Detection) -> None:
    delay = "-" if found.delay_mean is None else f"{found.delay_mean:.2f}"
    say(chosen, f"{drift - 1:<23}{found.recall:>10.3f}{delay:>14}{found.false_alarms:>22.3f}")


_DELAY = "delay: episodes of the new regime until the alarm, the alarm's own included"


def _as_it_comes(chosen: argparse.Namespace) -> bool:
    return not chosen.overrides and chosen.profile is None


def _before(chosen: argparse.Namespace) -> str:
    found = "before: found earlier with these settings, over 100 to 1,000 trials."
    if _as_it_comes(chosen):
        return found
    return found.replace("these settings", "the experiment's own settings, not these")


def _sd(values: npt.NDArray[Any]) -> float | None:
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


# Traffic


def _traffic(
    chosen: argparse.Namespace, folder: RunFolder, configs: Mapping[str, Config], results: Results
) -> dict[str, Any]:
    episodes = configs["morphin"].episodes
    drifts = drifts_of(configs["morphin"])
    points = [e for e in paper.TRAFFIC_EPISODES if e <= episodes] or [episodes]
    say(chosen, f"Traffic, {configs['morphin'].trials:,} trials per agent: mean return of the last 500 episodes")
    say(chosen, f"\n{'at episode':<30}" + "".join(f"{e:>9}" for e in points))
    found: dict[str, Any] = {}
    for agent, config in configs.items():
        returns = folder.episodes(agent, "return")["return"]
        curve = [summary(trailing_mean(returns, 500, e)) for e in points]
        say(chosen, f"{agent:<22}{'found':<8}" + "".join(f"{c.mean:>9.1f}" for c in curve))
        if all(c.interval is not None for c in curve):
            say(chosen, f"{'':<22}{'± 95 %':<8}" + "".join(f"{_half(c.interval):>9.1f}" for c in curve))
        by_episode = dict(zip(paper.TRAFFIC_EPISODES, paper.TRAFFIC[agent], strict=True))
        say(chosen, f"{'':<22}{'before':<8}" + "".join(f"{by_episode.get(e, '-'):>9}" for e in points))
        met, initial = detection(_alarms(results[agent]), drifts, config.episodes, window=500)
        found[agent] = {
            "curve": {str(e): c.mean for e, c in zip(points, curve, strict=True)},
            "detection": [d._asdict() for d in met],
            "detection_initial": initial,
        }
    say(chosen, "\nDetection by Page-Hinkley")
    say(chosen, f"{'agent, drift after':<23}{'recall':>10}{'mean delay':>14}{'false alarms/trial':>22}")
    for agent in configs:
        if configs[agent].monitor.detectors:
            say(chosen, agent)
            for drift, one in zip(drifts, found[agent]["detection"], strict=True):
                _detection_line(chosen, drift, Detection(**one))
    say(chosen, _DELAY)
    say(chosen, f"\n{_before(chosen)}")
    if _as_it_comes(chosen):
        say(
            chosen,
            "Drift 2 raises the reward, and a test for falls does not see it. At these settings Q-learning that is "
            "handed the\nsame five actions does better than MORPHIN after drift 1: the gain is the actions, and a full "
            "reset of\nexploration costs more than it finds.",
        )
    return {"agents": found}


def _half(interval: Any) -> float:
    return float(interval[1] - interval[0]) / 2


# Jump


def _jump(
    chosen: argparse.Namespace, folder: RunFolder, configs: Mapping[str, Config], results: Results
) -> dict[str, Any]:
    config = configs["morphin"]
    system = make_system(config.system)
    change = int(config.system.options.get("jump_from") or config.episodes)
    before_at, after_at = (max(1, change - 20), change - 1), (max(1, config.episodes - 19), config.episodes)
    optimum = shortest_path(system, config.episodes)
    say(chosen, f"Jump, {config.trials:,} trials per agent; the shortest path at the end has {optimum} steps")
    spans = [f"{first}-{last}" for first, last in (before_at, after_at)]
    say(chosen, f"\n{'mean steps over episodes':<26}{'':<8}{spans[0]:>10}{spans[1]:>10}{'optimal':>10}")
    found: dict[str, Any] = {}
    for agent in configs:
        steps = folder.episodes(agent, "steps")["steps"].astype(float)
        means = [_mean_over(steps, *episodes) for episodes in (before_at, after_at)]
        tables = folder.q_tables(agent)
        available = system.available(config.episodes) or ()
        lengths = [greedy_length(q, ids, system.rules, config.episodes, available) for q, ids in tables.values()]
        share = float(np.mean([length == optimum for length in lengths]))
        said = ["-" if mean is None else f"{mean:.2f}" for mean in means]
        say(chosen, f"{agent:<26}{'found':<8}{said[0]:>10}{said[1]:>10}{share:>10.3f}")
        target = paper.JUMP[agent]
        say(chosen, f"{'':<26}{'before':<8}{target[0]:>10.2f}{target[1]:>10.2f}{target[2]:>10.3f}")
        found[agent] = {"steps_before": means[0], "steps_after": means[1], "optimal_share": share}
    system.close()
    say(chosen, "\noptimal: share of trials whose greedy path at the end is a shortest one.")
    say(chosen, f"{_before(chosen)}\nThe paper does not publish its layout; this one is ours.")
    return {"agents": found, "shortest_path": optimum}


def _mean_over(steps: npt.NDArray[Any], first: int, last: int) -> float | None:
    """Return the mean over episodes `first` to `last`; None where the run is shorter."""
    return float(steps[:, first - 1 : last].mean()) if last <= steps.shape[1] else None


Kind = Callable[[argparse.Namespace, RunFolder, Mapping[str, Config], Results], dict[str, Any]]
_EXPERIMENTS: dict[str, tuple[Kind, str, tuple[str, ...], int, str | None, bool | None]] = {
    "table1": (_table1, "gridworld_goals", ("morphin", "q_learning"), 1000, "reference", True),
    "traffic": (_traffic, "traffic", ("morphin", "q_learning", "same_actions", "three_actions"), 200, None, None),
    "jump": (_jump, "jump", ("morphin", "success_rule", "fixed_alpha", "q_learning"), 1000, None, None),
}
