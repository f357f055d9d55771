"""The Execute component: drives episodes under the plan in force, and owns the Q-table."""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite
from typing import Any

import numpy as np
import numpy.typing as npt

from knowledge import ChangePlan, Knowledge, Observation, QTable
from mape.errors import ConfigError, ManagedSystemError, MapekError, NonFiniteError, PartError
from mape.execute import binding, drive, episode
from mape.execute.refusals import refused
from mape.execute.rules import rate_array
from mape.ports import Episode, Learner, ManagedSystem

SIGNALS = ("return", "steps", "td_error", "q_change")
"""Signals of every run: return, steps, mean |TD error|, largest absolute change of Q; the system's own follow."""

DRAWS_AT_ONCE = 8192
"""Uniforms drawn from the trial's generator in one go: cheaper per pass, and the same stream."""

_new = tuple.__new__


class Execute:
    """Drives one episode per pass, and reports it.

    An episode is a pure function of (config, seed, trial, number, Q, plan): its randomness is a block of uniforms of
    fixed size from the trial's generator, and for systems that do not take it a seed made from seed, trial and number.

    Parameters
    ----------
    system, learner
        What is managed, and how it learns.
    knowledge
        Its entries ``actions`` and the Q-table are written here.
    send
        Takes the Observation.
    seed, trial, loop
        Which stream of randomness is used.
    engine
        ``"compiled"``: one compiled call per episode, of the rules that the system offers; ``"python"``: the same
        through the system's ``step``; ``"auto"``: compiled where rules are offered.
    mask_greedy
        Whether the system's action mask limits the greedy choice and the TD target too, not only exploration.
    max_actions
        Largest number of actions that the run's records can hold.
    """

    def __init__(
        self,
        system: ManagedSystem,
        learner: Learner,
        knowledge: Knowledge,
        send: Callable[[Observation], object],
        *,
        seed: int = 0,
        trial: int = 0,
        loop: int = 0,
        engine: str = "auto",
        mask_greedy: bool = False,
        max_actions: int = 64,
    ) -> None:
        self.system = system
        self.learner = learner
        self.plan: ChangePlan | None = None
        self.passes = 0
        self._knowledge = knowledge
        self._send = send
        self.trial = trial
        self._loop = loop
        self._seeds = (seed, loop, trial)
        self._max_actions = max_actions
        self._own_signals = system.signal_names
        self.trace: Callable[[int, npt.NDArray[np.float64]], object] | None = None
        self._traced = range(0)

        if engine == "compiled" and system.rules is None:
            raise ConfigError(
                f"engine 'compiled' needs a system that offers its rules; {system.name} does not. Choose 'auto' or "
                "'python'."
            )
        self._rules = None if engine == "python" else system.rules
        reset_draws, step_draws = system.draws
        cap = system.max_steps
        self._system_draws = reset_draws + cap * step_draws
        self._width = self._system_draws + 2 * cap
        self._per_refill = max(1, DRAWS_AT_ONCE // self._width)
        sequence = np.random.SeedSequence(entropy=seed, spawn_key=(loop, trial))
        self._generator = np.random.Generator(np.random.PCG64(sequence))
        self._uniforms = np.empty(self._per_refill * self._width)
        self._drawn = -1  # passes before those whose blocks are in `_uniforms`

        self._journal = np.empty(cap, dtype=np.int64)
        self._saved = np.empty(cap)
        self._used = np.zeros(2, dtype=np.int64)
        self._context = np.zeros(len(system.signal_names))
        self._no_trace = np.empty((0, len(episode.TRACE_COLUMNS)))
        self._tail = (learner.discount, learner.bootstrap_terminal, mask_greedy, reset_draws, step_draws, cap)
        self._called = drive.Called(system)
        self._target: Any = self._called if self._rules is None else self._rules.params
        self._available: tuple[int, ...] = ()
        self._rate = rate_array((0.0,) * len(learner.rate_names))

        self._begun = 0  # the episode whose reset has been done ahead of its drive
        first = system.available(1)
        if first is None:  # only a reset can tell; episode 1 then goes on from it
            self._draw()
            first = self._begin(1, self._uniforms[: self._width])
            self._begun = 1
        self._take_actions(first, 1)
        self._set_table(QTable(first, system.n_states))
        self._drive = (
            binding.by_calls(learner)
            if self._rules is None
            else binding.by_rules(self._rules, learner, (1, 0.5, 0, self._no_trace, *self._fixed))
        )
        knowledge.serve_q_table(lambda: self.q_table.copy())

    def record_trace(self, first: int, last: int, listener: Callable[[int, npt.NDArray[np.float64]], object]) -> None:
        """Hand the steps of episodes `first` to `last` to `listener`, with the columns of `TRACE_COLUMNS`."""
        self._traced = range(first, last + 1)
        self.trace = listener

    def adopt(self, plan: ChangePlan) -> None:
        """Put a plan in force: enable actions, grow or shrink the Q-table, or take a remembered one.

        A plan that is refused changes nothing.

        Raises
        ------
        PartError
            The plan names an action that cannot be dropped or enabled, a table that is not remembered or does not fit,
            or a learning rate that does not.
        ManagedSystemError
            The system raised while it enabled an action.
        """
        _, _, _, rate, add, drop, enable, _, adopt = plan
        rates = self._rate
        changed = self.plan is None or (rate is not self.plan.learning_rate and rate != self.plan.learning_rate)
        if changed:
            rates = self._checked_rate(plan)
        if add or drop or enable or adopt is not None:
            table = self._table_after(plan)
            self._enable(plan)
            self._set_table(table)
        if changed:
            self._rate = rates
            self._fix_arguments()
        self.plan = plan

    def drive(self) -> None:
        """Run the next episode under the plan in force and send its Observation.

        Raises
        ------
        ManagedSystemError
            The system raised, offered no action, or left its state space. The Q-table is as before the episode.
        NonFiniteError
            A reward, a TD error or a signal was NaN or infinite. The Q-table is as before the episode.
        """
        plan = self.plan
        if plan is None:
            raise PartError("no plan is in force; plan 0 starts a run")
        number = self.passes + 1
        turn = self.passes % self._per_refill
        if turn == 0 and self._drawn != self.passes:  # an episode that failed is driven again with the same block
            self._draw()
        at = turn * self._width

        available = self.system.available(number) if self._rules is not None else None
        if available is None:
            if self._begun == number:
                available, self._begun = self._available, 0
            else:
                available = self._begin(number, self._uniforms[at : at + self._width])
        if available is not self._available:
            self._take_actions(available, number)
            self._set_rows()
        tracing = number in self._traced
        trace = np.empty((self.system.max_steps, len(episode.TRACE_COLUMNS))) if tracing else self._no_trace
        try:
            status, steps, total, td_error, change = self._drive(number, plan.epsilon, at, trace, *self._fixed)
        except BaseException as error:
            self._roll_back()
            if isinstance(error, MapekError) or not isinstance(error, Exception):
                raise
            raise ManagedSystemError(
                f"{self.system.name} raised {type(error).__name__}: {error}, in episode {number} at step "
                f"{int(self._used[1]) + 1}. Nothing of that episode was learnt; the {self.passes} passes before it "
                "stand in the log."
            ) from error
        if status != episode.OK:
            self._roll_back()
            raise refused(status, self.system, number, steps, (total, td_error, change))
        signals = {"return": total, "steps": float(steps), "td_error": td_error, "q_change": change}
        if self._own_signals:
            self._add_own_signals(signals, number)
        self.passes = number
        if tracing and self.trace is not None:
            self.trace(number, trace[:steps])
        self._send(
            _new(
                Observation,
                (
                    self._loop,
                    number,
                    plan.pass_no,
                    plan.epsilon,
                    plan.reset_detector,
                    steps,
                    available,
                    self.q_table.actions,
                    signals,
                ),
            )
        )

    @property
    def compiled(self) -> bool:
        """Whether an episode is one compiled call."""
        return self._rules is not None

    def _fix_arguments(self) -> None:
        # What stays from episode to episode, in the order of `episode.episode`.
        self._fixed = (
            self._target,
            self.q_table.values,
            self._touched,
            self._journal,
            self._saved,
            self._used,
            self._rows,
            self._choices,
            self._actions,
            self._rate,
            self._uniforms,
            self._context,
            *self._tail,
        )

    def _draw(self) -> None:
        self._generator.random(out=self._uniforms)
        self._drawn = self.passes

    def _begin(self, number: int, block: npt.NDArray[np.float64]) -> tuple[int, ...]:
        seed, *key = self._seeds
        sequence = np.random.SeedSequence(entropy=seed, spawn_key=(*key, number))
        told = Episode(number, int(sequence.generate_state(1)[0]), block[: self._system_draws])
        try:
            self._called.state, available = self.system.begin(told)
        except MapekError:
            raise
        except Exception as error:
            raise ManagedSystemError(
                f"{self.system.name} raised {type(error).__name__}: {error}, at the reset of episode {number}. The "
                f"{self.passes} passes before it stand in the log."
            ) from error
        # One object as long as nothing changes: what compares by identity is cheap downstream.
        return self._available if available == self._available else available

    def _take_actions(self, available: tuple[int, ...], number: int) -> None:
        if not available:
            raise ManagedSystemError(
                f"{self.system.name} offers no action in episode {number}; a managed system has at least one available"
            )
        if len(set(available)) != len(available):
            raise ManagedSystemError(
                f"{self.system.name} offers actions {available} in episode {number}; name each action once"
            )
        for action in available:
            if not 0 <= action < self._max_actions:
                raise ManagedSystemError(
                    f"{self.system.name} offers action {action} in episode {number}; ids are integers from 0 to "
                    f"{self._max_actions - 1}. Raise system.max_actions if it has more."
                )
        self._available = available

    def _add_own_signals(self, signals: dict[str, float], number: int) -> None:
        for name, value in zip(self._own_signals, self._context.tolist(), strict=True):
            if not isfinite(value):
                self._roll_back()
                raise NonFiniteError(
                    f"{self.system.name} gave {name} = {value} in episode {number}; signals are finite. Nothing of "
                    f"that episode was learnt; the {self.passes} passes before it stand in the log."
                )
            signals[name] = value

    def _set_table(self, table: QTable) -> None:
        self.q_table = table
        # Stamps are episode numbers, from 1: a fresh table is untouched.
        self._touched = np.zeros(table.values.shape, dtype=np.int64)
        self._actions = np.array(table.actions, dtype=np.int64)
        self._knowledge.actions = table.actions
        self._set_rows()

    def _set_rows(self) -> None:
        usable = [row for row, action in enumerate(self.q_table.actions) if action in self._available]
        if not usable:
            raise ManagedSystemError(
                f"{self.system.name} offers actions {self._available}, of which the Q-table knows none: it has "
                f"{self.q_table.actions}. A new action is first tried in the episode after the one that reports it, so "
                "at least one known action must stay."
            )
        self._rows = np.array(usable, dtype=np.int64)
        self._choices = np.empty_like(self._rows)
        self._fix_arguments()

    def _checked_rate(self, plan: ChangePlan) -> npt.NDArray[np.float64]:
        names = self.learner.rate_names
        if len(plan.learning_rate) != len(names):
            raise PartError(
                f"plan {plan.pass_no} has {len(plan.learning_rate)} learning-rate parameters; the learner takes "
                f"{len(names)}: {', '.join(names)}"
            )
        rates: npt.NDArray[np.float64] = rate_array(plan.learning_rate)
        if not np.isfinite(rates).all():
            raise PartError(f"plan {plan.pass_no} has the learning rate {plan.learning_rate}; it is of finite numbers")
        return rates

    def _table_after(self, plan: ChangePlan) -> QTable:
        try:
            table = self.q_table.copy() if plan.adopt is None else self._knowledge.recall(plan.adopt)
            table.add(plan.add)
            table.drop(plan.drop)
        except (LookupError, ValueError) as error:
            raise PartError(f"plan {plan.pass_no} cannot be executed: {error}") from error
        if table.n_states != self.system.n_states:
            raise PartError(
                f"plan {plan.pass_no} adopts a Q-table of {table.n_states} states; {self.system.name} has "
                f"{self.system.n_states}"
            )
        if not set(table.actions) & {*self._available, *plan.enable}:
            raise PartError(
                f"plan {plan.pass_no} leaves a Q-table of the actions {table.actions}; {self.system.name} offers "
                f"{self._available}, of which at least one must stay"
            )
        return table

    def _enable(self, plan: ChangePlan) -> None:
        if not plan.enable:
            return
        try:
            self.system.enable(plan.enable)
        except ValueError as error:
            raise PartError(f"plan {plan.pass_no} cannot be executed: {error}") from error
        except Exception as error:
            raise ManagedSystemError(
                f"{self.system.name} raised {type(error).__name__}: {error}, while it enabled the actions "
                f"{plan.enable} of plan {plan.pass_no}"
            ) from error
        after = self.system.available(self.passes + 1)
        if after is not None:
            self._available = after

    def _roll_back(self) -> None:
        values = self.q_table.values.reshape(-1)
        used = int(self._used[0])
        values[self._journal[:used]] = self._saved[:used]
        # Driven again, the episode saves these pairs anew.
        self._touched.reshape(-1)[self._journal[:used]] = 0
