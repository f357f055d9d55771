"""Two ways to make the records of a log again.

In lockstep a whole loop runs again, its managed system included. Where the system cannot be driven again, or was not
waited for, Monitor, Analyze and Plan are fed with the Observations of the log.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Protocol

from adapters.stores import Store
from adapters.stores.sqlite_store import Swap
from knowledge import (
    STAGES,
    ChangePlan,
    ChangeRequest,
    Knowledge,
    Log,
    Observation,
    Pass,
    QTable,
    Record,
    RowLayout,
    Symptom,
)
from mape.allowed import check_part
from mape.analyze import Analyze
from mape.config import Config, SwapConfig
from mape.errors import MapekError
from mape.execute import Execute
from mape.execute.adoption import fitting
from mape.loop import Loop, build_analyze, build_execute, build_monitor, build_plan
from mape.monitor import Monitor
from mape.parts import owner
from mape.plan import Plan
from mape.ports import ManagedSystem
from mape.specs import PartSpec
from mape.swap import Component, replace_part


class Derivation(Protocol):
    """Makes the records of one loop again, in the order of its log.

    Attributes
    ----------
    failure : what a part or the system raised; nothing more is made then.
    from_observations : whether the Observations are taken from the log as they are.
    """

    failure: Exception | None
    from_observations: bool
    monitor: Monitor
    analyze: Analyze
    plan: Plan
    knowledge: Knowledge

    def make(self, logged: Record) -> Record | None:
        """Return what stands here in the place of a record of the log; None where nothing could be made."""
        ...

    def settle(self) -> None:
        """Put in force what was planned, as at the end of a run."""
        ...

    def log_sha256(self) -> str | None:
        """Return the hash of what was made; None where there is none to compare."""
        ...

    def q_table(self) -> QTable | None:
        """Return the Q-table, or None where no episode was driven again."""
        ...


class WholeLoop:
    """A loop in lockstep, run again.

    Parameters
    ----------
    config
        What ran, with the swaps of this loop.
    system
        A fresh managed system.
    unit
        Number of the loop in the records.
    """

    from_observations = False

    def __init__(self, config: Config, system: ManagedSystem, unit: int) -> None:
        self.failure: Exception | None = None
        trial, loop = divmod(unit, config.loops)
        self._loop = Loop(config, system, trial, loop)
        self.monitor, self.analyze, self.plan = self._loop.monitor, self._loop.analyze, self._loop.plan
        self.knowledge = self._loop.knowledge

    def make(self, logged: Record) -> Record | None:
        """Return what stands here in the place of a record of the log; None where nothing could be made."""
        log = self._loop.log
        # A record is in the log before the next part is asked for its own: what that part raises comes after.
        while (made := log.find(type(logged), logged.pass_no)) is None and self.failure is None:
            try:
                self._loop.advance()
            except MapekError as error:
                self.failure = error
        return made

    def settle(self) -> None:
        """Put in force what was planned, as at the end of a run."""
        if self.failure is None:
            self._loop.bus.run()

    def log_sha256(self) -> str | None:
        """Return the hash of what was made."""
        return self._loop.log.sha256()

    def q_table(self) -> QTable | None:
        """Return the Q-table."""
        return self._loop.execute.q_table


class FedByLog:
    """Monitor, Analyze and Plan, fed with the Observations of a log; and Execute too where its episodes can be found.

    Parameters
    ----------
    config
        What ran, with the swaps of this loop.
    store
        The log, which may hold Q-tables that a planner read.
    layout
        Of the log's rows.
    unit
        Number of the loop in the records.
    system
        A fresh managed system, of a free-running loop that dropped nothing: each episode is driven again under the
        plan that its Observation names. None, and the Observations are taken as they are.
    """

    def __init__(
        self, config: Config, store: Store, layout: RowLayout, unit: int, system: ManagedSystem | None = None
    ) -> None:
        self.failure: Exception | None = None
        self.from_observations = system is None
        self._config = config
        self._free = config.execute.mode == "free"
        self._log = Log(layout, unit)
        self._made: dict[type[Record], Record] = {}
        self._number = 0
        self._plans: deque[ChangePlan] = deque()  # those that Execute has still to put in force
        self._swaps = deque(config.swap)
        self.knowledge = Knowledge(self._log)
        self.monitor = build_monitor(config, self._keep)
        self.analyze = build_analyze(config, self._keep)
        self.plan = build_plan(config, self.knowledge, self._keep)
        self._execute: Execute | None = None
        if system is not None:
            trial, loop = divmod(unit, config.loops)
            self._execute = build_execute(config, system, self.knowledge, self._keep, trial, loop)

        def read() -> QTable:
            table = store.version(unit, self._number)
            if table is None:
                raise LookupError(f"the log holds no Q-table of the end of episode {self._number}")
            return table

        self.knowledge.serve_q_table(read)

    def make(self, logged: Record) -> Record | None:
        """Return what stands here in the place of a record of the log; None where nothing could be made."""
        if self.failure is None:
            try:
                if isinstance(logged, Observation):
                    self._pass(logged)
                elif logged.pass_no == 0:
                    self.plan.start(self._log.loop)
            except (MapekError, ValueError) as error:  # an Observation that was tampered with may fit no row
                self.failure = error
        return self._made.get(type(logged))

    def _pass(self, logged: Observation) -> None:
        self._made.clear()
        self._number = logged.pass_no
        self._swap()
        if self._execute is None:
            self._keep(logged)
        else:
            self._drive(self._execute, logged.plan)
        self.knowledge.actions = logged.known
        made: Any = self._made
        self.monitor.on_observation(made[Observation])
        self.analyze.on_symptom(made[Symptom])
        self.plan.on_request(made[ChangeRequest])

    def _keep(self, record: Record) -> None:
        self._made[type(record)] = record
        if isinstance(record, ChangePlan) and self._execute is not None:
            self._plans.append(record)
        if not self._free:
            self._log.append(record)
        elif isinstance(record, ChangePlan) and record.pass_no:
            # What was dropped would be a gap to the log; its window is all that a planner reads.
            self._log.window.append(Pass(*(self._made[kind] for kind in STAGES)))  # type: ignore[arg-type]
            self._log.passes = record.pass_no

    def _swap(self) -> None:
        while self._swaps and self._swaps[0].pass_no <= self._number:
            swap = self._swaps.popleft()
            held: dict[str, Component | None] = {
                "monitor": self.monitor,
                "analyze": self.analyze,
                "plan": self.plan,
                "execute": self._execute,
            }
            component = held[owner(swap.part)]
            if component is not None:
                replace_part(component, swap.part, swap.to, self._config, signals=self._log.layout.signals)

    def _drive(self, execute: Execute, under: int) -> None:
        while self._plans and self._plans[0].pass_no <= under:
            execute.adopt(fitting(self._plans.popleft(), self.knowledge.actions))
        execute.drive()

    def settle(self) -> None:
        """Put in force what was planned, as at the end of a run."""
        while self._execute is not None and self._plans and self.failure is None:
            self._execute.adopt(fitting(self._plans.popleft(), self.knowledge.actions))

    def log_sha256(self) -> str | None:
        """Return the hash of what was made; None where the loop ran freely."""
        return None if self._free else self._log.sha256()

    def q_table(self) -> QTable | None:
        """Return the Q-table, or None where no episode was driven again."""
        return None if self._execute is None else self._execute.q_table


def with_swaps(config: Config, swaps: list[Swap], unit: int) -> Config:
    """Return the config of one loop with the parts that were replaced while it ran, beside those it had planned.

    Raises
    ------
    ConfigError
        One of them is of a module that is not imported because a log names it.
    """
    live = [
        SwapConfig.model_validate({"pass": swap.pass_no, "part": swap.part, "to": PartSpec.model_validate(swap.spec)})
        for swap in swaps
        if swap.loop == unit and not swap.planned
    ]
    for swap in live:
        check_part(config, swap.part, swap.to)
    # A part may have been replaced twice at one pass, the second time live, which no config could plan.
    return config.model_copy(update={"swap": tuple(sorted([*config.swap, *live], key=lambda swap: swap.pass_no))})
