"""Statistics, against SciPy and against what can be worked out by hand."""

import json
import math
import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy import stats

from adapters.experiments.statistics import compare, finite, holm, summary

FIRST = np.array([10.0, 12.0, 9.0, 11.0, 13.0, 10.5, 9.5])
SECOND = np.array([15.0, 14.0, 18.0, 16.5, 13.5, 30.0, 17.0])


def test_a_summary_has_mean_deviation_of_n_minus_1_and_number() -> None:
    found = summary(np.array([1.0, 2.0, 3.0, 6.0]))

    assert (found.mean, found.n) == (3.0, 4)
    assert found.sd == pytest.approx(math.sqrt((4 + 1 + 0 + 9) / 3))


def test_an_interval_holds_the_mean_and_is_that_of_scipy() -> None:
    found = summary(SECOND)
    expected = stats.bootstrap(
        (SECOND,), np.mean, n_resamples=4999, method="BCa", rng=np.random.default_rng(0), batch=500
    ).confidence_interval

    assert found.interval == pytest.approx((expected.low, expected.high))
    assert found.interval is not None
    assert found.interval[0] < found.mean < found.interval[1]


def test_an_interval_of_95_percent_misses_the_mean_about_once_in_twenty() -> None:
    generator = np.random.default_rng(5)
    missed = 0
    for _ in range(60):
        interval = summary(generator.normal(3.0, 1.0, 40)).interval
        assert interval is not None
        missed += not interval[0] <= 3.0 <= interval[1]

    # 60 draws of probability .05: more than 9 would come up once in a thousand seeds, and this seed is fixed.
    assert 0 < missed <= 9


def test_the_same_sample_gives_the_same_interval_again() -> None:
    assert summary(SECOND) == summary(SECOND.copy())


def test_one_value_has_neither_deviation_nor_interval() -> None:
    assert summary(np.array([4.0])) == (4.0, None, 1, None)


@pytest.mark.parametrize("value", [0.0, 0.1, -7.0, 1e300])
def test_equal_values_deviate_by_nothing(value: float) -> None:
    found = summary(np.full(3, value))

    assert found.sd == 0
    assert found.interval is not None
    assert found.interval == pytest.approx((value, value))


def test_whole_numbers_are_taken_as_they_are() -> None:
    assert summary(np.array([1, 2, 3], dtype=np.int64)).mean == 2.0


def test_a_comparison_is_of_the_second_against_the_first() -> None:
    found = compare(FIRST, SECOND)
    welch = stats.ttest_ind(SECOND, FIRST, equal_var=False)

    assert found.difference == pytest.approx(SECOND.mean() - FIRST.mean())
    assert found.ratio == pytest.approx(SECOND.mean() / FIRST.mean())
    assert (found.t, found.df, found.p) == pytest.approx((welch.statistic, welch.df, welch.pvalue))
    assert found.interval is not None
    assert found.ratio_interval is not None
    assert found.interval[0] < found.difference < found.interval[1]
    assert found.ratio_interval[0] < found.ratio < found.ratio_interval[1]


def test_the_other_way_round_the_signs_change_and_the_ratio_is_turned_over() -> None:
    there, back = compare(FIRST, SECOND), compare(SECOND, FIRST)

    assert (back.difference, back.t, back.hedges_g) == pytest.approx((-there.difference, -there.t, -there.hedges_g))
    assert (back.p, back.df) == pytest.approx((there.p, there.df))
    assert back.ratio == pytest.approx(1 / there.ratio)


def test_hedges_g_is_the_difference_over_the_pooled_deviation_with_the_correction_for_small_samples() -> None:
    found = compare(np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 9.0]))

    # Pooled variance (1 + 7) / 2; correction 1 - 3 / (4 * 6 - 9).
    assert found.hedges_g == pytest.approx((1 - 3 / 15) * 4 / 2)


def test_a_sample_that_does_not_vary_can_be_compared_with_one_that_does() -> None:
    found = compare(np.full(7, 20.0), SECOND)

    # The spread is the second's alone: a t-test of one sample against a known mean.
    single = stats.ttest_1samp(SECOND, 20.0)
    assert (found.t, found.df, found.p) == pytest.approx((single.statistic, 6, single.pvalue))
    assert (found.paired_t, found.paired_df, found.paired_p) == pytest.approx((found.t, found.df, found.p))


def test_the_paired_test_is_that_of_scipy_and_its_effect_the_mean_over_the_deviation_of_the_differences() -> None:
    found = compare(FIRST, SECOND)
    paired = stats.ttest_rel(SECOND, FIRST)

    assert (found.paired_t, found.paired_df, found.paired_p) == pytest.approx(
        (paired.statistic, paired.df, paired.pvalue)
    )
    differences = SECOND - FIRST
    assert found.paired_effect == pytest.approx(differences.mean() / differences.std(ddof=1))


def test_intervals_are_those_of_the_paired_bootstrap() -> None:
    found = compare(FIRST, SECOND)

    def bootstrap(statistic: Any) -> Any:
        return stats.bootstrap(
            (FIRST, SECOND), statistic, paired=True, n_resamples=4999, rng=np.random.default_rng(0), batch=500
        ).confidence_interval

    assert found.interval == pytest.approx(
        bootstrap(lambda a, b, axis=-1: np.mean(b, axis=axis) - np.mean(a, axis=axis))
    )
    assert found.ratio_interval == pytest.approx(
        bootstrap(lambda a, b, axis=-1: np.mean(b, axis=axis) / np.mean(a, axis=axis))
    )


def test_luck_that_two_agents_share_makes_the_interval_no_wider() -> None:
    generator = np.random.default_rng(3)
    luck, own = generator.normal(1000, 100, 40), generator.normal(5, 10, 40)
    found = compare(luck, luck + own)

    assert found.interval is not None
    assert found.paired_p is not None
    assert found.p is not None
    # A paired interval is about 4 * 10 / sqrt(40) wide; one of independent samples would be 4 * 140 / sqrt(40).
    assert found.interval[1] - found.interval[0] < 10
    assert found.paired_p < 0.05 < found.p


def test_trials_that_have_no_partner_are_refused() -> None:
    with pytest.raises(ValueError, match="7 and 6"):
        compare(FIRST, SECOND[:6])


@pytest.mark.parametrize("step", [0.0, 0.3, -7.0])
def test_differences_that_are_all_equal_have_no_interval_and_no_paired_test(step: float) -> None:
    first = np.array([0.1, 0.2, 0.7, 1e3])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = compare(first, first + step)

    assert found.difference == pytest.approx(step)
    assert (found.interval, found.paired_effect, found.paired_t, found.paired_df, found.paired_p) == (None,) * 5
    json.dumps(found, allow_nan=False)


@pytest.mark.parametrize(
    ("first", "second"),
    [([1.0], [2.0]), ([3.0], [3.0]), ([0.1, 0.1, 0.1], [0.3, 0.3, 0.3]), ([5.0, 5.0], [5.0, 5.0])],
)
def test_samples_that_say_nothing_of_spread_have_a_difference_and_no_test(
    first: list[float], second: list[float]
) -> None:
    found = compare(np.array(first), np.array(second))

    assert found.difference == pytest.approx(np.mean(second) - np.mean(first))
    assert found.ratio == pytest.approx(np.mean(second) / np.mean(first))
    assert (found.interval, found.ratio_interval, *found[4:]) == (None,) * 10


@pytest.mark.parametrize(
    ("first", "second"), [([-1.0, -2.0], [3.0, 4.0]), ([0.0, 0.0], [3.0, 4.0]), ([1.0, -1.0], [1.0, 2.0])]
)
def test_a_ratio_of_means_of_unlike_sign_or_of_nothing_is_not_given(first: list[float], second: list[float]) -> None:
    found = compare(np.array(first), np.array(second))

    assert (found.ratio, found.ratio_interval) == (None, None)


def test_holm_multiplies_the_smallest_by_their_number_and_never_lets_a_larger_p_become_the_smaller() -> None:
    assert holm([0.01, 0.04, 0.03, 0.5]) == pytest.approx([0.04, 0.09, 0.09, 0.5])
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([0.02]) == [0.02]
    assert holm([]) == []


def test_holm_leaves_out_comparisons_that_have_no_p() -> None:
    assert holm([None, 0.01, None, 0.04]) == [None, 0.02, None, 0.04]
    assert holm([None]) == [None]


@pytest.mark.parametrize("nothing", [math.nan, math.inf, -math.inf])
def test_a_p_that_is_no_number_counts_as_none_and_leaves_the_others_alone(nothing: float) -> None:
    assert holm([nothing, 0.01, 0.04]) == [None, 0.02, 0.04]
    assert holm([0.04, nothing, 0.01, nothing]) == [0.04, None, 0.02, None]


@given(st.lists(st.none() | st.floats(0, 1)))
def test_holm_keeps_the_order_and_stays_a_probability(p_values: list[float | None]) -> None:
    pairs = [(p, c) for p, c in zip(p_values, holm(p_values), strict=True) if p is not None]

    assert all(c is not None and p <= c <= 1 for p, c in pairs)
    corrected = [c for _, c in sorted(pairs)]
    assert corrected == sorted(corrected)


def test_finite_turns_everything_into_plain_json() -> None:
    data: dict[Any, Any] = {
        "t": (1, np.int64(2), np.float64(0.5)),
        3: np.array([[1.0, np.nan], [np.inf, -np.inf]]),
        "flag": np.True_,
        "deep": {"nan": float("nan"), "none": None, "text": "x"},
    }

    assert finite(data) == {
        "t": [1, 2, 0.5],
        "3": [[1.0, None], [None, None]],
        "flag": True,
        "deep": {"nan": None, "none": None, "text": "x"},
    }
    assert type(finite(np.float64(0.5))) is float


NUMBER = st.floats(-1e12, 1e12) | st.sampled_from([0.0, 0.1, -37.0])


@example([(-2.225073858507e-311, -1.0)])
@given(st.lists(st.tuples(NUMBER, NUMBER), min_size=1, max_size=5))
def test_no_statistic_warns_or_puts_a_number_into_json_that_is_none(pairs: list[tuple[float, float]]) -> None:
    first, second = ([pair[i] for pair in pairs] for i in (0, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = [summary(np.array(first))._asdict(), compare(np.array(first), np.array(second))._asdict()]

    json.dumps(finite(found), allow_nan=False)
    # What is None in JSON was None before: nothing non-finite had to be hidden.
    json.dumps(found, allow_nan=False)
