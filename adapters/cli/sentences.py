"""Records as sentences, for people."""

from __future__ import annotations

from knowledge import ChangePlan, ChangeRequest, Observation, Record, Symptom


def sentence(record: Record) -> str:
    """Say a record in a sentence that begins with who says it.

    >>> print(sentence(ChangeRequest(0, 303, (), (), (), {"return": 93.0})))
    Analyze   nothing changed.
    """
    if isinstance(record, Observation):
        return f"Execute   {_observation(record)}"
    if isinstance(record, Symptom):
        return f"Monitor   {_symptom(record)}"
    if isinstance(record, ChangeRequest):
        return f"Analyze   {_request(record)}"
    return f"Plan      {_plan(record)}"


def _observation(seen: Observation) -> str:
    own = [f"{name} {value:.4g}" for name, value in list(seen.signals.items())[4:]]
    text = (
        f"drove episode {seen.pass_no} under plan {seen.plan} (epsilon {seen.epsilon:.3f}): return "
        f"{seen.signals['return']:g} in {seen.steps} steps, mean |TD error| {seen.signals['td_error']:.3g}, largest "
        f"change of Q {seen.signals['q_change']:.3g}"
    )
    if own:
        text += f"; {', '.join(own)}"
    if seen.available != seen.known:
        text += f"; available actions {ids(seen.available)}, in the Q-table {ids(seen.known)}"
    return text + "."


def _symptom(symptom: Symptom) -> str:
    if not symptom.readings:
        return "watches nothing."
    parts = []
    for r in symptom.readings:
        statistic = "no statistic" if r.statistic is None else f"statistic {r.statistic:.4g}"
        parts.append(f"{r.signal} {r.value:g}: {statistic}, {'ALARM' if r.alarm else 'no alarm'}")
    return "; ".join(parts) + "."


def _request(request: ChangeRequest) -> str:
    parts = [
        f"{drift.signal} drifted" + (f" {drift.direction}" if drift.direction != "unknown" else "")
        for drift in request.drifts
    ]
    if request.added:
        parts.append(f"new actions {ids(request.added)}")
    if request.removed:
        parts.append(f"vanished actions {ids(request.removed)}")
    return ("; ".join(parts) or "nothing changed") + "."


def _plan(plan: ChangePlan) -> str:
    rate = ", ".join(f"{value:g}" for value in plan.learning_rate)
    parts = [f"plan {plan.pass_no}: epsilon {plan.epsilon:.3f}, learning rate ({rate})"]
    if plan.add:
        parts.append(f"add rows for actions {ids(plan.add)}")
    if plan.drop:
        parts.append(f"drop the rows of actions {ids(plan.drop)}")
    if plan.enable:
        parts.append(f"enable actions {ids(plan.enable)}")
    if plan.reset_detector:
        parts.append("reset the detectors")
    if plan.adopt:
        parts.append(f"adopt the Q-table {plan.adopt[:12]}")
    return "; ".join(parts) + "."


def ids(actions: tuple[int, ...]) -> str:
    """Write a set of actions.

    >>> ids((0, 3))
    '{0, 3}'
    """
    return "{" + ", ".join(map(str, actions)) + "}"
