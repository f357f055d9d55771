"""Knowledge as a component in a process of its own sees it: what is not here is asked for."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator
from typing import cast

from adapters.buses.member import Member
from adapters.buses.questions import Refused
from adapters.roles import STAGE_OF
from knowledge import STAGES, ChangePlan, Knowledge, Log, Observation, Pass, QTable, Record, RowLayout
from knowledge.log import WINDOW
from mape.errors import PartError


class RemoteLog:
    """The log of one loop as it is in Knowledge: of it, what a `Log` would show within a process.

    That is the newest finished passes, and of the pass that the component is at work on what the stages before it have
    made; nothing of what came to be later, before a restart say.

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
        self._window: deque[Pass] = deque(maxlen=WINDOW)
        self._seen = 0  # finished passes as of which the window was read
        self._open: tuple[int, tuple[Record, ...]] = (-1, ())  # the same, and the open records then

    @property
    def window(self) -> deque[Pass]:
        """The newest finished passes, oldest first; without those that a free-running loop had to drop."""
        if self._seen != self.passes:
            first = max(self._seen, self.passes - WINDOW) + 1
            found = self._finished(first, self.passes)
            if first == self._seen + 1:
                self._window.extend(found)
            else:
                while len(found) < WINDOW and first > 1:  # some were dropped: as many more are further back
                    first, last = max(1, first - WINDOW), first - 1
                    found = [*self._finished(first, last), *found]
                self._window = deque(found, WINDOW)
            self._seen = self.passes
        return self._window

    @property
    def open_records(self) -> tuple[Record, ...]:
        """The records of the pass that is being worked on, those of the stages before this one, in order."""
        if self._open[0] != self.passes:
            number, before = self.passes + 1, STAGE_OF[self._member.role]
            found = self._member.history(self.loop, dict.fromkeys(range(before), number)) if before else []
            self._open = self.passes, tuple(record for record in found if record.pass_no == number)
        return self._open[1]

    def find(self, kind: type[Record], number: int) -> Record | None:
        """Return the record of that kind and pass, or None where it has not come yet or has left the window."""
        if number == 0:
            return self._start() if kind is ChangePlan else None
        if number > self.passes:
            return next((record for record in self.open_records if (type(record), record[1]) == (kind, number)), None)
        stage = STAGES.index(kind)
        return next((passed[stage] for passed in self.window if passed.plan.pass_no == number), None)

    def since(self, number: int, stage: int = 0) -> Iterator[Record]:
        """Yield what is readable from record (`number`, `stage`) on, in order.

        Raises
        ------
        LookupError
            That record has left the window.
        """
        if number == 0:
            yield self._start()
            number, stage = 1, 0
        oldest = self.window[0].plan.pass_no if len(self.window) == WINDOW else 1
        if number < oldest:
            raise LookupError(f"pass {number} has left the window; the oldest pass in memory is {oldest}")
        for record in [*(record for passed in self.window for record in passed), *self.open_records]:
            if (record.pass_no, STAGES.index(type(record))) >= (number, stage):
                yield record

    def _start(self) -> ChangePlan:
        (plan,) = self._member.history(self.loop, {STAGES.index(ChangePlan): 0})[:1]
        assert isinstance(plan, ChangePlan)
        return plan

    def _finished(self, first: int, last: int) -> list[Pass]:
        """Return the passes from `first` to `last`."""
        passes: dict[int, list[Record]] = {}
        for record in self._all(first):
            if record.pass_no > last:
                break
            passes.setdefault(record.pass_no, []).append(record)
        return [Pass(*four) for four in passes.values() if len(four) == len(STAGES)]  # type: ignore[arg-type]

    def _all(self, number: int) -> Iterator[Record]:
        """Yield all that Knowledge has from pass `number` on, in order."""
        stage = 0
        while found := self._member.history(self.loop, {s: number + (s < stage) for s in range(len(STAGES))}):
            yield from found
            number, stage = found[-1].pass_no, STAGES.index(type(found[-1])) + 1


class RemoteKnowledge(Knowledge):
    """`Knowledge` whose log and Q-tables are in other processes.

    Knowledge itself throws no Q-table away. Which of them a planner can recall is kept here, by the rule that holds
    within a process, and stands in Plan's state.

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
        self._actions: tuple[int, ...] | None = None
        self._brought: QTable | None = None
        self._number = 0  # the pass that is being worked on, and what was remembered before
        self._remembered_before: OrderedDict[str, QTable] = OrderedDict()

    def at(self, number: int) -> None:
        """Show Knowledge as it is when the records of pass `number` are made; the second time as the first."""
        cast(RemoteLog, self.log).passes = number - 1
        self._actions = None
        if number == self._number:
            self._remembered = self._remembered_before.copy()
        else:
            self._number, self._remembered_before = number, self._remembered.copy()

    @property
    def actions(self) -> tuple[int, ...]:
        """Ids with a row in the Q-table, as of the pass that is being worked on."""
        if self._actions is None:
            seen = self.log.find(Observation, self.log.passes + 1)
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
        """Keep a copy of `table`, here and at Knowledge, and return its hash, by which a plan can adopt it."""
        self._member.remember(table)
        return super().remember(table)

    def recall(self, key: str) -> QTable:
        """Return a copy of the remembered table with that hash.

        Raises
        ------
        LookupError
            It was never remembered, or others have taken its place.
        """
        if self._member.role == "plan":
            return super().recall(key)
        brought, self._brought = self._brought, None
        if brought is not None and brought.sha256() == key:
            return brought
        return self._fetched(key)  # named by a plan, when Plan could recall it

    def bring(self, table: QTable) -> None:
        """Have a table here that is about to be recalled, so that it need not be asked for then."""
        self._brought = table

    def adopted(self, plan: ChangePlan) -> None:
        """Take note that a plan adopts a remembered table: Execute recalls it then, which is a use of it as any other.

        Raises
        ------
        PartError
            It is not remembered.
        """
        if plan.adopt is not None:
            try:
                self.recall(plan.adopt)
            except LookupError as error:
                raise PartError(f"plan {plan.pass_no} cannot be executed: {error}") from error

    @property
    def remembered(self) -> list[str]:
        """Hashes of the tables that can be recalled; the one unused for longest comes first."""
        return list(self._remembered)

    def restore(self, remembered: Iterable[str]) -> None:
        """Remember the tables with these hashes."""
        self._remembered = OrderedDict((key, self._fetched(key)) for key in remembered)

    def _fetched(self, key: str) -> QTable:
        try:
            return self._member.table(f"sha256={key}")
        except Refused as refused:
            raise LookupError(str(refused)) from None
