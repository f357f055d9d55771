"""Random configs of small runs."""

from hypothesis import strategies as st

EPISODES = 8


def switches(episodes=EPISODES):
    return st.lists(st.integers(2, episodes), unique=True, max_size=3).map(sorted)


unit = st.sampled_from([0.0, 0.1, 0.5, 0.99, 1.0]) | st.floats(0, 1)
rate = st.sampled_from([0.1, 0.5, 1.0])

schedules = st.one_of(
    st.fixed_dictionaries({"name": st.just("exponential"), "eps_min": unit, "decay": st.floats(0, 3)}),
    st.fixed_dictionaries({"name": st.just("success"), "eps_min": unit, "decay": st.floats(0, 3)}),
    st.fixed_dictionaries({"name": st.just("geometric"), "eps_min": unit, "factor": st.floats(0.5, 1)}),
    st.fixed_dictionaries({"name": st.just("constant"), "epsilon": unit}),
)
detectors = st.lists(
    st.one_of(
        st.fixed_dictionaries({"name": st.just("page_hinkley"), "delta": st.just(0.5), "threshold": st.floats(1, 60)}),
        st.fixed_dictionaries(
            {
                "name": st.just("two_window"),
                "reference": st.just(3),
                "recent": st.just(2),
                "threshold": st.floats(0.5, 3),
            }
        ),
        st.fixed_dictionaries({"name": st.just("oracle"), "episodes": switches()}),
        st.just({"name": "page_hinkley", "signal": "td_error", "threshold": 0.1}),
    ),
    max_size=2,
)
learners = st.fixed_dictionaries(
    {
        "name": st.sampled_from(["q_learning", "expected_sarsa"]),
        "discount": unit,
        "bootstrap_terminal": st.booleans(),
    }
)


@st.composite
def planners(draw, reserve=()):
    schedule = draw(schedules)
    if draw(st.integers(0, 3)) == 0:
        return {"name": "q_learning", "alpha": draw(rate), "schedule": schedule}
    respond_to = draw(st.lists(st.sampled_from(["drift", "added", "removed"]), unique=True))
    chosen = {"name": "morphin", "alpha": 0.1, "alpha_max": draw(rate), "k": draw(st.sampled_from([0.0, 5.0, 20.0]))}
    return chosen | {"respond_to": respond_to, "enable_on_drift": list(reserve), "schedule": schedule}


@st.composite
def gridworlds(draw, episodes=EPISODES):
    size = draw(st.tuples(st.integers(1, 6), st.integers(2, 6)))
    cell = st.tuples(st.integers(0, size[0] - 1), st.integers(0, size[1] - 1))
    places = draw(st.lists(cell, unique=True, min_size=2, max_size=7))
    goals = places[1 : draw(st.integers(2, min(len(places), 3)))]
    jump_from = draw(st.none() | st.integers(1, episodes))
    removable = st.integers(0, 3 if jump_from is None else 7)
    options = {
        "size": size,
        "start": places[0],
        "goals": goals,
        "switch_at": draw(switches(episodes)) if len(goals) > 1 else [],
        "walls": places[1 + len(goals) :],
        "max_steps": draw(st.integers(1, 25)),
        "slip": draw(st.sampled_from([0.0, 0.3])),
        "jump_from": jump_from,
        "remove": draw(st.dictionaries(removable.map(str), st.integers(2, episodes + 2), max_size=3)),
        "step_reward": draw(st.sampled_from([-1.0, 0.0, 0.3])),
    }
    return {"id": "mapek/Gridworld-v0", "options": {k: v for k, v in options.items() if v is not None}}, ()


@st.composite
def junctions(draw, episodes=EPISODES):
    changes = draw(switches(episodes))
    services = draw(st.sampled_from([((5, 2), (2, 5), (3, 3)), ((4, 4),)]))
    rates = st.tuples(st.floats(0, 12), st.floats(0, 12))
    options = {
        "capacity": draw(st.integers(3, 10)),
        "max_steps": draw(st.integers(1, 20)),
        "services": services,
        "switch_at": changes,
        "rates": draw(st.lists(rates, min_size=len(changes) + 1, max_size=len(changes) + 1)),
    }
    reserve_from = draw(st.none() | st.integers(1, episodes))
    if reserve_from is not None:
        options["reserve_from"] = reserve_from
    return {"id": "mapek/TrafficJunction-v0", "options": options}, draw(
        st.sampled_from([(), (len(services), len(services) + 1), (len(services) + 1,)])
    )


@st.composite
def configs(draw, systems):
    system, reserve = draw(systems)
    return {
        "episodes": EPISODES,
        "seed": draw(st.integers(0, 2**63 - 1)),
        "system": system,
        "learner": draw(learners),
        "monitor": {"detectors": draw(detectors)},
        "plan": draw(planners(reserve)),
        "execute": {"mask_greedy": draw(st.booleans())},
    }
