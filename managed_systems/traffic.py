"""`mapek/TrafficJunction-v0`: a two-lane intersection whose traffic changes, with services held in reserve.

Source: arXiv 2601.20714, section on the traffic scenario.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.spaces import MultiDiscrete

from managed_systems import checks, drawing
from managed_systems.environment import RulesEnvironment
from managed_systems.rules import ALWAYS, NEVER, FloatArray, IntArray, Rules, phase

MAX_RATE = 700.0
"""Largest arrival rate, vehicles per step: beyond it exp(-rate) is no longer a normal float64."""

GUIDES = 64
"""Parts of [0, 1), for each of which it is tabulated where a search begins; a power of two, to be exact."""


class TrafficParams(NamedTuple):
    """What the rules of a junction need.

    Attributes
    ----------
    services : int64 array, shape (actions, 2): vehicles that an action lets pass in lanes 1 and 2.
    arrivals : float64 array, shape (phases, 2, n): for lanes 1 and 2 the `poisson_sums` of the arrivals per step,
        and ones behind them.
    guides : int64 array, shape (phases, 2, GUIDES): where in them to begin to look for a uniform, see `poisson`.
    switch_at : int64 array, shape (phases - 1,): episodes from which the next phase holds.
    capacity : most vehicles in a lane.
    fewest, most : limits of a lane's queue at the start.
    long_queue : queue beyond which the longer lane counts twice.
    unused_penalty : penalty for each unit of service that found no vehicle.
    """

    services: IntArray
    arrivals: FloatArray
    guides: IntArray
    switch_at: IntArray
    capacity: int
    fewest: int
    most: int
    long_queue: int
    unused_penalty: float


def poisson_sums(rate: float) -> list[float]:
    """Return P(X <= k) of a Poisson number for k = 0, 1, ..., up to where the sum in floating point grows no more.

    Parameters
    ----------
    rate
        Mean, in ``0..MAX_RATE``.
    """
    k = 0
    probability = below = math.exp(-rate)
    sums = [below]
    while True:
        k += 1
        probability *= rate / k
        # The rounded sum may stop short of the largest uniform; past the mean, where the terms fall, it grows no more.
        if below + probability == below and k > rate:
            return sums
        below += probability
        sums.append(below)


def poisson(sums: FloatArray, guide: IntArray, u: float) -> int:
    """Turn a uniform into a Poisson number by inversion: the smallest k with u < P(X <= k).

    Parameters
    ----------
    sums
        What `poisson_sums` returns, and behind it any number of ones.
    guide
        Shape (GUIDES,): entry i is the number that the uniform i / GUIDES gives, from which the search begins (Chen &
        Asau, Trans. Amer. Inst. Ind. Eng. 6, 1974).
    u
        Uniform in [0, 1).

    Examples
    --------
    P(X = 0) is exp(-2) = 0.1353..., and P(X <= 1) is 0.4060...:

    >>> sums = np.array([*poisson_sums(2.0), 1.0])
    >>> [poisson(sums, guide_to(sums), u) for u in (0.1353, 0.1354, 0.41)]
    [0, 1, 2]
    """
    k = int(guide[int(u * GUIDES)])
    while u >= sums[k]:
        k += 1
    return k


def guide_to(sums: FloatArray) -> IntArray:
    """Return the guide with which `poisson` searches `sums`; the last of them is 1."""
    return np.searchsorted(sums, np.arange(GUIDES) / GUIDES, side="right")


def reset(params: TrafficParams, phase: int, draws: FloatArray, at: int) -> int:
    """Draw both queues uniformly from ``fewest..most``. Uses two draws: lane 1, lane 2."""
    choices = params.most - params.fewest + 1
    lane_1 = params.fewest + int(draws[at] * choices)
    lane_2 = params.fewest + int(draws[at + 1] * choices)
    return lane_1 * (params.capacity + 1) + lane_2


def step(
    params: TrafficParams, phase: int, state: int, action: int, draws: FloatArray, at: int, context: FloatArray
) -> tuple[int, float, bool]:
    """Serve lane 1, let lane 2 fill, serve lane 2, let lane 1 fill. Never ends the episode.

    Uses two draws, in the order of their use: arrivals in lane 2, then in lane 1. Adds to `context` the vehicles that
    arrived in lanes 1 and 2, those included that found the lane full and turned away.
    """
    lane_1 = state // (params.capacity + 1)
    lane_2 = state % (params.capacity + 1)
    service_1 = int(params.services[action, 0])
    service_2 = int(params.services[action, 1])
    unused = max(service_1 - lane_1, 0)
    lane_1 = max(lane_1 - service_1, 0)
    arrivals_2 = poisson(params.arrivals[phase, 1], params.guides[phase, 1], draws[at])
    lane_2 = min(lane_2 + arrivals_2, params.capacity)
    unused += max(service_2 - lane_2, 0)
    lane_2 = max(lane_2 - service_2, 0)
    arrivals_1 = poisson(params.arrivals[phase, 0], params.guides[phase, 0], draws[at + 1])
    lane_1 = min(lane_1 + arrivals_1, params.capacity)
    context[0] += arrivals_1
    context[1] += arrivals_2
    cost = lane_1 + lane_2
    # Of two equally long lanes one counts twice; which one makes no difference.
    longer = max(lane_1, lane_2)
    if longer > params.long_queue:
        cost += longer
    return lane_1 * (params.capacity + 1) + lane_2, -float(cost) - params.unused_penalty * unused, False


def explorable(params: TrafficParams, phase: int, state: int, action: int) -> bool:
    """Every action is: its effect is random in every state."""
    return True


def _arrivals(rates: Sequence[tuple[float, float]]) -> FloatArray:
    """Tabulate the distribution of the arrivals of each phase and lane."""
    sums = [[poisson_sums(rate) for rate in lanes] for lanes in rates]
    longest = max(len(one) for lanes in sums for one in lanes) + 1
    return np.array([[one + [1.0] * (longest - len(one)) for one in lanes] for lanes in sums])


class TrafficJunction(RulesEnvironment[IntArray]):
    """Two lanes share a junction; an action says how many vehicles each lane may send.

    The reward after a step is minus the vehicles that wait, the longer lane counted twice if it exceeds `long_queue`,
    minus `unused_penalty` for each unit of service that found no vehicle. An observation holds both queues,
    shape (2,); its row-major index, ``queue_1 * (capacity + 1) + queue_2``, is the state of the rules. The signals of
    a step are ``arrivals_1`` and ``arrivals_2``: vehicles that came to each lane, whether or not they found room.

    The parameters are kept, as tuples and plain numbers, under their own names.

    Parameters
    ----------
    capacity
        Most vehicles in a lane.
    initial
        Fewest and most vehicles in a lane at the start; drawn uniformly for each.
    max_steps
        Steps after which an episode is truncated; nothing else ends it.
    services
        Vehicles that each action lets pass in lanes 1 and 2.
    reserve
        The same for the actions in reserve, whose ids follow.
    reserve_from
        Episode from which the reserve is available by itself. None: only once `enable_actions` has been called.
    rates
        Mean arrivals per step in lanes 1 and 2, one row per phase.
    switch_at
        Episodes (1-based, at least 2, strictly increasing) from which the next row of `rates` holds.
    long_queue
        Queue beyond which the longer lane counts twice.
    unused_penalty
        Penalty for each unused unit of service.
    render_mode
        ``"ansi"``, ``"rgb_array"`` or None.

    Raises
    ------
    ValueError
        A value is not legal.

    Examples
    --------
    >>> env = TrafficJunction(render_mode="ansi")
    >>> queues, info = env.reset(seed=3)
    >>> info["available_actions"]
    (0, 1, 2)
    >>> env.enable_actions([3])
    >>> queues, reward, terminated, truncated, info = env.step(3)
    >>> info["available_actions"], sorted(info["signals"])
    ((0, 1, 2, 3), ['arrivals_1', 'arrivals_2'])
    """

    def __init__(
        self,
        capacity: int = 10,
        initial: Sequence[int] = (1, 3),
        max_steps: int = 30,
        services: Sequence[Sequence[int]] = ((5, 2), (2, 5), (3, 3)),
        reserve: Sequence[Sequence[int]] = ((7, 3), (3, 7)),
        reserve_from: int | None = None,
        rates: Sequence[Sequence[float]] = ((4, 2), (5, 7), (3, 1)),
        switch_at: Sequence[int] = (3001, 8001),
        long_queue: int = 7,
        unused_penalty: float = 3.0,
        render_mode: str | None = None,
    ) -> None:
        self.capacity = checks.whole("capacity", capacity, 1)
        self.initial = checks.integer_pair("initial", initial, 0, self.capacity)
        if self.initial[0] > self.initial[1]:
            raise ValueError(f"initial is {self.initial}; give the fewest vehicles first, then the most")
        self.max_steps = checks.whole("max_steps", max_steps, 1)
        self.services = self._services("services", services)
        if not self.services:
            raise ValueError("services is (); give at least one action, such as [[3, 3]]")
        self.reserve = self._services("reserve", reserve)
        self.reserve_from = None if reserve_from is None else checks.whole("reserve_from", reserve_from, 1)
        if self.reserve_from is not None and not self.reserve:
            raise ValueError(f"reserve_from is {self.reserve_from}, but reserve is empty; fill it, or give None")
        self.switch_at = checks.episodes("switch_at", switch_at)
        self.rates = self._rates(rates)
        self.long_queue = checks.whole("long_queue", long_queue, 0)
        self.unused_penalty = checks.real("unused_penalty", unused_penalty, 0.0)
        self._enabled: set[int] = set()
        arrivals = _arrivals(self.rates)
        offered, held = len(self.services), len(self.reserve)
        rules = Rules(
            params=TrafficParams(
                services=np.array(self.services + self.reserve, np.int64),
                arrivals=arrivals,
                guides=np.array([[guide_to(sums) for sums in lanes] for lanes in arrivals]),
                switch_at=np.array(self.switch_at, np.int64),
                capacity=self.capacity,
                fewest=self.initial[0],
                most=self.initial[1],
                long_queue=self.long_queue,
                unused_penalty=self.unused_penalty,
            ),
            phase=phase,
            reset=reset,
            step=step,
            explorable=explorable,
            n_states=(self.capacity + 1) ** 2,
            n_actions=offered + held,
            max_steps=self.max_steps,
            reset_draws=2,
            step_draws=2,
            signal_names=("arrivals_1", "arrivals_2"),
            windows=np.array([[1, ALWAYS]] * offered + [[self._reserve_first(), ALWAYS]] * held, np.int64),
            drifts=self.switch_at,
        )
        super().__init__(rules, MultiDiscrete([self.capacity + 1, self.capacity + 1]), render_mode)

    def enable_actions(self, ids: Iterable[int]) -> None:
        """Make actions of the reserve available, from this moment and for every episode; again changes nothing.

        Raises
        ------
        ValueError
            An id is not in reserve; then none of them is enabled.
        """
        self._set_enabled(self._enabled | self._reserve_ids("ids", ids))

    def get_state(self) -> dict[str, Any]:
        """Return what the junction carries from one episode to the next, as plain JSON data."""
        return {"enabled": sorted(self._enabled)}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Take up what `get_state` returned, here or on another junction with the same parameters.

        Raises
        ------
        ValueError
            It is not such a state; then nothing has changed.
        """
        if not isinstance(state, Mapping) or set(state) != {"enabled"}:
            raise ValueError(f"state is {state!r}; give what get_state() returned, such as {{'enabled': [3, 4]}}")
        self._set_enabled(self._reserve_ids("state['enabled']", state["enabled"]))

    def _reserve_ids(self, name: str, ids: object) -> set[int]:
        legal = range(len(self.services), len(self.services) + len(self.reserve))
        found = checks.items(name, ids, f"a sequence of the actions in reserve, {tuple(legal)}")
        for action in found:
            if isinstance(action, bool) or not isinstance(action, int | np.integer) or action not in legal:
                raise ValueError(f"{name} has {action!r}, which is not in reserve; in reserve are {tuple(legal)}")
        return {int(action) for action in found}

    def _reserve_first(self) -> int:
        """First episode of an action in reserve that nobody has enabled."""
        return NEVER if self.reserve_from is None else self.reserve_from

    def _set_enabled(self, enabled: set[int]) -> None:
        self._enabled = enabled
        windows = self.rules.windows
        for action in range(len(self.services), len(windows)):
            windows[action, 0] = 1 if action in enabled else self._reserve_first()
        self._renew_availability()

    def _services(self, name: str, values: object) -> tuple[tuple[int, int], ...]:
        found = checks.items(name, values, "a sequence of pairs (vehicles of lane 1, vehicles of lane 2)")
        return tuple(checks.integer_pair(f"{name}[{i}]", pair, 0) for i, pair in enumerate(found))

    def _rates(self, values: object) -> tuple[tuple[float, float], ...]:
        found = []
        for i, row in enumerate(checks.items("rates", values, "a sequence of pairs (rate of lane 1, rate of lane 2)")):
            first, second = checks.items(f"rates[{i}]", row, "two arrival rates", length=2)
            found.append(
                (
                    checks.real(f"rates[{i}][0]", first, 0.0, MAX_RATE),
                    checks.real(f"rates[{i}][1]", second, 0.0, MAX_RATE),
                )
            )
        if len(found) != len(self.switch_at) + 1:
            raise ValueError(
                f"rates has {len(found)} rows, but switch_at {self.switch_at} makes {len(self.switch_at) + 1} phases; "
                "give one row for each phase: one more than there are switches"
            )
        return tuple(found)

    def _observe(self, state: int) -> IntArray:
        return np.array(divmod(state, self.capacity + 1), np.int64)

    def _as_text(self) -> str:
        """Draw each queue as a bar; what exceeds the long queue is marked with !."""
        lines = []
        for lane, queue in enumerate(divmod(self._state, self.capacity + 1), start=1):
            bar = "".join("!" if place >= self.long_queue else "#" for place in range(queue))
            lines.append(f"lane {lane} |{bar:.<{self.capacity}}| {queue:>{len(str(self.capacity))}}")
        return "\n".join(lines)

    def _as_image(self) -> drawing.Image:
        """Draw lane 1 from the left and lane 2 from the top, with a vehicle in each place that is taken.

        Vehicles beyond the long queue are red.
        """
        slot, road, margin, tail = 30, 48, 16, 24
        length = self.capacity * slot
        side = 2 * margin + length + road + tail
        image = drawing.blank(side, side, drawing.PALE_GREEN)
        asphalt = margin + length
        drawing.box(image, asphalt, 0, road, side, drawing.SLATE)
        drawing.box(image, 0, asphalt, side, road, drawing.SLATE)
        drawing.box(image, asphalt - 3, asphalt + 4, 3, road - 8, drawing.FIELD)
        drawing.box(image, asphalt + 4, asphalt - 3, road - 8, 3, drawing.FIELD)
        across = asphalt + (road - 20) // 2
        for lane, queue in enumerate(divmod(self._state, self.capacity + 1), start=1):
            for place in range(self.capacity):
                along = asphalt - (place + 1) * slot
                if place >= queue:
                    colour, inset = (96, 106, 120), 6
                else:
                    colour, inset = (drawing.RED if place >= self.long_queue else (240, 196, 84)), 0
                long, wide = slot - 8 - inset, 20 - inset
                first, second = along + inset // 2, across + inset // 2
                if lane == 1:
                    drawing.box(image, second, first, wide, long, colour, radius=5)
                else:
                    drawing.box(image, first, second, long, wide, colour, radius=5)
        return image
