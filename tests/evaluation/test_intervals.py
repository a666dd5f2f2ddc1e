"""Intervals: against published values, exact tail probabilities, and their own promise of coverage."""

import math
from statistics import NormalDist

import numpy as np
import pytest
import torch

from franka_wm.errors import UserError
from franka_wm.evaluation.intervals import Interval, bootstrap_mean, bootstrap_ratio, wilson


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [
        (81, 263, 0.2553, 0.3662),  # Newcombe, Statistics in Medicine 17 (1998), table I, method 3
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0000, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_matches_newcombes_table(successes: int, n: int, low: float, high: float) -> None:
    interval = wilson(successes, n)
    assert interval.mean == successes / n
    assert interval.low == pytest.approx(low, abs=5.1e-5)
    assert interval.high == pytest.approx(high, abs=5.1e-5)


def test_wilson_bounds_are_where_the_score_test_changes_its_mind() -> None:
    # The definition: a bound p satisfies |rate - p| = z sqrt(p (1 - p) / n).
    z = NormalDist().inv_cdf(0.95)
    interval = wilson(50, 64, confidence=0.9)
    for bound in (interval.low, interval.high):
        assert abs(50 / 64 - bound) == pytest.approx(z * math.sqrt(bound * (1 - bound) / 64))


@pytest.mark.parametrize("n", [1, 7, 64])
def test_wilson_stays_within_0_and_1_and_is_symmetric(n: int) -> None:
    for successes in range(n + 1):
        interval, mirrored = wilson(successes, n), wilson(n - successes, n)
        assert 0 <= interval.low <= interval.mean <= interval.high <= 1
        assert interval.low == pytest.approx(1 - mirrored.high)
    assert wilson(0, n).low == 0
    assert wilson(0, n).high > 0
    assert wilson(n, n).high == 1


def test_bootstrap_holds_the_true_mean_as_often_as_it_says() -> None:
    # Skewed, as distances are. 400 experiments of 64 episodes: the standard error of the coverage is 1.1 %.
    draws = np.random.default_rng(1).gamma(2.0, 0.02, size=(400, 64))
    covered = 0
    for seed, values in enumerate(draws):
        interval = bootstrap_mean(values, confidence=0.9, resamples=500, seed=seed)
        covered += interval.low <= 0.04 <= interval.high
    assert 0.85 <= covered / 400 <= 0.94


def test_bootstrap_agrees_with_normal_theory_for_many_values() -> None:
    values = torch.from_numpy(np.random.default_rng(2).normal(3.0, 2.0, size=2000))
    interval = bootstrap_mean(values)
    half = 1.96 * float(values.std()) / math.sqrt(2000)
    assert interval.mean == pytest.approx(float(values.mean()))
    assert interval.high - interval.mean == pytest.approx(half, rel=0.05)
    assert interval.mean - interval.low == pytest.approx(half, rel=0.05)


def test_bootstrap_is_deterministic_and_its_seed_matters() -> None:
    values = [0.1, 0.4, 0.2, 0.9, 0.35]
    assert bootstrap_mean(values) == bootstrap_mean(values)
    assert bootstrap_mean(values, resamples=200) != bootstrap_mean(values, resamples=200, seed=1)
    assert bootstrap_mean(values, confidence=0.5).high < bootstrap_mean(values, confidence=0.99).high


def test_bootstrap_in_pieces_is_the_bootstrap_in_one_go(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.linspace(0, 1, 50)
    whole = bootstrap_mean(values, resamples=1000)
    monkeypatch.setattr("franka_wm.evaluation.intervals._DRAWN_AT_ONCE", 50 * 7)
    assert bootstrap_mean(values, resamples=1000) == whole


def test_equal_values_have_an_interval_of_no_width_around_themselves() -> None:
    for values in ([0.1] * 37, [2.5]):
        interval = bootstrap_mean(values)
        assert interval.low == pytest.approx(interval.mean, abs=1e-12)
        assert interval.high == pytest.approx(interval.mean, abs=1e-12)
        assert interval.low <= interval.mean <= interval.high


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: bootstrap_mean([]), "one value per episode"),
        (lambda: bootstrap_mean(torch.zeros(3, 2)), "one value per episode"),
        (lambda: bootstrap_mean([1.0, math.nan]), "1 of 2 values are not finite"),
        (lambda: bootstrap_mean([1.0], confidence=1.0), "between 0 and 1"),
        (lambda: bootstrap_mean([1.0], confidence=0.0), "between 0 and 1"),
        (lambda: bootstrap_mean([1.0], resamples=99), "at least 100"),
        (lambda: bootstrap_ratio([1.0], [1.0], resamples=99), "at least 100"),
        (lambda: bootstrap_ratio([1.0], [1.0], confidence=0.0), "between 0 and 1"),
        (lambda: bootstrap_ratio([1.0, 2.0], [1.0]), "one length, one value per episode"),
        (lambda: bootstrap_ratio([[1.0, 2.0]], [[1.0, 2.0]]), "one length, one value per episode"),
        (lambda: bootstrap_ratio([], []), "one length, one value per episode"),
        (lambda: bootstrap_ratio([math.nan], [1.0]), "of 2 values are not finite"),
        (lambda: bootstrap_ratio([1.0], [math.inf]), "of 2 values are not finite"),
        (lambda: bootstrap_ratio([1.0, 1.0], [3.0, -1.0]), "at least 0"),
        (lambda: bootstrap_ratio([1.0, 1.0], [0.0, 0.0]), "do not sum to 0"),
        (lambda: wilson(0, 0), "0 successes in 0 episodes"),
        (lambda: wilson(5, 4), "5 successes in 4"),
        (lambda: wilson(-1, 4), "-1 successes"),
        (lambda: wilson(1, 4, confidence=95), "between 0 and 1"),
    ],
)
def test_bad_input_is_refused(call, says: str) -> None:
    with pytest.raises(UserError, match=says):
        call()


def test_a_ratio_to_ones_is_a_mean() -> None:
    values = np.random.default_rng(3).gamma(2.0, 0.02, size=40)
    ratio, mean = bootstrap_ratio(values, np.ones(40)), bootstrap_mean(values, resamples=2000)
    assert ratio == pytest.approx(mean)
    assert bootstrap_ratio(values, np.full(40, 0.25)) == pytest.approx([4 * x for x in mean])


def test_a_ratio_is_that_of_sums_and_pairs_stay_together() -> None:
    below = np.random.default_rng(4).gamma(2.0, 0.1, size=30)
    assert bootstrap_ratio(3 * below, below) == pytest.approx((3.0, 3.0, 3.0))
    assert bootstrap_ratio([1.0, 2.0, 6.0], [2.0, 1.0, 3.0]).mean == pytest.approx(9 / 6)
    assert bootstrap_ratio([3.0], [4.0]) == pytest.approx((0.75, 0.75, 0.75))
    assert bootstrap_ratio([0.1, 0.2], [0.2, 0.4]) == pytest.approx((0.5, 0.5, 0.5))


def test_the_interval_of_a_ratio_agrees_with_the_delta_method() -> None:
    generator = np.random.default_rng(5)
    below = generator.gamma(4.0, 0.05, size=2000)
    above = 2 * below + generator.normal(0.5, 0.1, size=2000)
    for confidence in (0.95, 0.5):
        ratio = bootstrap_ratio(above, below, confidence=confidence)
        rest = above - ratio.mean * below
        half = NormalDist().inv_cdf((1 + confidence) / 2) * rest.std() / below.mean() / math.sqrt(2000)
        assert ratio.high - ratio.mean == pytest.approx(half, rel=0.08)
        assert ratio.mean - ratio.low == pytest.approx(half, rel=0.08)


def test_samples_without_anything_below_are_left_out_of_a_ratio() -> None:
    ratio = bootstrap_ratio(
        [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]
    )  # every third sample or so is of the last two alone
    assert ratio == pytest.approx((0.5, 0.5, 0.5))


def test_what_is_not_said_is_the_usual() -> None:
    values = np.random.default_rng(6).normal(1.0, 1.0, size=25)
    assert bootstrap_mean(values) == bootstrap_mean(values, confidence=0.95, resamples=10_000, seed=0)
    ones = np.ones(25)
    usual = bootstrap_ratio(values, ones, confidence=0.95, resamples=2_000, seed=0)
    assert bootstrap_ratio(values, ones) == usual
    assert wilson(3, 7) == wilson(3, 7, confidence=0.95)
    assert bootstrap_mean(values, resamples=100).low < bootstrap_mean(values, resamples=100).high
    assert bootstrap_ratio(values, ones, resamples=100).low < 1 < bootstrap_ratio(values + 1, ones).high


def test_as_dict_is_what_evaluation_json_holds() -> None:
    assert Interval(1.0, 0.5, 2.0).as_dict() == {"mean": 1.0, "low": 0.5, "high": 2.0}
