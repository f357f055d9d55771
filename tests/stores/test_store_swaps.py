"""Which parts were replaced, as the file tells it whoever does a pass again."""

from hypothesis import given
from hypothesis import strategies as st

from adapters.stores import Store, Swap


def swap(name, planned, handed_over=False, number=4):
    return Swap(0, number, "plan", {"name": name}, handed_over, planned)


def test_a_planned_swap_that_is_told_again_leaves_the_one_that_was_asked_for():
    with Store(None) as store:
        for told in (swap("planned", True), swap("live", False, True), swap("planned", True)):
            store.keep_swap(told)
        assert store.swaps() == [swap("live", False, True)]


@given(st.lists(st.builds(swap, st.sampled_from("abc"), st.booleans(), st.booleans(), st.integers(1, 3)), max_size=12))
def test_of_each_pass_the_last_swap_is_kept_and_one_that_was_asked_for_rather_than_a_planned_one(told):
    expected = {}
    for one in told:
        if one.planned and one.pass_no in expected and not expected[one.pass_no].planned:
            continue
        expected[one.pass_no] = one
    with Store(None) as store:
        for one in told:
            store.keep_swap(one)
        assert store.swaps() == [expected[number] for number in sorted(expected)]
