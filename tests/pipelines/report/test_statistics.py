"""The statistics of tables, against scipy's bootstrap, numbers worked out by hand, and what they are defined as."""

import numpy as np
import pytest
from scipy import stats

from pipelines.report.statistics import (
    difference_interval,
    interquartile_mean,
    mean_interval,
    paired_difference,
    probability_of_improvement,
)


def test_an_interval_of_the_mean_is_students():
    values = [3.0, 1.0, 4.0, 1.0, 5.0]  # mean 2.8, standard error sqrt(3.2 / 5) = .8
    assert mean_interval(values) == pytest.approx((2.8 - 2.7764451 * 0.8, 2.8 + 2.7764451 * 0.8))
    assert mean_interval([*values, np.nan]) == mean_interval(values)
    assert np.isnan(mean_interval(values[:4])).all() and np.isnan(mean_interval([np.nan] * 9)).all()
    assert mean_interval([2.0] * 5) == (2.0, 2.0)


def test_intervals_are_near_scipys_bootstrap_and_cover_the_mean():
    generator = np.random.default_rng(0)
    values = generator.normal(10.0, 3.0, 100)
    other = stats.bootstrap((values,), np.mean, method="BCa", random_state=generator).confidence_interval
    assert mean_interval(values) == pytest.approx((other.low, other.high), abs=0.1)
    covered = 0
    for _ in range(400):
        low, high = mean_interval(generator.normal(size=5))
        covered += low <= 0.0 <= high
    assert 0.92 < covered / 400 < 0.98  # the percentile bootstrap of five values covers some 83 %


def test_the_interquartile_mean_leaves_a_quarter_out_at_either_end():
    assert interquartile_mean([100.0, 1.0, 2.0, 3.0, -100.0]) == 2.0
    assert interquartile_mean([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 99.0]) == 3.5
    assert interquartile_mean([7.0, 9.0]) == 8.0 and np.isnan(interquartile_mean([]))


def test_a_difference_of_runs_is_welchs():
    ours, theirs = np.array([1.0, 2.0, 3.0, 4.0, 5.0]), np.array([0.0, 0.0, 3.0, 3.0, 9.0, 9.0])
    low, high = difference_interval(ours, theirs)
    variances = ours.var(ddof=1) / 5, theirs.var(ddof=1) / 6
    degrees = sum(variances) ** 2 / (variances[0] ** 2 / 4 + variances[1] ** 2 / 5)
    half = stats.t.ppf(0.975, degrees) * np.sqrt(sum(variances))
    assert (low, high) == pytest.approx((-1.0 - half, -1.0 + half))
    assert np.isnan(difference_interval(ours[:4], theirs)).all()
    assert difference_interval([2.0] * 5, [1.0] * 5) == (1.0, 1.0)


def test_the_probability_of_improvement_counts_pairs():
    ours, theirs = [1.0, 3.0, 5.0], [2.0, 3.0]
    pairs = [(a > b) + (a == b) / 2 for a in ours for b in theirs]
    assert probability_of_improvement(ours, theirs) == pytest.approx(np.mean(pairs))
    assert probability_of_improvement(theirs, ours) == pytest.approx(1 - np.mean(pairs))
    assert np.isnan(probability_of_improvement([], theirs))


def test_pairing_takes_out_what_a_start_is_worth():
    starts = np.random.default_rng(1).normal(0.0, 200.0, 100)
    ours, theirs = np.stack((starts + 2.0, starts + 4.0)), starts[None] + np.tile([0.0, 2.0], 50)
    difference, (low, high) = paired_difference(ours, theirs)
    assert difference == pytest.approx(2.0)
    assert (low, high) == pytest.approx((2.0 - 0.199412, 2.0 + 0.199412), abs=1e-4)
    with pytest.raises(ValueError, match="100 starts of ours, 99 of theirs"):
        paired_difference(ours, theirs[:, :99])
