"""Replacing a part of a running component, at the boundary of two passes.

The new part is built from its spec and takes over the old one's state where both give it in the same format, by their
`state_format` (see `mape.ports`); else it starts afresh. Where anything is wrong with it the old one goes on.
"""

from __future__ import annotations

from typing import Any

from mape.analyze import Analyze
from mape.config import Config, SwapConfig
from mape.errors import ConfigError, MapekError, PartError
from mape.execute import Execute
from mape.monitor import Monitor
from mape.near import did_you_mean, nearest
from mape.parts import make, owner, parts_in, place_of, with_part
from mape.plan import Plan
from mape.specs import PartSpec
from mape.states import faults, told

Component = Monitor | Analyze | Plan | Execute

_OWNERS: dict[str, type[Component]] = {"monitor": Monitor, "analyze": Analyze, "plan": Plan, "execute": Execute}


def replace_part(
    component: Component, part: str, spec: PartSpec, config: Config, *, signals: tuple[str, ...] | None = None
) -> bool:
    """Replace a part of a component; to be called between two passes.

    Parameters
    ----------
    component
        The part's owner.
    part
        Its name, see `mape.parts`.
    spec
        What takes its place. A detector watches the signal of the old one, and a planner gets a schedule like the old
        one's, unless the spec names another.
    config
        What the component was built from.
    signals
        Names of the run's signals, one of which a detector watches; None where they are not known here.

    Returns
    -------
    Whether the new part took over the state of the old one. A learner has none: False, and the Q-table goes on.

    Raises
    ------
    ConfigError
        There is no such part, or the new one cannot be made or compiled. The old one goes on.
    PartError
        The new one does not fit the run, or one of the two broke its contract. The old one goes on.
    """
    if not isinstance(component, _OWNERS[owner(part)]):
        raise ConfigError(
            f"part {part!r} is {owner(part).capitalize()}'s; {type(component).__name__} cannot replace it"
        )
    if isinstance(component, Plan) and component.schedule_spec is not None:
        config = with_part(config, "plan.schedule", component.schedule_spec)
    kind, chosen = parts_in(with_part(config, part, spec))[part]
    new = make(kind, chosen)
    try:
        if isinstance(component, Monitor):
            place = int(place_of(part, config).removeprefix("monitor."))
            signal = spec.model_dump(exclude_unset=True).get("signal", component.detectors[place][0])
            if signals is not None and signal not in signals:
                near = did_you_mean(nearest(signal, signals))
                raise ConfigError(
                    f"detector {spec.name!r} watches signal {signal!r}; the run has {', '.join(signals)}{near}"
                )
            return component.replace(place, signal, new)
        if isinstance(component, Analyze):
            return component.replace(new)
        if isinstance(component, Execute):
            component.replace(new)
            return False
        handed_over = component.replace_schedule(new) if kind == "schedule" else component.replace(new)
        component.schedule_spec = chosen if kind == "schedule" else getattr(chosen, "schedule", None)
        return handed_over
    except MapekError:
        raise
    except faults() as error:
        raise PartError(
            f"{spec.name!r} cannot take the place of {part}: {told(error)}. The old one goes on; run "
            "`mapek check` on the new one."
        ) from error


def vet(part: str, spec: PartSpec, config: Config) -> list[str]:
    """Hold a candidate for a part against the whole contract of its kind, before it is let in.

    Parameters
    ----------
    part, spec, config
        As `replace_part` takes them.

    Returns
    -------
    One sentence per clause that is broken; none where the candidate may be let in.
    """
    from mape.testing import CHECKS  # what it needs is not needed by a run

    try:
        after = with_part(config, part, spec)
        kind, chosen = parts_in(after)[part]
        made = make(kind, chosen)
    except MapekError as error:
        return [str(error)]
    failed = [
        f"{kind} {spec.name!r} breaks a clause of its contract, {finding.check}: {finding.detail}"
        for finding in CHECKS[kind](lambda: make(kind, chosen))
        if finding.verdict == "failed"
    ]
    if not failed and (misfit := _misfit(kind, made, config)) is not None:
        failed.append(f"{kind} {spec.name!r} does not fit the run: {misfit}")
    return failed


def _misfit(kind: str, made: Any, config: Config) -> str | None:
    """Say how a planner or learner does not fit the other one, whose learning-rate parameters it shares."""
    if kind not in ("planner", "learner"):
        return None
    wanted = len(make("learner", config.learner).rate_names)
    given = len(made.rate_names if kind == "learner" else made.start(0).learning_rate)
    if given == wanted:
        return None
    return f"it has {given} learning-rate parameters, the run {wanted}; their number is fixed for a run"


def swap_sentence(swap: SwapConfig, handed_over: bool) -> str:
    """Say a swap that was made.

    >>> from mape.config import SwapConfig
    >>> swap = SwapConfig.model_validate({"pass": 500, "part": "plan", "to": {"name": "morphin", "alpha": 0.2}})
    >>> swap_sentence(swap, handed_over=True)
    'pass 500: plan is now morphin (alpha = 0.2), with the state of the one before'
    """
    options = ", ".join(f"{name} = {value!r}" for name, value in swap.to.options.items())
    new = swap.to.name + (f" ({options})" if options else "")
    kept = f"{'with' if handed_over else 'without'} the state of the one before"
    if swap.part == "learner":
        kept = "and the Q-table goes on"
    return f"pass {swap.pass_no}: {swap.part} is now {new}, {kept}"
