"""Confidence intervals for what an evaluation measures.

Distances and returns get a percentile bootstrap of the mean: B. Efron, "Bootstrap methods: another look at
the jackknife", Annals of Statistics 7 (1979); Efron & Tibshirani, "An Introduction to the Bootstrap" (1993),
chapter 13. It assumes nothing about their shape.

Success rates get the score interval: E. B. Wilson, "Probable inference, the law of succession, and
statistical inference", JASA 22 (1927). Near 0 and 1, where a bootstrap or mean ± 2σ collapses to a point,
it keeps its coverage: Brown, Cai & DasGupta, "Interval estimation for a binomial proportion", Statistical
Science 16 (2001).
"""

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from franka_wm.errors import UserError

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
    values: Tensor | NDArray[np.floating] | Sequence[float],
    confidence: float = 0.95,
    resamples: int = 10_000,
    seed: int = 0,
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
    _check_confidence(confidence)
    if resamples < 100:
        raise UserError(
            f"resamples is {resamples}; at least 100 are needed for an interval, 10000 are usual."
        )
    sample = np.asarray(values.detach().cpu() if isinstance(values, Tensor) else values, dtype=np.float64)
    if sample.ndim != 1 or sample.size == 0:
        raise UserError(f"values have shape {sample.shape}; give a vector with one value per episode.")
    if not np.isfinite(sample).all():
        bad = int((~np.isfinite(sample)).sum())
        raise UserError(f"{bad} of {sample.size} values are not finite; a mean over the rest would mislead.")

    generator = np.random.default_rng(seed)
    means = np.empty(resamples)
    rows = max(1, _DRAWN_AT_ONCE // sample.size)
    for start in range(0, resamples, rows):
        count = min(rows, resamples - start)
        drawn = generator.integers(sample.size, size=(count, sample.size))
        means[start : start + count] = sample[drawn].mean(axis=1)
    tail = (1 - confidence) / 2
    low, high = np.quantile(means, (tail, 1 - tail))
    mean = float(sample.mean())
    # Equal values, summed in another order, may differ in the last bit.
    return Interval(mean, min(float(low), mean), max(float(high), mean))


def bootstrap_ratio(
    numerators: Tensor | NDArray[np.floating] | Sequence[float],
    denominators: Tensor | NDArray[np.floating] | Sequence[float],
    confidence: float = 0.95,
    resamples: int = 2_000,
    seed: int = 0,
) -> Interval:
    """Ratio of two means, with its percentile bootstrap interval; pairs are drawn together.

    Deterministic. The `mean` is Σ numerators / Σ denominators, not the mean of ratios, which a single small
    denominator would rule.

    Args:
        numerators, denominators: (n,) one pair per independent unit (an episode); denominators ≥ 0, their
            sum above 0.
        confidence, resamples, seed: as for `bootstrap_mean`.

    Raises:
        UserError: other shapes, values that are not finite, denominators that sum to 0, or a parameter out of
            range.
    """
    _check_confidence(confidence)
    if resamples < 100:
        raise UserError(f"resamples is {resamples}; at least 100 are needed for an interval.")
    top, bottom = (np.asarray(x, dtype=np.float64) for x in (numerators, denominators))
    if top.ndim != 1 or top.shape != bottom.shape or top.size == 0:
        raise UserError(f"shapes are {top.shape} and {bottom.shape}; one pair per unit is needed, (n,) each.")
    if not (np.isfinite(top).all() and np.isfinite(bottom).all()):
        raise UserError("a ratio needs finite values; leave out or repair what is not.")
    if bottom.min() < 0 or bottom.sum() <= 0:
        raise UserError("a ratio needs denominators of at least 0 that do not sum to 0.")
    drawn = np.random.default_rng(seed).integers(top.size, size=(resamples, top.size))
    below = bottom[drawn].sum(axis=1)
    ratios = top[drawn].sum(axis=1)[below > 0] / below[below > 0]
    tail = (1 - confidence) / 2
    low, high = np.quantile(ratios, (tail, 1 - tail))
    ratio = float(top.sum() / bottom.sum())
    return Interval(ratio, min(float(low), ratio), max(float(high), ratio))


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
    _check_confidence(confidence)
    if n < 1 or not 0 <= successes <= n:
        raise UserError(f"{successes} successes in {n} episodes; needed are n ≥ 1 and 0 ≤ successes ≤ n.")
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    rate = successes / n
    shrink = 1 + z * z / n
    centre = (rate + z * z / (2 * n)) / shrink
    half = z / shrink * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    # Exact at the ends, where rounding would leave 1e-17 outside of [0, rate] or [rate, 1].
    low = 0.0 if successes == 0 else centre - half
    high = 1.0 if successes == n else centre + half
    return Interval(rate, low, high)


def _check_confidence(confidence: float) -> None:
    if not 0 < confidence < 1:
        raise UserError(f"confidence is {confidence}; it must lie between 0 and 1, 0.95 is usual.")
