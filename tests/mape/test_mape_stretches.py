"""Compiled stretches of quiet passes, and passes in plain Python: one semantics, with the same bits."""

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stretch_runs import SYSTEMS, Combination, declares_a_rule, hold, names

from mape.registry import PARTS

GRID, JUNCTION, LAKE, TAXI = "mapek/Gridworld-v0", "mapek/TrafficJunction-v0", "FrozenLake-v1", "Taxi-v4"


def with_all(combinations):
    """Add combinations until each part and each system is in one of them."""
    base = Combination(LAKE, ("two_window",), "morphin", "success", "q_learning")
    used = {name for _, detectors, *rest in combinations for name in (*detectors, *rest)}
    missing = [sorted(set(SYSTEMS) - {combination.system for combination in combinations})]
    missing += [
        [part for part in names(kind) if part not in used]
        for kind in ("detector", "planner", "schedule", "learner", "analyzer")
    ]
    added = [
        Combination(*(new or old for new, old in zip(row, (base[0], *base[1], *base[2:]), strict=True)))
        for row in itertools.zip_longest(*missing)
    ]
    return combinations + [combination._replace(detectors=(combination.detectors,)) for combination in added]


# Few, as each combination of rules is compiled by itself; those that are added have a table's rules, as others have.
QUICK = with_all([
    Combination(GRID, (), "morphin", "exponential", "q_learning"),
    Combination(GRID, ("page_hinkley",), "morphin", "success", "q_learning"),
    Combination(GRID, ("two_window", "page_hinkley"), "morphin", "geometric", "expected_sarsa"),
    Combination(JUNCTION, ("page_hinkley",), "morphin", "exponential", "q_learning"),
    Combination(JUNCTION, ("two_window", "oracle", "page_hinkley"), "q_learning", "constant", "q_learning"),
    Combination(JUNCTION, ("oracle",), "morphin", "geometric", "q_learning"),
    Combination(LAKE, ("two_window",), "morphin", "success", "q_learning"),
    Combination(TAXI, ("page_hinkley", "page_hinkley"), "q_learning", "exponential", "expected_sarsa"),
])  # fmt: skip
EVERY = [
    Combination(system, (detector,), *rest)
    for system, detector, *rest in itertools.product(
        SYSTEMS, *map(names, ("detector", "planner", "schedule", "learner", "analyzer"))
    )
]


def said(combination):
    system, detectors, *rest = combination
    return "-".join([system.removeprefix("mapek/"), "+".join(detectors), *rest])


def test_every_part_of_ours_says_what_it_does_in_a_quiet_pass():
    silent = [
        f"{kind} {name}"
        for kind, entries in PARTS.items()
        for name, entry in entries.items()
        if entry.target.startswith("mape.") and not declares_a_rule(kind, name)
    ]
    assert silent == []


@pytest.mark.parametrize("combination", QUICK, ids=said)
@settings(max_examples=8)
@given(st.data())
def test_a_run_by_any_engines_is_the_run_in_plain_python(combination, data):
    hold(data, combination)


@pytest.mark.long
@pytest.mark.parametrize("combination", EVERY, ids=said)
@settings(max_examples=4)
@given(st.data())
def test_a_run_of_any_combination_is_the_run_in_plain_python(combination, data):
    hold(data, combination)


combinations = st.builds(
    Combination,
    st.sampled_from(sorted(SYSTEMS)),
    st.lists(st.sampled_from(names("detector")), max_size=3).map(tuple),
    *(st.sampled_from(names(kind)) for kind in ("planner", "schedule", "learner", "analyzer")),
)


@pytest.mark.long
@pytest.mark.timeout(3600)
@settings(max_examples=200)
@given(st.data())
def test_a_run_of_any_parts_that_change_on_the_way_is_the_run_in_plain_python(data):
    hold(data, data.draw(combinations), swapped_for=lambda kind, name: names(kind))
