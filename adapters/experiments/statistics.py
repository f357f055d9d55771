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
def compare(first: Floats, second: Floats) -> Comparison:
    """Compare two samples of independent trials."""
    from scipy import stats

    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    difference = float(second.mean() - first.mean())
    ratio = float(second.mean() / first.mean()) if first.mean() * second.mean() > 0 else None
    n1, n2 = len(first), len(second)
    if min(n1, n2) < 2:
        return Comparison(difference, None, ratio, None, None, None, None, None)
    var1, var2 = (0.0 if _constant(sample) else float(sample.var(ddof=1)) for sample in (first, second))
    error = var1 / n1 + var2 / n2
    if error == 0:
        return Comparison(difference, None, ratio, None, None, None, None, None)
    # By hand: SciPy's own warns of every constant sample, and a deterministic agent gives one.
    t = difference / math.sqrt(error)
    share = var1 / n1 / error
    df = 1.0 / (share**2 / (n1 - 1) + (1.0 - share) ** 2 / (n2 - 1))
    pooled = math.sqrt(((n1 - 1) * var1 + (n2 - 1) * var2) / (n1 + n2 - 2))
    small = 1.0 - 3.0 / (4.0 * (n1 + n2) - 9.0)
    return Comparison(
        difference,
        _interval(_difference, first, second),
        ratio,
        _interval(_ratio, first, second) if ratio is not None else None,
        small * difference / pooled,
        t,
        df,
        float(2.0 * stats.t.sf(abs(t), df)),
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


def _constant(sample: Floats) -> bool:
    return bool(sample.min() == sample.max())


def _difference(first: Floats, second: Floats, axis: int = -1) -> Any:
    return np.mean(second, axis=axis) - np.mean(first, axis=axis)


def _ratio(first: Floats, second: Floats, axis: int = -1) -> Any:
    return np.mean(second, axis=axis) / np.mean(first, axis=axis)


def _interval(statistic: Callable[..., Any], *samples: Floats) -> tuple[float, float] | None:
    from scipy import stats

    constant = [_constant(sample) for sample in samples]
    if all(constant):
        value = float(statistic(*samples))
        return value, value
    # Bias-corrected where the sample is small enough for its jackknife; a large one needs no correction.
    method = "BCa" if max(len(sample) for sample in samples) <= 2000 and not any(constant) else "percentile"
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # What it warns of comes back as a number that is not finite, and leaves here as None.
        warnings.simplefilter("ignore")
        found = stats.bootstrap(
            samples,
            statistic,
            n_resamples=RESAMPLES,
            method=method,
            vectorized=True,
            batch=500,
            rng=np.random.default_rng(0),
        ).confidence_interval
    low, high = float(found.low), float(found.high)
    return (low, high) if math.isfinite(low) and math.isfinite(high) else None
