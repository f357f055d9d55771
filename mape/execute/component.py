"""The Execute component: drives episodes under the plan in force, and owns the Q-table."""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from knowledge import ChangePlan, Knowledge, Observation, QTable
from mape.errors import ConfigError, ManagedSystemError, MapekError, NonFiniteError, PartError
from mape.execute import adoption, binding, drive, episode
from mape.execute.attempts import Attempts
from mape.execute.checkpoint import Checkpoint, Held, carried_by, differing, held_by, take_up
from mape.execute.refusals import broken_off, check_offer, refused
from mape.execute.rules import rate_array
from mape.execute.uniforms import WIDE, Drawn, Reaching, Uniforms
from mape.execute.workspace import Workspace
from mape.ports import Episode, Json, Learner, ManagedSystem
from mape.states import STOPS, faults, told
from mape.values import shown, whole

SIGNALS = ("return", "steps", "td_error", "q_change")
"""Signals of every run: return, steps, mean |TD error|, largest absolute change of Q; the system's own follow."""

_new = tuple.__new__

T = TypeVar("T")


class Execute:
    """Drives one episode per pass, and reports it.

    An episode is a pure function of (config, seed, trial, number, Q, plan): its randomness is a block of uniforms of
    fixed size from the trial's generator, and for systems that do not take it a seed made from seed, trial and number.

    Making one does nothing to the system. Where only a reset can tell which actions there are, there is no Q-table
    before the first episode is begun.

    Parameters
    ----------
    system, learner
        What is managed, and how it learns.
    knowledge
        Its entries ``actions`` and the Q-table are written here; the number of its log's loop stands in the records.
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
    retries
        How often an episode that the system broke off is begun again, by another object of the system.
    checkpoint
        State and Q-table, as `state` gives them. This Execute goes on from there, as by `restore`.

    Raises
    ------
    ConfigError
        The engine is ``"compiled"``, and the system offers no rules, or some that cannot be compiled.
    ManagedSystemError
        The system offers no legal action, or does not go on from what the checkpoint carries.
    PartError
        The checkpoint is not of an Execute of the same config.
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
        retries: int = 0,
        checkpoint: tuple[Json, QTable] | None = None,
    ) -> None:
        self.system = system
        self.learner = learner
        self.plan: ChangePlan | None = None
        self.passes = 0
        self._knowledge = knowledge
        self._send = send
        self._loop = knowledge.log.loop
        self._seeds = (seed, loop, trial)
        self._max_actions = max_actions
        self.attempts = Attempts(system, retries)
        self.driving = 0  # the episode that is being driven, as other threads see it
        self._own_signals = system.signal_names
        self.trace: Callable[[int, npt.NDArray[np.float64]], object] | None = None
        self._traced = range(0)

        if engine == "compiled" and system.rules is None:
            raise ConfigError(
                f"engine 'compiled' needs a system that offers its rules; {system.name} does not. Choose 'auto' or "
                "'python'; one with a transition table offers them with system.tabulated = true."
            )
        self.rules = None if engine == "python" else system.rules
        reset_draws, step_draws = system.draws
        cap = system.max_steps
        self._system_draws = reset_draws + cap * step_draws
        width = self._system_draws + 2 * cap
        self.uniforms: Uniforms | Drawn | Reaching
        if width <= WIDE:
            self.uniforms = Uniforms(seed, (loop, trial), width)
        elif self.rules is None:
            self.uniforms = Drawn(seed, (loop, trial), width)
        else:
            self.uniforms = Reaching(seed, (loop, trial), reset_draws, step_draws, cap)

        self._workspace = Workspace(cap, self.rules is None or getattr(self.rules, "legal", None) is not None)
        self._context = np.zeros(len(system.signal_names))
        self._no_trace = np.empty((0, len(episode.TRACE_COLUMNS)))
        self._limits = (mask_greedy, reset_draws, step_draws)
        self._called = drive.Called(system)
        self._target: Any = self._called if self.rules is None else self.rules.params
        self.available: tuple[int, ...] = ()
        self._enabled: tuple[int, ...] = ()  # by all plans so far
        self._rate = rate_array((0.0,) * len(learner.rate_names))

        self._table: QTable | None = None
        self._begun = 0  # the episode whose reset has been done ahead of its drive
        self._look_at = 0  # the episode after whose reset the system is looked at
        self._held: Held | None = None
        if checkpoint is not None:
            self.restore(*checkpoint)
        elif (first := system.available(1)) is not None:  # else only the reset of episode 1 can tell
            self._set_up(first)
        knowledge.serve_q_table(lambda: self.q_table.copy())

    @property
    def q_table(self) -> QTable:
        """The Q-table.

        Raises
        ------
        PartError
            There is none yet: only the first reset tells which actions the system has.
        """
        if self._table is None:
            raise PartError(
                f"there is no Q-table yet: which actions {self.system.name} has, its first reset tells, which is that "
                "of episode 1"
            )
        return self._table

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
            rates = adoption.checked_rate(plan, self.learner)
        if add or drop or enable or adopt is not None:
            if self._table is None:
                self._tried(1, self._begin_first)
            table = adoption.table_after(plan, self.q_table, self.available, self.system, self._knowledge)
            if enable:
                self._enable(plan)
            self._set_table(table)
        if changed:
            self._rate = rates
            if self._table is not None:
                self._fix_arguments()
        self.plan = plan

    def drive(self) -> None:
        """Run the next episode under the plan in force and send its Observation.

        One that the system breaks off is begun again as `attempts` say.

        Raises
        ------
        ManagedSystemError
            The system raised, offered no action, or left its state space. The Q-table is as before the episode.
        NonFiniteError
            A reward, a TD error or a signal was NaN or infinite. The Q-table is as before the episode.
        """
        number = self.passes + 1
        if self.attempts.retries:
            self.look_at(number)  # another object that does not stand where this one did is not driven
        steps, signals = self._tried(number, self._attempt)
        self.attempts.over()
        self.observe(steps, signals)

    def _tried(self, number: int, attempt: Callable[[int], T]) -> T:
        """Return what an attempt at episode `number` gives, or the next one where the system breaks it off."""
        again = False
        self.driving = number
        try:
            while True:
                try:
                    if again:
                        self.attempts.begun_again(number, self._enabled)
                    return attempt(number)
                except ManagedSystemError as error:
                    self._begun = 0
                    self.attempts.broken_off(number, error)
                    again = True
        finally:
            self.driving = 0

    def _attempt(self, number: int) -> tuple[int, dict[str, float]]:
        """Drive episode `number`; return its steps and signals."""
        plan = self.plan
        if plan is None:
            raise PartError("no plan is in force; plan 0 starts a run")
        self._workspace.forget()
        at = self.uniforms.find(self.passes)

        available = self.system.available(number) if self.rules is not None else None
        if available is None:
            if self._table is None:
                self._begin_first(number)
            if self._begun == number:
                available, self._begun = self.available, 0
            else:
                available = self._begin(number, at)
        else:
            self.attempts.on_begin(number)
        if available is not self.available:
            check_offer(available, self.system, number, self._max_actions)
            self._set_rows(available)
        tracing = number in self._traced
        trace = np.empty((self.system.max_steps, len(episode.TRACE_COLUMNS))) if tracing else self._no_trace
        try:
            status, steps, total, td_error, change = self._driven(number, plan.epsilon, at, trace)
        except BaseException as caught:
            error = self._in_python(caught, number, plan.epsilon, at)
            self._workspace.roll_back()
            contract = isinstance(error, (ManagedSystemError, PartError))
            if not contract and isinstance(error, (MapekError, *STOPS)):
                raise
            if (steps := int(self._workspace.used[1])) < 0:
                raise self._failed_to_reset(error, number) from error
            # A learner's rules are called for the step that is over, the system's for the next one.
            step = steps if isinstance(error, PartError) else steps + 1
            raise broken_off(error, self.system, number, step) from error
        if status != episode.OK:
            self._workspace.roll_back()
            raise refused(status, self.system, number, steps, (total, td_error, change), self.q_table.actions)
        # NumPy's floats, with which the plain episode computes, would warn where the sums of a detector overflow.
        signals = {
            "return": float(total), "steps": float(steps), "td_error": float(td_error), "q_change": float(change)
        }  # fmt: skip
        if self._own_signals:
            self._add_own_signals(signals, number)
        if tracing and self.trace is not None:
            self.trace(number, trace[:steps])
        return steps, signals

    def observe(self, steps: int, signals: dict[str, float]) -> None:
        """Send the Observation of the next pass, whose episode is driven; if it is not taken, nothing was learnt."""
        plan, table = self.plan, self._table
        assert plan is not None
        assert table is not None
        self.passes += 1
        try:
            self._send(
                _new(
                    Observation,
                    (
                        self._loop,
                        self.passes,
                        plan.pass_no,
                        plan.epsilon,
                        plan.reset_detector,
                        steps,
                        self.available,
                        table.actions,
                        signals,
                    ),
                )
            )
        except BaseException:  # a listener of rows that raised, say: the pass is still to be made
            self.passes -= 1
            self._workspace.roll_back()
            raise

    def _driven(self, *arguments: Any) -> tuple[int, int, float, float, float]:
        """Drive an episode; one that comes to the end of the uniforms that are held is driven again with more."""
        uniforms = self.uniforms
        if not isinstance(uniforms, Reaching):
            return self._drive(*arguments, *self._fixed)
        while True:
            if self._reached is not uniforms.values:
                self._fix_arguments()
            found = self._drive(*arguments, *self._fixed)
            if not uniforms.further(found[1]):
                break
            self._workspace.roll_back()
            self._workspace.forget()
        uniforms.settle(found[1])
        return found

    def _in_python(self, error: BaseException, *arguments: Any) -> BaseException:
        """Return what an episode that raised where it was compiled raises in Python, which tells whose rule it was."""
        if self.rules is None or isinstance(error, (MapekError, *STOPS)):
            return error
        self._workspace.roll_back()
        self._workspace.forget()
        try:
            binding.by_rules_in_python(self.rules, self.learner)(*arguments, self._no_trace, *self._fixed)
        except faults() as told_apart:
            return told_apart
        return error

    def quiet_until(self, last: int) -> int:
        """Return the pass, `last` at most, up to which all episodes are alike.

        They offer the same actions, which are those of the Q-table; none is traced, and the plan in force asks for
        nothing else than to explore. Where not even the next one is such, the passes that are finished.
        """
        plan, number = self.plan, self.passes + 1
        if self.rules is None or plan is None or plan.reset_detector or number in self._traced:
            return self.passes
        if isinstance(self.uniforms, Reaching):  # how far it has to reach, each episode finds out by itself
            return self.passes
        available = self.system.available(number)
        if available is not self.available or set(self.available) != set(self.q_table.actions):
            return self.passes
        first, end = self.rules.windows.T
        edges: list[int] = [*(first - 1).tolist(), *end.tolist(), self._traced.start - 1]
        return min(last, *(edge for edge in edges if edge >= number))

    def follow(self, plan: ChangePlan) -> None:
        """Take the passes up to that of `plan` for made: `drive` was called in its place, with the same arguments."""
        self.plan = plan
        self.passes = plan.pass_no

    def roll_back(self) -> None:
        """Make the Q-table what it was before the last episode."""
        self._workspace.roll_back()

    @property
    def steps(self) -> int:
        """Steps of the newest episode that have returned, -1 before its reset has; as other threads see it."""
        return int(self._workspace.used[1])

    @property
    def compiled(self) -> bool:
        """Whether an episode is one compiled call."""
        return self.rules is not None

    @property
    def arguments(self) -> tuple[Any, ...]:
        """What an episode takes after its number, epsilon, and the place of its draws, where it is not traced."""
        return (self._no_trace, *self._fixed)

    def state(self) -> tuple[Json, QTable]:
        """Return what a fresh Execute needs to go on from here: plain JSON, and a copy of the Q-table.

        It is whole between two episodes; a restored Execute that is sent the plans from then on drives the same ones.

        Raises
        ------
        ManagedSystemError
            The system raised when it was asked for what it carries.
        """
        carried = carried_by(self.system)
        at = Checkpoint(self.passes, self.plan, self.available, self._enabled, carried, self._held)
        return at.as_json(), self.q_table.copy()

    def restore(self, state: Json, table: QTable) -> None:
        """Go on where `state` was given by another Execute of the same config, trial and loop; this one is fresh.

        Raises
        ------
        PartError
            State or table are not of such an Execute.
        ManagedSystemError
            The system does not go on from what the other one carried.
        """
        at = Checkpoint.of(state)
        if table.n_states != self.system.n_states:
            raise PartError(
                f"Execute cannot go on with a Q-table of {table.n_states} states; {self.system.name} has "
                f"{self.system.n_states}"
            )
        rate = self._rate if at.plan is None else adoption.checked_rate(at.plan, self.learner)
        take_up(self.system, at.system, at.enabled)
        self.attempts.carried = at.system
        self.passes, self.plan, self._rate, self._enabled, self._held = at.passes, at.plan, rate, at.enabled, at.held
        self._take_actions(at.available, self.passes)
        self._set_table(table.copy())

    def look_at(self, number: int) -> None:
        """Look at what the system holds after the reset of episode `number`, which the states from then on tell.

        A reset of that episode that comes again, in this process, raises where it does not leave the system as the
        first one did.
        """
        self._look_at = number

    def carries(self) -> list[str]:
        """Return what a restored Execute's fresh system lacks, by name: what the one before it carried across resets.

        It is reset for the episode after whose reset the other one was looked at, and is then to hold the same. If it
        does not, no state tells where the other one was, and only all episodes driven again lead there.

        Raises
        ------
        ManagedSystemError
            The system raised at its reset, or does not take its state again.
        """
        if self._held is None or not self._held[1] or not held_by(self.system):
            return []
        number, before = self._held
        carried = carried_by(self.system)
        self._begin(number, self.uniforms.find(number - 1))
        names = differing(before, held_by(self.system))
        take_up(self.system, carried, ())  # the reset is none of the run
        return names

    def replace(self, learner: Learner) -> None:
        """Learn by another learner from the next episode on; the Q-table and the plan in force stay.

        Raises
        ------
        PartError
            It takes another number of learning-rate parameters; then the old one stays.
        ConfigError
            Its rules cannot be compiled; then the old one stays.
        """
        old, new = self.learner.rate_names, learner.rate_names
        if len(new) != len(old):
            raise PartError(
                f"learner {type(learner).__name__} takes {len(new)} learning-rate parameters ({', '.join(new)}), the "
                f"one before it {len(old)} ({', '.join(old)}); the number is fixed for a run"
            )
        if self._table is None:
            self.learner = learner  # bound with the table
            return
        self._drive, self.learner = self._bound(learner), learner
        self._fix_arguments()

    def _bound(self, learner: Learner) -> binding.Driver:
        if self.rules is None:
            return binding.by_calls(learner)
        return binding.by_rules(self.rules, learner, (1, 0.5, 0, self._no_trace, *self._arguments(learner)))

    def _fix_arguments(self) -> None:
        self._reached = self.uniforms.values
        self._fixed = self._arguments(self.learner)

    def _arguments(self, learner: Learner) -> tuple[Any, ...]:
        # What stays from episode to episode, in the order of `episode.episode`.
        return (
            self._target,
            *self._workspace.arguments,
            self._rate,
            self.uniforms.values,
            self._context,
            learner.discount,
            learner.bootstrap_terminal,
            bool(getattr(learner, "on_policy", True)),  # one that does not say so gets what it may need
            *self._limits,
            self.uniforms.reach if isinstance(self.uniforms, Reaching) else self.system.max_steps,
        )

    def _begin_first(self, number: int) -> None:
        """Begin episode `number`, 1, which tells what the Q-table has rows for; its drive goes on from there."""
        first = self._begin(number, self.uniforms.find(0))
        self._begun = number
        self._set_up(first)

    def _set_up(self, first: tuple[int, ...]) -> None:
        self._take_actions(first, 1)
        self._set_table(QTable(first, self.system.n_states))

    def _begin(self, number: int, at: int) -> tuple[int, ...]:
        seed, *key = self._seeds
        sequence = np.random.SeedSequence(entropy=seed, spawn_key=(*key, number))
        self.attempts.on_begin(number)
        block = self.uniforms.block(at, self._system_draws)  # a copy: a system may keep what it is told
        told = Episode(number, int(sequence.generate_state(1)[0]), block)
        try:
            state, available = self.system.begin(told)
        except ManagedSystemError as error:
            raise self._failed_to_reset(error, number) from error
        except MapekError:
            raise
        except faults() as error:
            raise self._failed_to_reset(error, number) from error
        if (first := whole(state)) is None:
            raise ManagedSystemError(
                f"{self.system.name} began episode {number} in state {shown(state)}; a state is an int from 0 to "
                f"{self.system.n_states - 1}"
            )
        self._called.state = first
        if number == self._look_at:
            self._look(number)
        # One object as long as nothing changes: what compares by identity is cheap downstream.
        return self.available if available == self.available else available

    def _look(self, number: int) -> None:
        before, now = self._held, held_by(self.system)
        if before is not None and before[0] == number and (names := differing(before[1], now)):
            raise ManagedSystemError(
                f"{self.system.name} is begun again in episode {number}, and carries {', '.join(names)} from one reset "
                "to the next: it is not as it was. Offer get_state() and set_state(), or take it from the reset's "
                "seed and options['episode']; or, where no episode can be had again, say redrivable = False."
            )
        self._held = number, now

    def _failed_to_reset(self, error: BaseException, number: int) -> ManagedSystemError:
        what = f"{self.system.name} raised {told(error)}"
        if isinstance(error, ManagedSystemError):
            what = str(error).rstrip(".")
        return ManagedSystemError(
            f"{what}, at the reset of episode {number}. The {self.passes} passes before it stand in the log."
        )

    def _take_actions(self, available: tuple[int, ...], number: int) -> None:
        check_offer(available, self.system, number, self._max_actions)
        self.available = available

    def _add_own_signals(self, signals: dict[str, float], number: int) -> None:
        for name, value in zip(self._own_signals, self._context.tolist(), strict=True):
            if not isfinite(value):
                self._workspace.roll_back()
                raise NonFiniteError(
                    f"{self.system.name} gave {name} = {value} in episode {number}; signals are finite. Nothing of "
                    f"that episode was learnt; the {self.passes} passes before it stand in the log."
                )
            signals[name] = value

    def _set_table(self, table: QTable) -> None:
        self._table = table
        self._workspace.open(table)
        self._knowledge.actions = table.actions
        self._set_rows(self.available)
        # A table of a single row has another type in compiled code than one of several.
        self._drive = self._bound(self.learner)

    def _set_rows(self, available: tuple[int, ...]) -> None:
        if not self._workspace.offer(available):
            raise ManagedSystemError(
                f"{self.system.name} offers actions {available}, of which the Q-table knows none: it has "
                f"{self.q_table.actions}. A new action is first tried in the episode after the one that reports it, so "
                "at least one known action must stay."
            )
        self._fix_arguments()
        self.available = available

    def _enable(self, plan: ChangePlan) -> None:
        adoption.enable(plan, self.system)
        self._enabled += tuple(action for action in plan.enable if action not in self._enabled)
        after = self.system.available(self.passes + 1)
        if after is not None:
            self.available = after
