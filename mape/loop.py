"""The loop: one pass, written once.

             Knowledge (log, plan in force, known actions, Q by request)
                |           |             |           |
Observation -> Monitor -> Symptom -> Analyze -> ChangeRequest -> Plan -> ChangePlan -> Execute
     ^                                                                                   |
     +--------------------------- managed system <---------------------------------------+
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from knowledge import STAGES, ChangePlan, ChangeRequest, Knowledge, Log, Observation, QTable, Record, RowLayout, Symptom
from mape.analyze import Analyze
from mape.bus import LocalBus
from mape.config import Config, SwapConfig
from mape.ctrl_c import CtrlC
from mape.errors import ConfigError
from mape.execute import Execute
from mape.execute.component import SIGNALS
from mape.monitor import Monitor
from mape.near import did_you_mean, nearest
from mape.parts import make, owner
from mape.plan import Plan
from mape.ports import Json, ManagedSystem
from mape.stretch.stretches import Stretches, obstacles
from mape.swap import Component, replace_part

Send = Callable[[Any], object]


def layout_of(config: Config, system: ManagedSystem) -> RowLayout:
    """Return the layout of the rows that a run of `config` on `system` logs.

    Raises
    ------
    ConfigError
        A detector watches a signal that the run does not have.
    """
    signals = SIGNALS + system.signal_names
    for detector in config.monitor.detectors:
        if detector.signal not in signals:
            near = did_you_mean(nearest(detector.signal, signals))
            raise ConfigError(
                f"detector {detector.name!r} watches signal {detector.signal!r}; {system.name} has "
                f"{', '.join(signals)}{near}"
            )
    learner = make("learner", config.learner)
    return _layout(signals, len(config.monitor.detectors), len(learner.rate_names), config.system.max_actions)


_layout = functools.lru_cache(maxsize=16)(RowLayout)


def build_monitor(config: Config, send: Send) -> Monitor:
    """Make the Monitor that a config describes."""
    return Monitor([(spec.signal, make("detector", spec)) for spec in config.monitor.detectors], send)


def build_analyze(config: Config, send: Send) -> Analyze:
    """Make the Analyze that a config describes."""
    return Analyze(make("analyzer", config.analyze), send)


def build_plan(config: Config, knowledge: Knowledge, send: Send) -> Plan:
    """Make the Plan that a config describes."""
    return Plan(make("planner", config.plan), knowledge, send)


def build_execute(
    config: Config,
    system: ManagedSystem,
    knowledge: Knowledge,
    send: Send,
    trial: int = 0,
    loop: int = 0,
    checkpoint: tuple[Json, QTable] | None = None,
) -> Execute:
    """Make the Execute that a config describes, over a fresh system; from a checkpoint on, if there is one."""
    return Execute(
        system,
        make("learner", config.learner),
        knowledge,
        send,
        seed=config.seed,
        trial=trial,
        loop=loop,
        engine=config.execute.engine,
        mask_greedy=config.execute.mask_greedy,
        max_actions=config.system.max_actions,
        retries=config.system.retries,
        checkpoint=checkpoint,
    )


class Loop:
    """The four components over one Knowledge, in one process.

    Parameters
    ----------
    config
        What runs.
    system
        The managed system, fresh.
    trial, loop
        Which stream of randomness is used; the number of this unit of work (`Config.unit`) stands in the records.
    checkpoint
        Execute's, after some episodes; `go_on` then makes the passes up to there again.
    keep
        Called with each record before any component is.

    Raises
    ------
    ConfigError
        The config is of a free-running system, or a part cannot be made.

    Examples
    --------
    >>> from mape.config import load
    >>> from adapters.systems import make_system
    >>> config = load("gridworld_goals")
    >>> loop = Loop(config, make_system(config.system))
    >>> loop.run(3)
    >>> loop.log.window[-1].plan.pass_no
    3
    """

    def __init__(
        self,
        config: Config,
        system: ManagedSystem,
        trial: int = 0,
        loop: int = 0,
        *,
        checkpoint: tuple[Json, QTable] | None = None,
        keep: Callable[[Record], object] | None = None,
    ) -> None:
        if config.execute.mode == "free":
            raise ConfigError(
                "free-running needs processes: mapek up. In one process each episode waits for its plan "
                "(execute.mode = 'lockstep')."
            )
        self.config = config
        self.system = system
        self.log = Log(layout_of(config, system), config.unit(trial, loop))
        self.knowledge = Knowledge(self.log)
        self.bus = LocalBus(self.log)
        send = self.bus.send
        self.monitor = build_monitor(config, send)
        self.analyze = build_analyze(config, send)
        self.plan = build_plan(config, self.knowledge, send)
        self.execute = build_execute(config, system, self.knowledge, send, trial, loop, checkpoint)
        if keep is not None:
            for kind in STAGES:
                self.bus.subscribe(kind, keep)
        self.bus.subscribe(Observation, self.monitor.on_observation)
        self.bus.subscribe(Symptom, self.analyze.on_symptom)
        self.bus.subscribe(ChangeRequest, self.plan.on_request)
        if checkpoint is None:
            self.bus.subscribe(ChangePlan, self.execute.adopt)
        self._own_subscriptions = len(STAGES)  # of the components; who keeps records wants to hear of each
        self._stretches: Stretches | None = None
        self._swaps = deque(config.swap)  # those that are still to be made
        self._told: list[Callable[[SwapConfig, bool], object]] = []

    def go_on(self, past: Iterable[Observation], read: Callable[[int], QTable]) -> None:
        """Make the passes of these Observations again, without their episodes, and be where they end.

        Execute, made of the checkpoint of the last of them, gets the plan that answers it.

        Parameters
        ----------
        past
            From that of pass 1 on, in order.
        read
            Gives the Q-table at the end of an episode, where a planner had asked for it.
        """
        number = 0
        self.knowledge.serve_q_table(lambda: read(number))
        self.plan.start(self.log.loop)
        for seen in past:
            self.bus.run()
            number = seen.pass_no
            self._swap_before(number)
            self.knowledge.actions = seen.known
            self.bus.send(seen)
        self.bus.subscribe(ChangePlan, self.execute.adopt)
        self.bus.run()
        self.knowledge.serve_q_table(lambda: self.execute.q_table.copy())

    def on_swap(self, listener: Callable[[SwapConfig, bool], object]) -> None:
        """Tell `listener` of each swap that is made, and whether the new part took over the old one's state."""
        self._told.append(listener)

    def swap(self) -> None:
        """Make the next swap of the config, between two passes; `run` and `advance` do so when its pass has come.

        Raises
        ------
        ConfigError, PartError
            The new part cannot be let in. The old one goes on, and the swap is still to be made.
        """
        swap = self._swaps[0]
        component: Component = getattr(self, owner(swap.part))
        handed_over = replace_part(component, swap.part, swap.to, self.config, signals=self.log.layout.signals)
        self._swaps.popleft()
        for tell in self._told:
            tell(swap, handed_over)

    def advance(self) -> Record:
        """Move by one record, and return it: the next that waits, or the Observation of a new episode.

        Raises
        ------
        PartError, ManagedSystemError
            What a part or the system raised.
        KeyboardInterrupt
            After a Ctrl-C, when the record is there; after a second one at once.
        """
        with CtrlC(self._at_work):
            record = self.bus.deliver()
            if record is None:
                if self.execute.plan is None:
                    self.plan.start(self.log.loop)
                else:
                    self._swap_before(self.execute.passes + 1)
                    self.execute.drive()
                record = self.bus.deliver()
        assert record is not None
        return record

    def run(self, passes: int) -> None:
        """Run that many passes, each to its end.

        Raises
        ------
        PartError, ManagedSystemError
            What a part or the system raised; the passes before it are logged.
        KeyboardInterrupt
            After a Ctrl-C, between two passes, so that another `run` goes on; after a second one at once.
        """
        execute, drive, settle = self.execute, self.execute.drive, self.bus.run
        with CtrlC(self._at_work) as ctrl_c:
            if execute.plan is None and self.knowledge.plan is None:
                self.plan.start(self.log.loop)
            settle()
            last = execute.passes + passes
            while execute.passes < last:
                self._swap_before(execute.passes + 1)
                until = min(last, self._swaps[0].pass_no - 1) if self._swaps else last
                stretches = self.stretches()
                while execute.passes < until:
                    if stretches is None or not stretches.run(until, ctrl_c.check):
                        ctrl_c.check()
                        drive()
                    settle()

    def stretches(self) -> Stretches | None:
        """Compile the quiet passes of this loop, and return them; None where something keeps it from that.

        Raises
        ------
        ConfigError
            A rule cannot be compiled; or the engine is 'compiled', and a part declares no rule.
        """
        if self.obstacles():
            return None
        if self._stretches is None or not self._stretches.fit:
            self._stretches = Stretches(self.execute, self.monitor, self.analyze, self.plan, self.knowledge)
        return self._stretches

    def obstacles(self) -> list[str]:
        """Return what keeps the quiet passes of this loop from being compiled, a clause for each."""
        if self.config.execute.engine == "python":
            return ["the engine is python"]
        found = obstacles(self.execute, self.monitor, self.analyze, self.plan)
        if found and self.config.execute.engine == "compiled":
            raise ConfigError(
                f"engine 'compiled' needs rules that can be compiled, and {'; '.join(found)}. Choose 'auto', which "
                "compiles what it can, or 'python'."
            )
        if self.bus.subscriptions > self._own_subscriptions:
            found.append("somebody listens to each record")
        return found

    def close(self) -> None:
        """Let the components go, which hold one another: what a loop takes is then free at once."""
        self.bus.close()
        self.knowledge.serve_q_table(None)

    def _at_work(self) -> str:
        number, steps = self.execute.driving, self.execute.steps
        if not number:
            return f"the parts of the loop, after episode {self.execute.passes}"
        return f"{self.system.name}, in {f'step {steps + 1}' if steps >= 0 else 'the reset'} of episode {number}"

    def _swap_before(self, number: int) -> None:
        while self._swaps and self._swaps[0].pass_no <= number:
            self.swap()
