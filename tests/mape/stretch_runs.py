"""Runs in pieces by one engine and by several, and all that they must agree on."""

import json
from typing import NamedTuple

import pytest
from hypothesis import assume
from hypothesis import strategies as st
from mape_configs import gridworlds, junctions, rate, switches, unit

from adapters.systems import SYSTEMS as EXAMPLES
from adapters.systems import make_system
from adapters.systems.tabulated import WITH_TABLE
from knowledge import STAGES, ChangePlan
from mape.config import from_table
from mape.errors import ConfigError, MapekError
from mape.loop import Loop
from mape.parts import config_at
from mape.registry import PARTS, find

PASSES = 60
"""The longest piece in which a run is made; what happens in it happens up to there, as a rule."""


class Combination(NamedTuple):
    """The rules of a run, by names: each combination of them is compiled by itself."""

    system: str
    detectors: tuple[str, ...]
    planner: str
    schedule: str
    learner: str
    analyzer: str = "changes"


def declares_a_rule(kind, name):
    """Whether quiet passes of a part can be compiled; a learner's always can."""
    return kind == "learner" or "quiet" in vars(find(kind, name))


def names(kind):
    return [name for name in PARTS[kind] if declares_a_rule(kind, name)]


@st.composite
def tables_of(draw, name):
    """A system of Gymnasium's that is played from its table."""
    options = {"is_slippery": draw(st.booleans())} if name.startswith("FrozenLake") else {}
    return {"id": name, "options": options, "tabulated": True, "max_steps": draw(st.sampled_from([1, 12, 30]))}, ()


OURS = {"mapek/Gridworld-v0": gridworlds(PASSES), "mapek/TrafficJunction-v0": junctions(PASSES)}
SYSTEMS = {
    **{name: OURS[name] for name in EXAMPLES if name.startswith("mapek/")},
    **{name: tables_of(name) for name in WITH_TABLE},
}
threshold = st.sampled_from([0.0001, 0.5, 3.0, 30.0, 1e4])
decay = st.floats(0, 3) | st.sampled_from([0.0, 0.05])
OPTIONS = {
    "page_hinkley": {"delta": st.sampled_from([0.0, 0.5]), "threshold": threshold},
    "two_window": {"threshold": threshold, "reference": st.integers(2, 6), "recent": st.integers(2, 4)},
    "oracle": {"episodes": switches(PASSES)},
    "exponential": {"eps_min": unit, "decay": decay},
    "success": {"eps_min": unit, "decay": decay, "on_success": st.floats(1, 20), "on_failure": st.floats(0, 2)},
    "geometric": {"eps_min": unit, "factor": st.floats(0.5, 1)},
    "constant": {"epsilon": unit},
    "morphin": {
        "alpha_max": rate,
        "k": st.sampled_from([0.0, 5.0, 20.0]),
        "respond_to": st.lists(st.sampled_from(["drift", "added", "removed"]), unique=True),
    },
}
"""Options of parts; what is not here, or not a part that has a learner's or planner's, is made without any."""
ALPHA = {"alpha": st.just(0.1)}
LEARNING = {"discount": unit, "bootstrap_terminal": st.booleans()}


@st.composite
def configs(draw, combination, *, swapped_for=lambda kind, name: [name]):
    """Configs of a combination; `swapped_for` says which parts of a kind may take the place of one of them."""
    system, reserve = draw(SYSTEMS[combination.system])
    signals = ["return", "steps", "td_error", "q_change"]
    signals += ["arrivals_1", "arrivals_2"] if "Traffic" in combination.system else []

    def part(kind, name):
        options = OPTIONS.get(name, {})
        if kind in ("learner", "planner"):
            options = {"learner": LEARNING, "planner": ALPHA | options if name == "morphin" else ALPHA}[kind]
        made = {"name": name} | draw(st.fixed_dictionaries(options))
        if kind == "detector":
            made["signal"] = draw(st.sampled_from(signals))
        if name == "morphin":
            made["enable_on_drift"] = reserve
        return made

    swaps = {}
    places = {"plan": ("planner", combination.planner), "plan.schedule": ("schedule", combination.schedule)}
    places |= {"learner": ("learner", combination.learner), "analyze": ("analyzer", combination.analyzer)}
    places |= {f"monitor.{k}": ("detector", name) for k, name in enumerate(combination.detectors)}
    for _ in range(draw(st.sampled_from([0, 0, 1, 3]))):
        place, number = draw(st.sampled_from(sorted(places))), draw(st.integers(1, 2 * PASSES))
        kind, name = places[place]
        new = part(kind, draw(st.sampled_from(swapped_for(kind, name))))
        if kind == "planner" and draw(st.booleans()):
            new["schedule"] = part("schedule", draw(st.sampled_from(swapped_for("schedule", combination.schedule))))
        swaps[place, number] = {"pass": number, "part": place, "to": new}
    return {
        "episodes": 10_000,
        "seed": draw(st.integers(0, 2**63 - 1)),
        "loops": 3,
        "system": system,
        "learner": part("learner", combination.learner),
        "monitor": {"detectors": [part("detector", name) for name in combination.detectors]},
        "analyze": part("analyzer", combination.analyzer),
        "plan": part("planner", combination.planner) | {"schedule": part("schedule", combination.schedule)},
        "execute": {"mask_greedy": draw(st.booleans())},
        "swap": list(swaps.values()),
    }


number = st.integers(0, PASSES)
listens = st.sampled_from([False, False, False, True])
deeds = st.one_of(
    st.tuples(st.just("run"), number),
    st.tuples(st.just("run"), number),
    st.tuples(st.just("step"), st.integers(1, 9)),
    st.tuples(st.just("trace"), st.integers(1, 2 * PASSES), st.integers(0, 5)),
    st.tuples(st.just("elsewhere"), listens),
    st.tuples(st.just("take_up")),
)


@st.composite
def scripts(draw):
    """What is done with a run, and by which engines: another one each time that it goes on elsewhere."""
    script = [("listen", draw(listens)), *draw(st.lists(deeds, max_size=5)), ("run", draw(number)), ("run", 10)]
    others = sum(deed == "elsewhere" for deed, *_ in script)
    engines = [draw(st.sampled_from(["auto", "compiled"]))]
    engines += draw(st.lists(st.sampled_from(["auto", "compiled", "python"]), min_size=others, max_size=others))
    return script, engines


class Run:
    """A run by engines that take turns, and what is heard of it.

    Parameters
    ----------
    table
        The config, but for the engine.
    engines
        The engine that begins, and those that go on elsewhere, one after the other.
    make
        Makes the system of its config.
    trial, loop
        Which stream of randomness is used.
    """

    def __init__(self, table, engines, make=make_system, trial=0, loop=0):
        self._configs = iter([
            from_table({**table, "execute": {**table.get("execute", {}), "engine": engine}}) for engine in engines
        ])  # fmt: skip
        self._make, self._unit = make, (trial, loop)
        self.rows, self.traces, self.swaps, self.records, self.errors = [], [], [], [], []
        self._begin(next(self._configs))

    def _begin(self, config):
        self.loop = Loop(config, self._make(config.system), *self._unit)
        self.loop.log.on_rows(lambda rows: self.rows.extend(row.tobytes() for row in rows))
        self.loop.on_swap(lambda *told: self.swaps.append(told))

    def follow(self, script):
        """Do what a script says; where a part or the system fails, keep what was said, and do no more of it."""
        try:
            for deed, *numbers in script:
                getattr(self, deed)(*numbers)
        except (MapekError, KeyError) as error:
            self.errors.append(f"{type(error).__name__}: {error}")
        return self

    def run(self, passes):
        self.loop.run(passes)

    def step(self, records):
        for _ in range(records):
            self.loop.advance()

    def trace(self, first, count):
        self.loop.execute.record_trace(
            first, first + count - 1, lambda number, steps: self.traces.append((number, steps.tobytes()))
        )

    def listen(self, listens=True):
        for kind in STAGES if listens else ():
            self.loop.bus.subscribe(kind, self.records.append)

    def take_up(self):
        """Let the components take up the states that they give."""
        for component in (self.loop.monitor, self.loop.analyze, self.loop.plan):
            component.restore(json.loads(json.dumps(component.state())))

    def elsewhere(self, listens=False):
        """Give what the components carry to a loop that is made anew."""
        before = self.loop
        before.run(0)
        if not before.log.passes:
            return
        before.log.flush()
        config, passes = next(self._configs), before.log.passes
        left = tuple(swap for swap in config.swap if swap.pass_no > passes)
        self._begin(config_at(config, passes).model_copy(update={"swap": left}))
        after = self.loop
        after.log.restore(before.log.find(ChangePlan, 0), self.rows[-passes:], list(before.log.window), [])
        state, table = before.execute.state()
        after.execute.restore(json.loads(json.dumps(state)), table)
        for name in ("monitor", "analyze", "plan"):
            getattr(after, name).restore(json.loads(json.dumps(getattr(before, name).state())))
        after.knowledge.plan = before.knowledge.plan
        self.listen(listens)

    def seen(self):
        """All that does not depend on the engine."""
        loop = self.loop
        loop.log.flush()
        rows = b"".join(self.rows)
        return {
            "errors": self.errors,
            "passes": (loop.log.passes, loop.execute.passes),
            "window": list(loop.log.window),
            "last row": loop.log.last_row() if loop.log.started else b"",
            "returns": loop.knowledge.history("return"),
            "plans": (loop.knowledge.plan, loop.execute.plan),
            "actions": (loop.knowledge.actions, loop.execute.available, loop.execute.q_table.actions),
            "states": json.dumps([loop.monitor.state(), loop.analyze.state(), loop.plan.state()]),
            "execute": json.dumps(loop.execute.state()[0]),
            "traces": self.traces,
            "swaps": self.swaps,
            "records": self.records,
            "rows": rows,
            "log": loop.log.sha256(),
            "table": loop.execute.q_table.sha256(),
        }


def alike(table, *scripts, engines=("auto",), **arguments):
    """Hold a run by some engines against the same one by plain Python alone; return both.

    Each script is done whether the one before it failed or not.
    """
    plain, mixed = Run(table, ["python"] * len(engines), **arguments), Run(table, engines, **arguments)
    for script in scripts:
        plain.follow(script)
        mixed.follow(script)
    one, other = mixed.seen(), plain.seen()
    for what, found in one.items():
        assert found == other[what], f"{what} of {engines}: {found}\n\nin plain Python: {other[what]}"
    return mixed, plain


def hold(data, combination, **swaps):
    """Draw a run of a combination, and hold the engines together on it."""
    table, (script, engines) = data.draw(configs(combination, **swaps)), data.draw(scripts())
    unit = {"trial": data.draw(st.integers(0, 3)), "loop": data.draw(st.integers(0, 2))}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("knowledge.log.SEGMENT", data.draw(st.sampled_from([1, 7, 512])))
        patched.setattr("mape.execute.uniforms.DRAWS_AT_ONCE", data.draw(st.sampled_from([1, 500, 65_536])))
        try:
            alike(table, script, engines=engines, **unit)
        except ConfigError:
            assume(False)  # no such grid: a goal that cannot be reached, say
