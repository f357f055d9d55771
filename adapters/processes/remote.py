"""Knowledge as a component in a process of its own sees it: what is not here is asked for."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import cast

from adapters.buses.member import Member
from adapters.buses.questions import Refused
from knowledge import STAGES, Knowledge, Log, Observation, Pass, QTable, Record, RowLayout

WINDOW = 256
"""Finished passes that can be read, as within a process."""


class RemoteLog:
    """The finished passes of one loop, as they are in Knowledge: those that a `Log` would show within a process.

    Parameters
    ----------
    member
        The link to Knowledge.
    layout, loop
        Of the loop's log.

    Attributes
    ----------
    passes : finished passes, as of the record that the component is at work on.
    """

    def __init__(self, member: Member, layout: RowLayout, loop: int) -> None:
        self.layout = layout
        self.loop = loop
        self.passes = 0
        self._member = member
        self._window: tuple[int, deque[Pass]] = (0, deque())

    @property
    def window(self) -> deque[Pass]:
        """The newest finished passes, oldest first; without those that a free-running loop had to drop."""
        if self._window[0] != self.passes:
            first = max(1, self.passes - WINDOW + 1)
            known = [finished for finished in self._window[1] if finished.plan.pass_no >= first]
            passes: dict[int, list[Record]] = {}
            for record in self.since(known[-1].plan.pass_no + 1 if known else first):
                if record.pass_no > self.passes:
                    break
                passes.setdefault(record.pass_no, []).append(record)
            known += [Pass(*four) for four in passes.values() if len(four) == len(STAGES)]  # type: ignore[arg-type]
            self._window = (self.passes, deque(known))
        return self._window[1]

    def find(self, kind: type[Record], number: int) -> Record | None:
        """Return the record of that kind and pass, or None where it has not come yet."""
        stage = STAGES.index(kind)
        found = self._member.history(self.loop, {stage: number})
        return found[0] if found and found[0].pass_no == number else None

    def since(self, number: int, stage: int = 0) -> Iterator[Record]:
        """Yield what the log holds from record (`number`, `stage`) on, in order."""
        while True:
            found = self._member.history(self.loop, {s: number + (s < stage) for s in range(4)})
            yield from found
            if not found:
                return
            number, stage = found[-1].pass_no, STAGES.index(type(found[-1])) + 1


class RemoteKnowledge(Knowledge):
    """`Knowledge` whose log and Q-tables are in other processes.

    Parameters
    ----------
    member
        The link to Knowledge.
    layout, loop
        Of the loop's log.
    """

    def __init__(self, member: Member, layout: RowLayout, loop: int) -> None:
        # What a RemoteLog lacks of a Log, to append and to hash, is Knowledge's own affair.
        super().__init__(cast(Log, RemoteLog(member, layout, loop)))
        self._member = member
        self._known: dict[str, QTable] = {}
        self._actions: tuple[int, ...] | None = None

    def at(self, number: int) -> None:
        """Show Knowledge as it is while the records of pass `number` are made."""
        cast(RemoteLog, self.log).passes = number - 1
        self._actions = None

    @property
    def actions(self) -> tuple[int, ...]:
        """Ids with a row in the Q-table, as of the pass that is being worked on."""
        if self._actions is None:
            number = self.log.passes + 1
            seen = self.log.find(Observation, number) if number > 0 else None
            self._actions = seen.known if isinstance(seen, Observation) else ()
        return self._actions

    @actions.setter
    def actions(self, actions: tuple[int, ...]) -> None:
        self._actions = actions

    def q_table(self) -> QTable:
        """Return a copy of the Q-table at the end of the pass's episode."""
        if self._read_q is not None:
            return super().q_table()
        return self._member.table(f"loop={self.log.loop};pass={self.log.passes + 1}")

    def remember(self, table: QTable) -> str:
        """Keep a copy of `table` at Knowledge and return its hash, by which a plan can adopt it."""
        return self._member.remember(table)

    def recall(self, key: str) -> QTable:
        """Return a copy of the remembered table with that hash.

        Raises
        ------
        LookupError
            It was never remembered.
        """
        if key not in self._known:
            try:
                self._known[key] = self._member.table(f"sha256={key}")
            except Refused as refused:
                raise LookupError(str(refused)) from None
        return self._known[key].copy()
