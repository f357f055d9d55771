"""Measures of a run: convergence per stage, detection of drifts, trailing means; lengths of paths.

All but the last are over arrays (trials, episodes).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


class Stage(NamedTuple):
    """Convergence within one stage, by the rule of the function that found it.

    Attributes
    ----------
    converged : episode within the stage, from 1, of each trial that converged.
    trials : number of all trials; the others are censored, not late.
    length : episodes of the stage.
    """

    converged: npt.NDArray[np.int64]
    trials: int
    length: int

    @property
    def share(self) -> float:
        """Share of the trials that converged."""
        return len(self.converged) / self.trials

    def restricted_mean(self) -> float:
        """Return the mean over all trials, a censored one counted with the stage's length."""
        late = (self.trials - len(self.converged)) * self.length
        return float((self.converged.sum() + late) / self.trials)


def stages(episodes: int, drifts: Sequence[int]) -> list[tuple[int, int]]:
    """Return first and last episode of each stage.

    >>> stages(10, [4, 8])
    [(1, 3), (4, 7), (8, 10)]
    """
    firsts = [1, *(d for d in drifts if d <= episodes)]
    return [(first, last) for first, last in zip(firsts, [*(f - 1 for f in firsts[1:]), episodes], strict=True)]


def convergence(q_change: Floats, drifts: Sequence[int], threshold: float = 0.01) -> list[Stage]:
    """Find when the Q-table came to rest: the paper's rule (arXiv 2601.20714, Table 1).

    A trial converges in a stage at the first episode at whose end the largest absolute change of Q since the episode
    before is below `threshold`; a stage counts only where the one before it converged.

    Parameters
    ----------
    q_change
        Shape (trials, episodes).
    drifts
        Episodes from which a new stage holds.
    """
    trials, episodes = q_change.shape
    alive = np.ones(trials, dtype=bool)
    found = []
    for first, last in stages(episodes, drifts):
        at_rest = q_change[:, first - 1 : last] < threshold
        alive &= at_rest.any(axis=1)
        found.append(Stage(at_rest.argmax(axis=1)[alive] + 1, trials, last - first + 1))
    return found


def recovery(steps: Floats, drifts: Sequence[int], limit: int = 18, run: int = 10) -> list[Stage]:
    """Find when performance was back: the first episode from which `run` episodes in a row have at most `limit` steps.

    A measure beside the paper's, which asks whether Q rests. 18 steps are within 10 of the gridworld's shortest path of
    8. All episodes of the row lie in the same stage, and each stage counts by itself, whatever the one before it did.

    Parameters
    ----------
    steps
        Shape (trials, episodes).
    drifts
        Episodes from which a new stage holds.
    """
    trials, episodes = steps.shape
    found = []
    for first, last in stages(episodes, drifts):
        length = last - first + 1
        if length < run:
            found.append(Stage(np.empty(0, dtype=np.int64), trials, length))
            continue
        short = steps[:, first - 1 : last] <= limit
        windows: npt.NDArray[np.bool_] = np.lib.stride_tricks.sliding_window_view(short, run, axis=1)
        rows = np.all(windows, axis=2)
        found.append(Stage(rows.argmax(axis=1)[np.any(rows, axis=1)] + 1, trials, length))
    return found


class Detection(NamedTuple):
    """How one drift was met.

    Attributes
    ----------
    recall : share of trials with an alarm within the window, and before the next drift.
    delay_mean : mean number of episodes of the new regime up to that alarm, its own included; None where no trial
        detected the drift. An alarm at the first episode of the new regime has delay 1.
    delay_median : median of the same.
    false_alarms : mean number per trial of the stage's other alarms.
    """

    recall: float
    delay_mean: float | None
    delay_median: float | None
    false_alarms: float


def detection(
    alarms: Sequence[Sequence[int]], drifts: Sequence[int], episodes: int, window: int
) -> tuple[list[Detection], float]:
    """Measure how each drift was met, and the mean number of alarms per trial before the first.

    Parameters
    ----------
    alarms
        Per trial, the episodes at whose end an alarm was raised, increasing.
    drifts
        Episodes from which a new stage holds.
    window
        Number of episodes from the drift on in which an alarm counts as its detection.
    """
    (first, last), *after = stages(episodes, drifts)
    initial = sum(first <= a <= last for trial in alarms for a in trial) / len(alarms)
    found = []
    for first, last in after:
        here = [[a for a in trial if first <= a <= last] for trial in alarms]
        delays = [trial[0] - first + 1 for trial in here if trial and trial[0] - first < window]
        others = sum(len(trial) for trial in here) - len(delays)
        found.append(
            Detection(
                len(delays) / len(alarms),
                float(np.mean(delays)) if delays else None,
                float(np.median(delays)) if delays else None,
                others / len(alarms),
            )
        )
    return found, initial


def trailing_mean(values: Floats, window: int, episode: int) -> Floats:
    """Return each trial's mean over the last `window` episodes up to `episode`."""
    return np.asarray(values[:, max(0, episode - window) : episode].mean(axis=1), dtype=np.float64)


def greedy_length(
    values: Floats, actions: Sequence[int], rules: Any, episode: int, available: Sequence[int]
) -> int | None:
    """Follow the greedy policy of a Q-table through a deterministic system's rules.

    Parameters
    ----------
    values, actions
        Q-table, shape (actions, states), and the ids of its rows.
    rules
        The system's rules, as `mape.ports.StepRules`.
    episode, available
        Which regime and actions hold.

    Returns
    -------
    Number of steps to a terminal state, or None where the policy runs in a circle.
    """
    rows = [row for row, action in enumerate(actions) if action in available]
    state, move = _walk(rules, episode)
    seen: set[int] = set()
    while state not in seen:
        seen.add(state)
        row = rows[int(np.argmax(values[rows, state]))]
        state, terminated = move(state, actions[row])
        if terminated:
            return len(seen)
    return None


def shortest_path(system: Any, episode: int) -> int | None:
    """Find a shortest path to a terminal state by breadth-first search over a deterministic system's rules.

    Parameters
    ----------
    system
        As `mape.ports.ManagedSystem`, with rules.
    episode
        Whose regime and actions hold.

    Returns
    -------
    Number of its steps, or None where no path leads there.
    """
    start, move = _walk(system.rules, episode)
    frontier = {start}
    seen = set(frontier)
    for length in range(1, system.n_states + 1):
        reached = set()
        for state in frontier:
            for action in system.available(episode) or ():
                following, terminated = move(state, action)
                if terminated:
                    return length
                reached.add(following)
        frontier = reached - seen
        seen |= frontier
    return None


def _walk(rules: Any, episode: int) -> tuple[int, Callable[[int, int], tuple[int, bool]]]:
    """Return the first state of an episode, and where an action leads from a state, and whether that is the end."""
    draws = np.zeros(rules.reset_draws + rules.step_draws + 1)  # deterministic systems ignore their uniforms
    context = np.zeros(len(rules.signal_names))
    phase = rules.phase(rules.params, episode)

    def move(state: int, action: int) -> tuple[int, bool]:
        following, _, terminated = rules.step(rules.params, phase, state, action, draws, 0, context)
        return following, terminated

    return rules.reset(rules.params, phase, draws, 0), move
