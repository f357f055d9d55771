"""Statistics of samples over trials: intervals and effect sizes first, p-values beside them.

With a thousand trials every p is tiny; what a reader needs is how large a difference is, and how sure.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
RESAMPLES = 4999

FEW = 10
"""Trials below which intervals and tests are said to be of few."""


class Summary(NamedTuple):
    """Mean, standard deviation (n - 1), number, and 95 % bootstrap interval of the mean (None below 2 values)."""

    mean: float
    sd: float | None
    n: int
    interval: tuple[float, float] | None


class Comparison(NamedTuple):
    """Second sample against the first, both of the same number of trials.

    Agents that share their trials' seeds share some of their luck, and the differences within trials are free of what
    they share: the intervals and the `paired_` fields rest on those. Welch's test and Hedges' g take the samples as
    independent, which they are not; they stand here for comparison with what others print. Where nothing is shared they
    are what there is: then the intervals are of independent samples, and the `paired_` fields None.

    Attributes
    ----------
    difference : mean of the second minus mean of the first.
    interval : 95 % bootstrap interval of it; where the samples are paired, whole trials are drawn.
    ratio, ratio_interval : mean of the second over mean of the first, and the same interval of it; None where that says
        nothing.
    hedges_g : difference in units of the pooled standard deviation, corrected for small samples.
    t, df, p : Welch's t-test.
    paired_effect : mean of the differences within trials over their standard deviation (Cohen's d_z).
    paired_t, paired_df, paired_p : paired t-test.
    """

    difference: float
    interval: tuple[float, float] | None = None
    ratio: float | None = None
    ratio_interval: tuple[float, float] | None = None
    hedges_g: float | None = None
    t: float | None = None
    df: float | None = None
    p: float | None = None
    paired_effect: float | None = None
    paired_t: float | None = None
    paired_df: float | None = None
    paired_p: float | None = None


@np.errstate(all="ignore")  # what is too large for a float becomes infinite, and null in JSON
def summary(values: Floats) -> Summary:
    """Summarise one sample."""
    values = np.asarray(values, dtype=np.float64)
    mean = float(values.mean())
    if len(values) < 2:
        return Summary(mean, None, len(values), None)
    # The mean of equal numbers may be off by a bit, and their deviation then be more than nothing.
    sd = 0.0 if _constant(values) else float(values.std(ddof=1))
    return Summary(mean, sd, len(values), _interval(np.mean, values))


@np.errstate(all="ignore")
def compare(first: Floats, second: Floats, *, paired: bool = True) -> Comparison:
    """Compare two samples.

    What the samples cannot say is None: below two trials everything but difference and ratio, where neither sample
    varies both tests, and where all differences are equal their interval and the paired test.

    Parameters
    ----------
    first, second
        A value per trial.
    paired
        Whether the values go together: the same trials, with the same seeds, in the same order.

    Raises
    ------
    ValueError
        The samples are not of the same length.
    """
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if len(first) != len(second):
        raise ValueError(f"trials are compared in pairs; here are {len(first)} and {len(second)}")
    difference = float(second.mean() - first.mean())
    here, there = float(first.mean()), float(second.mean())
    ratio: float | None = there / here if here * there > 0 else None
    if ratio is not None and not math.isfinite(ratio):  # of a mean that is as good as zero
        ratio = None
    found = Comparison(difference, ratio=ratio)
    if len(first) < 2 or (_constant(first) and _constant(second)):
        return found
    found = _welch(found, first, second)
    if ratio is not None:
        found = found._replace(ratio_interval=_interval(_ratio, first, second, paired=paired))
    if not paired:
        return found._replace(interval=_interval(_difference, first, second, paired=False))
    return _paired(found, first, second)


def of_few(trials: int) -> str | None:
    """Say what is to be said of intervals and tests of so few trials; None where they are not few.

    >>> of_few(10)
    """
    if not 1 < trials < FEW:
        return None
    return (
        f"{trials} trials are few: intervals of fewer than {FEW} come out too narrow, and tests rest on a normal\n"
        "distribution that nobody has seen. Give more --trials before anything is claimed."
    )


def _welch(found: Comparison, first: Floats, second: Floats) -> Comparison:
    from scipy import stats

    n = len(first)
    var1, var2 = (0.0 if _constant(sample) else float(sample.var(ddof=1)) for sample in (first, second))
    error = (var1 + var2) / n
    if error == 0:
        return found
    # By hand: SciPy's own warns of every constant sample, and a deterministic agent gives one.
    t = found.difference / math.sqrt(error)
    share = var1 / n / error
    df = (n - 1) / (share**2 + (1.0 - share) ** 2)
    small = 1.0 - 3.0 / (8.0 * n - 9.0)
    return found._replace(
        hedges_g=small * found.difference / math.sqrt(error * n / 2),
        t=t,
        df=df,
        p=float(2.0 * stats.t.sf(abs(t), df)),
    )


def _paired(found: Comparison, first: Floats, second: Floats) -> Comparison:
    from scipy import stats

    differences = second - first
    # Differences that are equal but for their rounding would give a t of 1e15.
    rounding = 4 * np.finfo(np.float64).eps * max(np.abs(first).max(), np.abs(second).max())
    n, sd = len(differences), float(differences.std(ddof=1))
    if not np.ptp(differences) > rounding or sd == 0:
        return found
    effect = float(differences.mean()) / sd
    t = effect * math.sqrt(n)
    return found._replace(
        interval=_interval(_difference, first, second),
        paired_effect=effect,
        paired_t=t,
        paired_df=float(n - 1),
        paired_p=float(2.0 * stats.t.sf(abs(t), n - 1)),
    )


def holm(p_values: list[float | None]) -> list[float | None]:
    """Correct p-values for their number by Holm's method; what is None, or no finite number, comes back as None.

    >>> holm([0.01, None, 0.04])
    [0.02, None, 0.04]
    """
    order = sorted((p, i) for i, p in enumerate(p_values) if p is not None and math.isfinite(p))
    corrected: list[float | None] = [None] * len(p_values)
    running = 0.0
    for rank, (p, i) in enumerate(order):
        running = max(running, min(1.0, p * (len(order) - rank)))
        corrected[i] = running
    return corrected


def finite(data: Any) -> Any:
    """Make data fit for JSON: tuples to lists, NumPy numbers to Python's, what is not finite to None."""
    if isinstance(data, dict):
        return {str(key): finite(value) for key, value in data.items()}
    if isinstance(data, (list, tuple, np.ndarray)):
        return [finite(value) for value in data]
    if isinstance(data, np.generic):
        data = data.item()
    return None if isinstance(data, float) and not math.isfinite(data) else data


def _constant(sample: Floats) -> bool:
    return bool(sample.min() == sample.max())


def _difference(first: Floats, second: Floats, axis: int = -1) -> Any:
    return np.mean(second, axis=axis) - np.mean(first, axis=axis)


def _ratio(first: Floats, second: Floats, axis: int = -1) -> Any:
    return np.mean(second, axis=axis) / np.mean(first, axis=axis)


def _interval(statistic: Callable[..., Any], *samples: Floats, paired: bool = True) -> tuple[float, float] | None:
    """Return the 95 % bootstrap interval; several samples that are paired are drawn with the same indices."""
    from scipy import stats

    if all(_constant(sample) for sample in samples):
        value = float(statistic(*samples))
        return value, value
    # Bias-corrected where the sample is small enough for its jackknife; a large one needs no correction.
    method = "BCa" if len(samples[0]) <= 2000 else "percentile"
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # What it warns of comes back as a number that is not finite, and leaves here as None.
        warnings.simplefilter("ignore")
        found = stats.bootstrap(
            samples,
            statistic,
            n_resamples=RESAMPLES,
            paired=paired and len(samples) > 1,
            method=method,
            vectorized=True,
            batch=500,
            rng=np.random.default_rng(0),
        ).confidence_interval
    low, high = float(found.low), float(found.high)
    return (low, high) if math.isfinite(low) and math.isfinite(high) else None
