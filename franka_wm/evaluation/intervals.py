"""Confidence intervals for what an evaluation measures, computed by SciPy.

Distances and returns get a percentile bootstrap of the mean: B. Efron, "Bootstrap methods: another look at
the jackknife", Annals of Statistics 7 (1979); Efron & Tibshirani, "An Introduction to the Bootstrap" (1993),
chapter 13. It assumes nothing about their shape.

Success rates get the score interval: E. B. Wilson, "Probable inference, the law of succession, and
statistical inference", JASA 22 (1927). Near 0 and 1, where a bootstrap or mean ± 2σ collapses to a point,
it keeps its coverage: Brown, Cai & DasGupta, "Interval estimation for a binomial proportion", Statistical
Science 16 (2001).
"""

import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from franka_wm.errors import UserError

if TYPE_CHECKING:  # a table over seeds need not wait for torch
    from torch import Tensor

type Values = Tensor | NDArray[np.floating] | Sequence[float]

# Values drawn at a time: bounds the memory at some 32 MB, whatever the number of episodes.
_DRAWN_AT_ONCE = 2_000_000


class Interval(NamedTuple):
    """An estimate and the bounds of its confidence interval, all in the unit of what was measured."""

    mean: float
    low: float
    high: float

    def as_dict(self) -> dict[str, float]:
        """`{"mean": …, "low": …, "high": …}`, as in `evaluation.json`."""
        return self._asdict()


def bootstrap_mean(
    values: Values, confidence: float = 0.95, resamples: int = 10_000, seed: int = 0
) -> Interval:
    """Mean of independent values, with its percentile bootstrap interval.

    Deterministic: the same input gives the same output.

    Args:
        values: (n,) one value per episode, n ≥ 1. A single value has no spread: low = mean = high.
        confidence: probability with which the interval should hold the true mean, in (0, 1).
        resamples: number of bootstrap samples, at least 100.
        seed: of the resampling.

    Raises:
        UserError: no values, non-finite ones, not one per episode, or a parameter out of range.
    """
    (sample,) = _samples(values)
    return _bootstrap((sample,), np.mean, float(sample.mean()), confidence, resamples, seed)


def bootstrap_ratio(
    numerators: Values,
    denominators: Values,
    confidence: float = 0.95,
    resamples: int = 2_000,
    seed: int = 0,
) -> Interval:
    """Ratio of two means, with its percentile bootstrap interval; pairs are drawn together.

    Deterministic. The `mean` is Σ numerators / Σ denominators, not the mean of ratios, which a single small
    denominator would rule. Bootstrap samples whose denominators sum to 0 are left out.

    Args:
        numerators, denominators: (n,) one pair per independent unit (an episode); denominators ≥ 0, their
            sum above 0.
        confidence, resamples, seed: as for `bootstrap_mean`.

    Raises:
        UserError: other shapes, values that are not finite, denominators that sum to 0, or a parameter out of
            range.
    """
    top, bottom = _samples(numerators, denominators)
    if bottom.min() < 0 or bottom.sum() <= 0:
        raise UserError("a ratio needs denominators of at least 0 that do not sum to 0.")

    def ratio(above: NDArray, below: NDArray, axis: int = -1) -> NDArray:
        sums = below.sum(axis)
        return np.divide(above.sum(axis), sums, out=np.full_like(sums, np.nan), where=sums > 0)

    estimate = float(top.sum() / bottom.sum())
    return _bootstrap((top, bottom), ratio, estimate, confidence, resamples, seed)


def wilson(successes: int, n: int, confidence: float = 0.95) -> Interval:
    """Success rate with its Wilson score interval.

    Args:
        successes: how many of the n episodes succeeded, 0 … n.
        n: independent episodes, at least 1.
        confidence: probability with which the interval should hold the true rate, in (0, 1).

    Returns:
        Rates in [0, 1]; `mean` is `successes / n`, not the interval's centre.

    Raises:
        UserError: counts or confidence out of range.
    """
    from scipy.stats import binomtest

    _check_confidence(confidence)
    if n < 1 or not 0 <= successes <= n:
        raise UserError(f"{successes} successes in {n} episodes; needed are n ≥ 1 and 0 ≤ successes ≤ n.")
    bounds = binomtest(successes, n).proportion_ci(confidence, method="wilson")
    return Interval(successes / n, float(bounds.low), float(bounds.high))


def _bootstrap(
    samples: tuple[NDArray, ...],
    statistic: Callable[..., NDArray],
    estimate: float,
    confidence: float,
    resamples: int,
    seed: int,
) -> Interval:
    """Percentile bootstrap of a statistic of paired samples, each (n,), that are finite."""
    from scipy.stats import DegenerateDataWarning, bootstrap

    _check_confidence(confidence)
    if resamples < 100:
        raise UserError(f"resamples is {resamples}; at least 100 are needed, 10000 are usual.")
    size = samples[0].size
    if size == 1:
        return Interval(estimate, estimate, estimate)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DegenerateDataWarning)  # of its own interval, which is not used
        found = bootstrap(
            samples,
            statistic,
            n_resamples=resamples,
            batch=max(1, _DRAWN_AT_ONCE // size),
            vectorized=True,
            paired=True,
            method="percentile",
            rng=np.random.default_rng(seed),
        ).bootstrap_distribution
    tail = (1 - confidence) / 2
    low, high = np.nanquantile(found, (tail, 1 - tail))  # NaN: a ratio without anything below
    # Equal values, summed in another order, may differ in the last bit.
    return Interval(estimate, min(float(low), estimate), max(float(high), estimate))


def _samples(*values: Values) -> list[NDArray[np.float64]]:
    """Vectors of one length, finite; otherwise a `UserError`."""
    found = [
        np.asarray(x.cpu() if hasattr(x, "cpu") else x, dtype=np.float64)  # pyright: ignore[reportAttributeAccessIssue]
        for x in values
    ]
    shapes = [x.shape for x in found]
    if found[0].ndim != 1 or found[0].size == 0 or len(set(shapes)) > 1:
        raise UserError(f"values have shape {shapes}; give vectors of one length, one value per episode.")
    if bad := sum(int((~np.isfinite(x)).sum()) for x in found):
        raise UserError(f"{bad} of {sum(x.size for x in found)} values are not finite; find out why first.")
    return found


def _check_confidence(confidence: float) -> None:
    if not 0 < confidence < 1:
        raise UserError(f"confidence is {confidence}; it must lie between 0 and 1, 0.95 is usual.")


def scaled(value: float, scale: float, digits: int) -> str:
    """``scale * value`` with so many decimals; a rate [%] without any, unless it would be taken for all or none."""
    return percent(scale * value) if (scale, digits) == (100, 0) else f"{scale * value:z.{digits}f}"


def percent(rate: float) -> str:
    """A rate [%] without decimals, unless it would be taken for all or none."""
    if 99.5 <= rate < 100 - 1e-9:
        return f"{min(rate, 99.9):.1f}"
    return f"{max(rate, 0.1):.1f}" if 1e-9 < rate <= 0.5 else f"{rate:z.0f}"
