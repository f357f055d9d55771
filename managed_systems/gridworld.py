"""`mapek/Gridworld-v0`: find the goal; the goal moves, and actions come and go.

Source: arXiv 2601.20714, section on the 9x9 Gridworld, and what its published code adds (the cap of 37 steps).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from gymnasium.spaces import Discrete

from managed_systems import checks, drawing
from managed_systems.environment import RulesEnvironment
from managed_systems.rules import ALWAYS, FloatArray, IntArray, Rules, phase

Cell = tuple[int, int]

ACTION_NAMES = ("up", "down", "left", "right", "jump up", "jump down", "jump left", "jump right")
DIRECTIONS = ((-1, 0), (1, 0), (0, -1), (0, 1))


class GridworldParams(NamedTuple):
    """What the rules of a gridworld need.

    Attributes
    ----------
    moves : int64 array, shape (actions, states): the state to which an action leads.
    goals : int64 array, shape (switches + 1,): state of the active goal in each phase.
    switch_at : int64 array, shape (switches,): episodes from which the next phase holds.
    start : state in which an episode starts.
    step_reward, goal_reward : reward of a move, and of the move that enters the active goal.
    slip : probability that one of the four moves, drawn uniformly, replaces the chosen action.
    """

    moves: IntArray
    goals: IntArray
    switch_at: IntArray
    start: int
    step_reward: float
    goal_reward: float
    slip: float


def reset(params: GridworldParams, phase: int, draws: FloatArray, at: int) -> int:
    """Return the start. Uses no draw."""
    return params.start


def step(
    params: GridworldParams, phase: int, state: int, action: int, draws: FloatArray, at: int, context: FloatArray
) -> tuple[int, float, bool]:
    """Move, and end the episode on the active goal. Uses two draws where the floor is slippery, else none.

    A slip may go in a direction whose action has been taken away: it is the floor that moves the agent.
    """
    if params.slip > 0.0 and draws[at] < params.slip:
        action = int(draws[at + 1] * 4.0)
    landed = int(params.moves[action, state])
    if landed == int(params.goals[phase]):
        return landed, params.goal_reward, True
    return landed, params.step_reward, False


def explorable(params: GridworldParams, phase: int, state: int, action: int) -> bool:
    """Whether the action changes the state."""
    return int(params.moves[action, state]) != state


class Gridworld(RulesEnvironment[int]):
    """A grid with walls, one active goal, and four moves: up, down, left, right (actions 0 to 3).

    Entering the active goal gives `goal_reward` and ends the episode; every other move, also one onto an inactive
    goal or against a wall or border, which stays put, gives `step_reward`. An observation is the state,
    ``row * columns + column``.

    The parameters are kept, as tuples and plain numbers, under their own names.

    Parameters
    ----------
    size
        Rows and columns.
    start
        Cell in which each episode starts, as (row, column) from 0.
    goals
        Cells of the goals, in the order in which they take turns.
    switch_at
        Episodes (1-based, at least 2, strictly increasing) from which the next goal in turn is the active one.
    walls
        Cells that cannot be entered.
    max_steps
        Steps after which an episode is truncated.
    step_reward, goal_reward
        Rewards.
    slip
        Probability, in [0, 1), that the chosen action is replaced by one of the four moves drawn uniformly.
    jump_from
        Episode from which four jumps (actions 4 to 7: two cells up, down, left, right) are available. A jump passes
        over walls; one that would end on a wall or outside stays put. None: there are just four actions.
    remove
        Action id -> first episode in which it is not available any more. Ids may be text, as TOML's keys are.
    render_mode
        ``"ansi"``, ``"rgb_array"`` or None.

    Raises
    ------
    ValueError
        A value is not legal, or a goal cannot be reached from the start even with all the actions.

    Examples
    --------
    >>> env = Gridworld(size=(3, 3), start=(0, 0), goals=[(0, 2)], render_mode="ansi")
    >>> state, info = env.reset(seed=1)
    >>> state, info["available_actions"], info["action_mask"].tolist()
    (0, (0, 1, 2, 3), [0, 1, 0, 1])
    >>> print(env.render())
    A . G
    . . .
    . . .
    >>> env.step(3)[:3], env.step(3)[:3]
    ((1, -1.0, False), (2, 100.0, True))
    """

    def __init__(
        self,
        size: Sequence[int] = (9, 9),
        start: Sequence[int] = (4, 4),
        goals: Sequence[Sequence[int]] = ((0, 0), (8, 8)),
        switch_at: Sequence[int] = (),
        walls: Sequence[Sequence[int]] = (),
        max_steps: int = 37,
        step_reward: float = -1.0,
        goal_reward: float = 100.0,
        slip: float = 0.0,
        jump_from: int | None = None,
        remove: Mapping[int | str, int] | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.size = checks.integer_pair("size", size, 1)
        self.start = self._cell("start", start)
        self.goals = self._cells("goals", goals)
        self.switch_at = checks.episodes("switch_at", switch_at)
        self.walls = self._cells("walls", walls)
        self.max_steps = checks.whole("max_steps", max_steps, 1)
        self.step_reward = checks.real("step_reward", step_reward)
        self.goal_reward = checks.real("goal_reward", goal_reward)
        self.slip = checks.real("slip", slip, 0.0, 1.0)
        if self.slip == 1.0:
            raise ValueError("slip is 1.0, which leaves no choice; give a number of at least 0 and below 1")
        self.jump_from = None if jump_from is None else checks.whole("jump_from", jump_from, 1)
        self._check_layout()
        first = [1] * 4 if self.jump_from is None else [1] * 4 + [self.jump_from] * 4
        windows = np.array([(episode, ALWAYS) for episode in first], np.int64)
        self.remove = self._removals({} if remove is None else remove, windows)
        moves = self._moves(len(windows))
        self._check_reach(moves)
        rules = Rules(
            params=GridworldParams(
                moves=moves,
                goals=np.array([self._index(self._goal(phase)) for phase in range(len(self.switch_at) + 1)], np.int64),
                switch_at=np.array(self.switch_at, np.int64),
                start=self._index(self.start),
                step_reward=self.step_reward,
                goal_reward=self.goal_reward,
                slip=self.slip,
            ),
            phase=phase,
            reset=reset,
            step=step,
            explorable=explorable,
            n_states=self.size[0] * self.size[1],
            n_actions=len(windows),
            max_steps=self.max_steps,
            reset_draws=0,
            step_draws=2 if self.slip > 0.0 else 0,
            signal_names=(),
            windows=windows,
            drifts=self.switch_at,
        )
        super().__init__(rules, Discrete(rules.n_states), render_mode)

    def _cell(self, name: str, value: object) -> Cell:
        row, column = checks.integer_pair(name, value, 0)
        if row >= self.size[0] or column >= self.size[1]:
            raise ValueError(
                f"{name} is {(row, column)}, outside the grid; give a row in 0..{self.size[0] - 1} and a column in "
                f"0..{self.size[1] - 1}, or a larger size than {self.size}"
            )
        return row, column

    def _cells(self, name: str, values: object) -> tuple[Cell, ...]:
        found = checks.items(name, values, "a sequence of cells, such as [[0, 0], [8, 8]]")
        cells = tuple(self._cell(f"{name}[{i}]", cell) for i, cell in enumerate(found))
        for i, cell in enumerate(cells):
            if cell in cells[:i]:
                raise ValueError(f"{name}[{i}] is {cell}, which {name} holds already; give each cell once")
        return cells

    def _check_layout(self) -> None:
        if not self.goals:
            raise ValueError("goals is (); give at least one cell, such as [[0, 0]]")
        if self.switch_at and len(self.goals) == 1:
            raise ValueError(
                f"switch_at is {self.switch_at}, but goals holds only {self.goals[0]}, so nothing would change; give a "
                "second goal, or no switch"
            )
        if self.start in self.walls:
            raise ValueError(f"start {self.start} is a wall; take it out of walls, or give another start")
        for goal in self.goals:
            if goal in self.walls:
                raise ValueError(f"goal {goal} is a wall; take it out of walls, or give another goal")
            if goal == self.start:
                raise ValueError(f"goal {goal} is the start, where no move can enter it; give another goal or start")

    def _removals(self, remove: object, windows: IntArray) -> dict[int, int]:
        """Check `remove`, and close in `windows` what it takes away."""
        if not isinstance(remove, Mapping):
            raise ValueError(f"remove is {remove!r}; give a mapping of action id -> episode, such as {{3: 301}}")
        found: dict[int, int] = {}
        for key, episode in remove.items():
            action = int(key) if isinstance(key, str) and key.isdecimal() else key
            if action not in range(len(windows)):
                ids = ", ".join(f"{i} ({ACTION_NAMES[i]})" for i in range(len(windows)))
                hint = "; jumps need jump_from" if self.jump_from is None else ""
                raise ValueError(f"remove names action {key!r}; the actions are {ids}{hint}")
            if int(action) in found:
                raise ValueError(f"remove names action {action} twice, as a number and as text; give it once")
            # An action taken away before it was there would be one that never is: better left out.
            found[int(action)] = checks.whole(f"remove[{key!r}]", episode, int(windows[action, 0]) + 1)
        for action, episode in found.items():
            windows[action, 1] = episode - 1
        for episode in found.values():
            if not np.any((windows[:, 0] <= episode) & (episode <= windows[:, 1])):
                raise ValueError(f"remove is {found}, which leaves no action in episode {episode}; keep at least one")
        return found

    def _index(self, cell: Cell) -> int:
        return cell[0] * self.size[1] + cell[1]

    def _moves(self, n_actions: int) -> IntArray:
        """Tabulate where each action leads, shape (actions, states)."""
        rows, columns = self.size
        walls = set(self.walls)
        moves = np.empty((n_actions, rows * columns), np.int64, order="F")  # an episode looks at all of one state
        for action in range(n_actions):
            down, right = DIRECTIONS[action % 4]
            length = 1 + action // 4
            for cell in np.ndindex(rows, columns):
                target = (cell[0] + length * down, cell[1] + length * right)
                blocked = not (0 <= target[0] < rows and 0 <= target[1] < columns) or target in walls
                moves[action, self._index((cell[0], cell[1]))] = self._index((cell[0], cell[1]) if blocked else target)
        return moves

    def _check_reach(self, moves: IntArray) -> None:
        seen = {self._index(self.start)}
        queue = deque(seen)
        while queue:
            for landed in moves[:, queue.popleft()].tolist():
                if landed not in seen:
                    seen.add(landed)
                    queue.append(landed)
        for goal in self.goals:
            if self._index(goal) not in seen:
                raise ValueError(
                    f"goal {goal} cannot be reached from start {self.start} with the actions "
                    f"{', '.join(ACTION_NAMES[: len(moves)])}; open the walls around it"
                    + (", or give jump_from: jumps pass over walls" if self.jump_from is None else "")
                )

    def _observe(self, state: int) -> int:
        return state

    def _goal(self, phase: int) -> Cell:
        return self.goals[phase % len(self.goals)]

    def _active_goal(self) -> Cell:
        return self._goal(self._phase)

    def _as_text(self) -> str:
        """Draw one letter a cell: A agent, G active goal, g other goals, # wall."""
        rows, columns = self.size
        letters = dict.fromkeys(self.walls, "#") | dict.fromkeys(self.goals, "g")
        letters |= {self._active_goal(): "G", (self._state // columns, self._state % columns): "A"}
        return "\n".join(" ".join(letters.get((row, column), ".") for column in range(columns)) for row in range(rows))

    def _as_image(self) -> drawing.Image:
        """Draw the agent as a blue disc, the active goal in green, other goals as grey rings, walls in slate."""
        rows, columns = self.size
        cell, gap, margin = 40, 2, 12
        image = drawing.blank(rows * cell + 2 * margin - gap, columns * cell + 2 * margin - gap)
        for row, column in np.ndindex(rows, columns):
            top, left, side = margin + row * cell, margin + column * cell, cell - gap
            middle = (top + side // 2, left + side // 2)
            place = (row, column)
            if place in self.walls:
                colour = drawing.SLATE
            elif place == self._active_goal():
                colour = drawing.PALE_GREEN
            else:
                colour = drawing.FIELD
            drawing.box(image, top, left, side, side, drawing.LINE, radius=6)
            drawing.box(image, top + 1, left + 1, side - 2, side - 2, colour, radius=5)
            if place in self.goals:
                shade = drawing.GREEN if place == self._active_goal() else drawing.GREY
                drawing.disc(image, *middle, 30, shade)
                drawing.disc(image, *middle, 22, colour)
                if place == self._active_goal():
                    drawing.disc(image, *middle, 12, shade)
            if self._index(place) == self._state:
                drawing.disc(image, *middle, 26, drawing.FIELD)
                drawing.disc(image, *middle, 22, drawing.BLUE)
        return image
