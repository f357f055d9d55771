"""Every contract of the loop on one screen.

A part is any object with these members; nothing is inherited. `mape.testing` checks them.

A detector, analyzer, schedule or planner may also have

- `state_format`, a name such as ``"page_hinkley/1"`` of what its `state` gives: a part that takes its place in a
  running loop and has the same one takes over its state. A planner that keeps its schedule in an attribute `schedule`,
  and asks it anew at each plan, can be given another one;
- `threshold`, of a detector: the number that its statistic is held against, or None; figures draw it beside;
- `quiet`, a `QuietRule`: where all parts declare one, and the system offers its rules, a stretch of passes in which
  nothing changes is one compiled call (`mape.stretch`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from knowledge import ChangePlan, ChangeRequest, Knowledge, Symptom
from knowledge.records import Direction

Json = Any
"""What the standard library's JSON writes: None, bool, int, float, str, list, dict."""


class QuietRule(NamedTuple):
    """What a part does in a quiet pass: no alarm, and the actions on offer are those of the Q-table.

    Attributes
    ----------
    function : the rule, pure but for `state`, which it changes in place. Plain Python that Numba can compile: a
        module-level function, or a `mape.compose.Composed`. By the kind of the part:

        - detector: ``(state, params, x) -> (alarm, statistic, direction)``, the statistic NaN for none, the direction
          a code of `knowledge.rows.DIRECTIONS`. The part's `update` does the same;
        - analyzer: ``(state, params, signals) -> changed``: whether it would ask for a change although no detector
          alarms and the sets of actions are equal;
        - planner: ``(state, params, signals) -> epsilon``: the exploration rate of its answer to a request in which
          nothing changed, which repeats the learning rate of the plan before and asks for nothing else;
        - schedule: ``(state, params, episode_return) -> epsilon``: its `advance`, and the `epsilon` after it.

        `signals` are the signals of the pass in the order of the run, from the return on. Of what is computed, plain
        Python and Numba give the same bits for ``+ - * /``, `math.sqrt`, `exp`, `log` and the like; not for ``**``,
        `math.hypot`, `gamma` and `lgamma`. Outside of a function's domain, where Python raises, Numba gives NaN.
        An index beyond state, params or signals, where Python raises, reads or writes other memory. So each rule is
        called in Python before it is compiled, once in a process, and refused if it always reaches beyond its numbers;
        a negative index, and what a rule does but rarely, only `mapek check` can find.
    state : the numbers that the part carries, live: a list that its own methods work on, and that is written anew after
        a compiled stretch. The function gets it, or a float64 array of the same numbers.
    params : its fixed numbers.
    """

    function: Any
    state: list[float]
    params: tuple[float, ...] = ()


class Detector(Protocol):
    """Watches one signal for a change of its distribution; fed once per pass."""

    direction: Direction

    @property
    def statistic(self) -> float | None: ...
    def update(self, x: float) -> bool: ...
    def reset(self) -> None: ...
    def state(self) -> Json: ...
    def restore(self, state: Json) -> None: ...


class Analyzer(Protocol):
    """Turns a symptom into a change request, or into one that says "nothing changed"."""

    def analyze(self, symptom: Symptom) -> ChangeRequest: ...
    def state(self) -> Json: ...
    def restore(self, state: Json) -> None: ...


class Schedule(Protocol):
    """Exploration rate over the episodes since the last response."""

    @property
    def epsilon(self) -> float: ...
    def advance(self, episode_return: float) -> None: ...
    def reset(self) -> None: ...
    def state(self) -> Json: ...
    def restore(self, state: Json) -> None: ...


class Planner(Protocol):
    """Answers a change request with the plan of the next episode."""

    def start(self, loop: int) -> ChangePlan: ...
    def plan(self, request: ChangeRequest, knowledge: Knowledge) -> ChangePlan: ...
    def state(self) -> Json: ...
    def restore(self, state: Json) -> None: ...


class Learner(Protocol):
    """Two pure rules that Numba can compile, and the names of the learning-rate parameters that they take.

    `value(q, rows, count, state, best, epsilon)` is the worth of a state, from which the TD target bootstraps: `best`
    is the row of ``q`` that the greedy choice takes there, and ``rows[:count]`` are those of which exploration, whose
    rate is `epsilon`, takes one at random. `best` is not always among them: a mask limits exploration alone, if the run
    does not say otherwise. `step_size(td_error, rate)` is the learning rate of one update.

    A learner whose `value` never looks at the rows may say ``on_policy = False``; then they are not sought, which saves
    time, and may be any.
    """

    rate_names: tuple[str, ...]
    discount: float
    bootstrap_terminal: bool
    value: Callable[..., float]
    step_size: Callable[..., float]


class StepRules(Protocol):
    """The compilable face of a managed system: pure rules over `params`, an immutable named tuple.

    The rules take their randomness as uniforms on [0, 1): `reset` reads ``draws[at : at + reset_draws]``, a `step`
    ``draws[at : at + step_draws]``. A step adds its values of the system's own signals to `context`.

    They may have `legal`, ``(params, phase, state, action) -> bool``: whether an action may be taken there at all. What
    is not legal is neither explored, nor chosen greedily, nor bootstrapped from. `explorable` is softer: it bars an
    action from exploration alone, where there is another.
    """

    @property
    def params(self) -> Any: ...
    @property
    def phase(self) -> Callable[..., int]: ...  # (params, episode) -> phase
    @property
    def reset(self) -> Callable[..., int]: ...  # (params, phase, draws, at) -> state
    @property
    def step(self) -> Callable[..., tuple[int, float, bool]]: ...  # (params, phase, state, action, draws, at, context)
    @property
    def explorable(self) -> Callable[..., bool]: ...  # (params, phase, state, action)
    @property
    def windows(self) -> npt.NDArray[np.int64]: ...  # (actions, 2): first and last episode of each action
    @property
    def reset_draws(self) -> int: ...
    @property
    def step_draws(self) -> int: ...


class Episode(NamedTuple):
    """What a managed system is told when an episode begins."""

    number: int
    seed: int
    uniforms: npt.NDArray[np.float64]


class ManagedSystem(Protocol):
    """What Execute drives. States are indices below `n_states`, actions stable integers below `max_actions`.

    It may also have

    - `legal_actions`, a frozenset of the ids that may be taken in the present state at all, or None where all that are
      offered may;
    - `taken`, the id of the action that the last step took in the place of the chosen one, or None: the update is then
      that action's;
    - ``held(stated=False)``, which returns name -> fingerprint of what it holds: after two equal resets the same, where
      it carries nothing beside what `get_state` says (with `stated`, nothing at all). What differs is named by `mapek
      check`, and keeps a restarted process from going on with a state that does not tell it.
    """

    name: str
    n_states: int
    max_steps: int
    signal_names: tuple[str, ...]
    drifts: tuple[int, ...]  # episodes from which a new regime holds, where known; for evaluation only
    draws: tuple[int, int]  # uniforms that a reset and a step take from the pass's block
    redrivable: bool  # whether an episode can be driven again after others; not so for a plant, or another's process
    rules: StepRules | None

    def available(self, episode: int) -> tuple[int, ...] | None:
        """Say which actions episode `episode` will offer, or None where only its reset can tell."""
        ...

    def begin(self, episode: Episode) -> tuple[int, tuple[int, ...]]:
        """Reset; return the first state and the available actions."""
        ...

    def step(self, action: int, context: npt.NDArray[np.float64]) -> tuple[int, float, bool, bool]:
        """Act; return next state, reward, terminated, truncated; add the step's own signals to `context`."""
        ...

    def explorable(self, action: int) -> bool:
        """Whether exploration may try `action` in the present state."""
        ...

    def enable(self, actions: tuple[int, ...]) -> None:
        """Switch reserve actions on, from the next episode."""
        ...

    def get_state(self) -> Json:
        """Return what is carried from one episode to the next; None where that is nothing, or is not said."""
        ...

    def set_state(self, state: Json) -> None:
        """Go on from what `get_state` gave, here or elsewhere."""
        ...

    def renew(self) -> None:
        """Close, and be another object of the same system, as freshly made; asked for after it has failed."""
        ...

    def close(self) -> None:
        """Release what the system holds."""
        ...
