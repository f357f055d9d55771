"""The contract of a managed system."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from knowledge import (
    ChangePlan,
    Knowledge,
    Log,
    RowLayout,
)
from mape import registry
from mape.execute.checkpoint import differing, held_by
from mape.execute.component import SIGNALS, Execute
from mape.ports import Episode, ManagedSystem
from mape.specs import PartSpec
from mape.testing.clauses import (
    Broken,
    Finding,
    Noted,
    finite,
    judge,
    plain_json,
)


class _Moment(NamedTuple):
    """What a step looks like from outside, all of it comparable bit for bit."""

    action: int
    state: int
    reward: float
    ended: bool
    explorable: tuple[bool, ...]
    legal: tuple[bool, ...]
    taken: int | None
    signals: tuple[float, ...]


EPISODES = 5
"""Episodes that a managed system is put through, each of at most `LONGEST` steps."""
LONGEST = 200


MEMBERS = (
    "name n_states max_steps signal_names drifts draws redrivable rules "
    "available() begin() step() explorable() enable() get_state() set_state() close()"
)
"""What a managed system has."""


def describe(system: ManagedSystem) -> None:
    """Look at what a system says of itself; a clause is broken where that is of a wrong kind."""
    whole = {"n_states": (system.n_states, 1), "max_steps": (system.max_steps, 1)}
    whole |= {f"draws[{i}]": (draws, 0) for i, draws in enumerate(system.draws)}
    for name, (number, least) in whole.items():
        if type(number) is not int or number < least:
            raise Broken(f"{name} is {number!r}; give an int of at least {least}")
    names = system.signal_names
    if not isinstance(names, tuple) or len({*names, *SIGNALS}) != len(names) + len(SIGNALS):
        raise Broken(f"signal_names is {names!r}; give a tuple of distinct names, none of {', '.join(SIGNALS)}")
    if type(system.redrivable) is not bool:
        raise Broken(f"redrivable is {system.redrivable!r}; it is True or False")
    if list(system.drifts) != sorted({*system.drifts}):
        raise Broken(f"drifts is {system.drifts!r}; give increasing episodes")


def check_system(make: Callable[[], ManagedSystem], episodes: int = EPISODES) -> list[Finding]:
    """Check a managed system by random episodes; one with rules is learnt compiled and by calls, too.

    Each clause drives `episodes` of them; with 0 nothing is driven, and only what the system says of itself is looked
    at. One that cannot be driven again is a case for `check_plant`.

    Whether its environment keeps to Gymnasium's own contract is a question for `gymnasium.utils.env_checker`.
    """
    made: list[Any] = []

    def fresh() -> ManagedSystem:
        made.append(make())
        return made[-1]  # type: ignore[no-any-return]

    def plays() -> None:
        system = fresh()
        for number in range(1, episodes + 1):
            _play(system, number)

    def soft() -> None:
        system = fresh()
        for number in range(1, episodes + 1):
            for moment in _play(system, number):
                if any(legal and not worth for legal, worth in zip(moment.legal, moment.explorable, strict=True)):
                    raise Noted(
                        f"its mask is soft: in state {moment.state} it bars actions that are legal. It keeps "
                        "exploration from them while there are others, and with execute.mask_greedy the greedy choice "
                        "too; it is no protection. An action that must never be taken is left out of "
                        "info['legal_actions'], or of the rules' legal"
                    )

    def foretells() -> None:
        system = fresh()
        for number in range(1, episodes + 1):
            told = system.available(number)
            _, found = system.begin(_episode(system, number))
            if told is not None and {*told} != {*found}:
                raise Broken(f"available({number}) is {told}, and episode {number} offers {found}; or return None")

    def deterministic() -> None:
        first, second = fresh(), fresh()
        for number in range(1, episodes + 1):
            _compare(_play(first, number), _play(second, number), f"episode {number} of two fresh ones")

    def redriven() -> None:
        system, other = fresh(), fresh()
        if not system.redrivable:
            raise Noted(
                "not redrivable, as it says itself (redrivable = False): an episode that is broken off is not driven "
                "again, and a run is not taken up elsewhere to the same bits"
            )
        played = {}
        for number in range(1, episodes + 1):
            carried, held = _carried(system), dict[str, str]()
            played[number] = (carried, _play(system, number, held), held)
        for number in (episodes, 1, middle := (episodes + 1) // 2, middle):
            carried, moments, before = played[number]
            held = {}
            if carried is not None:
                _carried(other, carried)
            try:
                again = _play(other, number, held)
                if names := differing(before, held):
                    raise Broken(
                        f"after equal resets for episode {number}, it does not hold the same {', '.join(names)}, but "
                        "what earlier episodes left there"
                    )
                _compare(moments, again, f"episode {number}, driven again after others")
            except Broken as broken:
                if carried is not None:
                    raise Broken(
                        f"{broken}, although its state was set; get_state() holds all that it carries"
                    ) from None
                raise Noted(
                    f"not resumable from a state: {broken}. Take all randomness from the episode's seed or uniforms, "
                    "and the episode's number from the reset; or offer get_state() and set_state(); or, where no "
                    "episode can be had again, say redrivable = False. Until then a run that is taken up again drives "
                    "all its episodes anew, or is refused"
                ) from None

    def adds() -> None:
        system, other = fresh(), fresh()
        if not system.signal_names:
            return
        for number in range(1, episodes + 1):
            one, another = _play(system, number), _play(other, number, base=1.0)
            _added(system, one, another, f"step() of episode {number}")
            if system.rules is not None:
                ruled = _play_by_rules(other, number, base=1.0)
                _added(system, one, ruled, f"rules.step of episode {number}")

    def by_rules() -> None:
        system, other = fresh(), fresh()
        if system.rules is None:
            raise Noted("offers no rules, so that its episodes are called step by step and not compiled")
        for number in range(1, episodes + 1):
            _compare(_play(system, number), _play_by_rules(other, number), f"episode {number}, by step() and by rules")

    def compiled() -> None:
        if fresh().rules is None:
            raise Noted("offers no rules")
        called, ran = (_learn(fresh(), engine, episodes) for engine in ("python", "compiled"))
        for number, (one, other) in enumerate(zip(called, ran, strict=True), 1):
            if one != other:
                raise Broken(
                    f"episode {number} learns {one} by calls and {other} compiled; use math, not numpy, for functions "
                    "of numbers, and floats where integers would overflow"
                )

    findings = judge(
        fresh,
        MEMBERS,
        [
            ("describes itself in numbers", lambda: describe(fresh())),
            ("stays within its states, with finite rewards and known actions", plays),
            ("bars by its mask only what may be taken nevertheless", soft),
            ("says beforehand which actions an episode offers, or nothing", foretells),
            ("is deterministic: two fresh ones play the same episodes", deterministic),
            ("plays an episode the same whatever was played before", redriven),
            ("adds its signals to those of the steps before", adds),
            ("has rules that equal its steps, bit for bit", by_rules),
            ("learns the same Q-table compiled and called", compiled),
        ][: None if episodes else 1],
    )
    for system in made:
        if hasattr(system, "close"):
            system.close()
    return findings


def _episode(system: ManagedSystem, number: int) -> Episode:
    generator = np.random.default_rng((1713, number))
    width = system.draws[0] + system.max_steps * system.draws[1]
    return Episode(number, int(generator.integers(2**32)), generator.random(width))


def _carried(system: ManagedSystem, state: Any = None) -> Any:
    """Return what a system says that it carries between episodes, or set it; None where it says nothing."""
    if state is not None:
        system.set_state(json.loads(state))
    carried = system.get_state()
    return None if carried is None else plain_json(carried)


def play_at_random(system: ManagedSystem, number: int) -> None:
    """Drive an episode by random actions; a clause is broken where it leaves its states, actions or finite numbers."""
    _play(system, number)


def _play(system: ManagedSystem, number: int, held: dict[str, str] | None = None, base: float = 0.0) -> list[_Moment]:
    """Drive an episode by random actions.

    `held` takes what the system holds after the reset; `base` is what the context holds before each step.
    """
    state, available = system.begin(_episode(system, number))
    if held is not None:
        held.update(held_by(system, stated=True))
    if not available or len({*available}) != len(available) or any(type(a) is not int or a < 0 for a in available):
        raise Broken(f"episode {number} offers {available!r}; give at least one action, distinct ints from 0")
    _in_range(system, state, f"begin() of episode {number}")
    told: Any = system  # what it need not have
    marks = tuple(bool(system.explorable(a)) for a in available)
    legal = _legal(told, available, f"begin() of episode {number}")
    moments = [_Moment(-1, state, 0.0, False, marks, tuple(a in legal for a in available), None, ())]
    rng = random.Random(number)
    context = np.zeros(len(system.signal_names))
    for step in range(1, min(system.max_steps, LONGEST) + 1):
        action = rng.choice(legal)
        context[:] = base
        state, reward, terminated, truncated = system.step(action, context)
        where = f"step({action}) in episode {number}"
        _in_range(system, state, where)
        if not finite(reward):
            raise Broken(f"{where} gave reward {reward!r}; rewards are finite numbers")
        if type(terminated) is not bool or type(truncated) is not bool:
            raise Broken(f"{where} gave terminated {terminated!r}, truncated {truncated!r}; give bools")
        if not np.isfinite(context).all():
            raise Broken(f"{where} gave signals {dict(zip(system.signal_names, context.tolist(), strict=True))}")
        ended = terminated or truncated or step == system.max_steps
        taken = getattr(told, "taken", None)
        if taken is not None and type(taken) is not int:
            raise Broken(f"{where} gave taken {taken!r}; give the id of the action that was taken, an int, or None")
        marks = () if ended else tuple(bool(system.explorable(a)) for a in available)
        legal = [] if terminated else _legal(told, available, where)
        whole = () if ended else tuple(a in legal for a in available)
        moments.append(_Moment(action, state, float(reward), ended, marks, whole, taken, tuple(context.tolist())))
        if ended:
            break
    return moments


def _legal(system: Any, available: tuple[int, ...], where: str) -> list[int]:
    """Return which of the actions on offer may be taken in the present state of a system."""
    legal = getattr(system, "legal_actions", None)
    found = [action for action in available if legal is None or action in legal]
    if not found:
        raise Broken(f"{where} led to a state in which of {available} none is legal: {legal}; let one at least be")
    return found


def _in_range(system: ManagedSystem, state: Any, where: str) -> None:
    if type(state) is not int or not 0 <= state < system.n_states:
        raise Broken(f"{where} went to state {state!r}; states are ints from 0 to {system.n_states - 1}")


def _play_by_rules(system: ManagedSystem, number: int, base: float = 0.0) -> list[_Moment]:
    rules, draws = system.rules, _episode(system, number).uniforms
    assert rules is not None
    if (rules.reset_draws, rules.step_draws) != system.draws:
        raise Broken(f"rules take {(rules.reset_draws, rules.step_draws)} uniforms, draws says {system.draws}")
    available = system.available(number) or system.begin(_episode(system, number))[1]
    phase = rules.phase(rules.params, number)
    state = rules.reset(rules.params, phase, draws, 0)

    may = getattr(rules, "legal", None)

    def marks() -> tuple[bool, ...]:
        return tuple(bool(rules.explorable(rules.params, phase, state, action)) for action in available)

    def legal() -> tuple[bool, ...]:
        return tuple(may is None or bool(may(rules.params, phase, state, action)) for action in available)

    moments = [_Moment(-1, state, 0.0, False, marks(), legal(), None, ())]
    rng = random.Random(number)
    context = np.zeros(len(system.signal_names))
    for step in range(min(system.max_steps, LONGEST)):
        action = rng.choice([action for action, whether in zip(available, legal(), strict=True) if whether])
        context[:] = base
        at = rules.reset_draws + step * rules.step_draws
        state, reward, terminated = rules.step(rules.params, phase, state, action, draws, at, context)
        ended = bool(terminated) or step + 1 == system.max_steps
        after = ((), ()) if ended else (marks(), legal())
        moments.append(_Moment(action, state, float(reward), ended, *after, None, tuple(context.tolist())))
        if ended:
            break
    return moments


def _added(system: ManagedSystem, one: list[_Moment], other: list[_Moment], where: str) -> None:
    """See that the steps of the other episode, begun with 1 in each signal, added to it what those of the first did."""
    for step, (first, second) in enumerate(zip(one, other, strict=False)):
        for name, from_none, from_one in zip(system.signal_names, first.signals, second.signals, strict=False):
            if abs(from_one - 1.0 - from_none) > 1e-6 * max(1.0, abs(from_none)):
                raise Broken(
                    f"{where} leaves {name} at {from_none} where it was 0 before step {step}, and at {from_one} where "
                    "it was 1; a step adds to the context, of which the episode's mean is made"
                )


def _compare(one: list[_Moment], other: list[_Moment], where: str) -> None:
    for step, (first, second) in enumerate(zip(one, other, strict=False)):
        if first != second:
            raise Broken(f"{where} differs at step {step}: {first} and {second}")
    if len(one) != len(other):
        raise Broken(f"{where} has {len(one) - 1} and {len(other) - 1} steps")


def _learn(system: ManagedSystem, engine: str, episodes: int) -> list[Any]:
    """Return the observations of a few episodes and, last, the hash of the Q-table."""
    learnt: list[Any] = []
    knowledge = Knowledge(Log(RowLayout(SIGNALS + system.signal_names, 0, 3, 4096)))
    learner = registry.build("learner", PartSpec(name="q_learning"))
    execute = Execute(system, learner, knowledge, learnt.append, engine=engine, max_actions=4096)
    execute.adopt(ChangePlan(0, 0, 0.5, (0.1, 0.9, 5.0), (), (), (), False, None))
    for _ in range(episodes):
        execute.drive()
    return [*learnt, execute.q_table.sha256()]
