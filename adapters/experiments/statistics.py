"""Statistics of samples over trials: intervals and effect sizes first, p-values beside them.

With a thousand trials every p is tiny; what a reader needs is how large a difference is, and how sure.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
RESAMPLES = 4999


class Summary(NamedTuple):
    """Mean, standard deviation (n - 1), number, and 95 % bootstrap interval of the mean (None below 2 values)."""

    mean: float
    sd: float | None
    n: int
    interval: tuple[float, float] | None


class Comparison(NamedTuple):
    """Second sample against the first.

    Attributes
    ----------
    difference : mean of the second minus mean of the first.
    interval : 95 % bootstrap interval of it.
    ratio, ratio_interval : mean of the second over mean of the first; None where that says nothing.
    hedges_g : difference in units of the pooled standard deviation, corrected for small samples.
    t, df, p : Welch's t-test.
    """

    difference: float
    interval: tuple[float, float] | None
    ratio: float | None
    ratio_interval: tuple[float, float] | None
    hedges_g: float | None
    t: float | None
    df: float | None
    p: float | None


def summary(values: Floats) -> Summary:
    """Summarise one sample."""
    values = np.asarray(values, dtype=np.float64)
    mean = float(values.mean())
    if len(values) < 2:
        return Summary(mean, None, len(values), None)
    return Summary(mean, float(values.std(ddof=1)), len(values), _interval(np.mean, values))


def compare(first: Floats, second: Floats) -> Comparison:
    """Compare two samples of independent trials."""
    from scipy import stats

    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    difference = float(second.mean() - first.mean())
    ratio = float(second.mean() / first.mean()) if first.mean() * second.mean() > 0 else None
    if min(len(first), len(second)) < 2 or (first.std() == 0 and second.std() == 0):
        return Comparison(difference, None, ratio, None, None, None, None, None)
    welch = stats.ttest_ind(second, first, equal_var=False)
    n1, n2 = len(first), len(second)
    pooled = math.sqrt(((n1 - 1) * first.var(ddof=1) + (n2 - 1) * second.var(ddof=1)) / (n1 + n2 - 2))
    small = 1.0 - 3.0 / (4.0 * (n1 + n2) - 9.0)
    return Comparison(
        difference,
        _interval(_difference, first, second),
        ratio,
        _interval(_ratio, first, second) if ratio is not None else None,
        small * difference / pooled,
        float(welch.statistic),
        float(welch.df),
        float(welch.pvalue),
    )


def holm(p_values: list[float | None]) -> list[float | None]:
    """Correct p-values for their number by Holm's method; None stays None.

    >>> holm([0.01, None, 0.04])
    [0.02, None, 0.04]
    """
    order = sorted((p, i) for i, p in enumerate(p_values) if p is not None)
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


def _difference(first: Floats, second: Floats, axis: int = -1) -> Any:
    return np.mean(second, axis=axis) - np.mean(first, axis=axis)


def _ratio(first: Floats, second: Floats, axis: int = -1) -> Any:
    return np.mean(second, axis=axis) / np.mean(first, axis=axis)


def _interval(statistic: Callable[..., Any], *samples: Floats) -> tuple[float, float] | None:
    from scipy import stats

    if all(sample.std() == 0 for sample in samples):
        value = float(statistic(*samples))
        return value, value
    # Bias-corrected where the sample is small enough for its jackknife; a large one needs no correction.
    method = "BCa" if max(len(sample) for sample in samples) <= 2000 and all(s.std() > 0 for s in samples) else "percentile"
    found = stats.bootstrap(
        samples, statistic, n_resamples=RESAMPLES, method=method, vectorized=True, batch=500, rng=np.random.default_rng(0)
    ).confidence_interval
    low, high = float(found.low), float(found.high)
    return (low, high) if math.isfinite(low) and math.isfinite(high) else None
