"""The statistics of tables, against scipy's bootstrap, numbers worked out by hand, and what they are defined as."""

import numpy as np
import pytest
from scipy import stats
from sklearn.metrics import roc_auc_score

from pipelines.report.statistics import (
    ResampledAreas,
    difference_interval,
    holm,
    interquartile_mean,
    mean_interval,
    paired_difference,
    performance_profile,
    probability_of_improvement,
    profile_band,
    resplit_interval,
    stratified_iqm,
    welch_p_value,
)


def test_an_interval_of_the_mean_is_students():
    values = [3.0, 1.0, 4.0, 1.0, 5.0]  # mean 2.8, standard error sqrt(3.2 / 5) = .8
    assert mean_interval(values) == pytest.approx((2.8 - 2.7764451 * 0.8, 2.8 + 2.7764451 * 0.8))
    assert mean_interval([*values, np.nan]) == mean_interval(values)
    assert np.isnan(mean_interval(values[:4])).all() and np.isnan(mean_interval([np.nan] * 9)).all()
    assert np.isnan(mean_interval([2.0] * 5)).all()
    assert resplit_interval(values, 0.0) == pytest.approx(mean_interval(values))
    low, high = resplit_interval(values, 1 / 4)  # 100 test rows and 400 training rows: the error is 1.5 times as large
    assert (low, high) == pytest.approx((2.8 - 1.5 * 2.7764451 * 0.8, 2.8 + 1.5 * 2.7764451 * 0.8))
    assert np.isnan(resplit_interval(values[:4], 1 / 9)).all()


def test_worked_means_probabilities_and_profiles():
    """The interquartile mean leaves a quarter out at both ends; a profile is the mean over tasks of the share above."""
    assert interquartile_mean([100.0, 1.0, 2.0, 3.0, -100.0]) == 2.0
    assert interquartile_mean([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 99.0]) == 3.5
    assert interquartile_mean([7.0, 9.0]) == 8.0 and np.isnan(interquartile_mean([]))
    ours, theirs = [1.0, 3.0, 5.0], [2.0, 3.0]
    pairs = [(a > b) + (a == b) / 2 for a in ours for b in theirs]
    assert probability_of_improvement(ours, theirs) == pytest.approx(np.mean(pairs))
    assert probability_of_improvement(theirs, ours) == pytest.approx(1 - np.mean(pairs))
    assert np.isnan(probability_of_improvement([], theirs))
    scores = [[0.0, 0.5, 1.0, 1.0], [0.5]]  # the one run of the second task weighs as much as the first's four
    assert performance_profile(scores, [-1.0, 0.0, 0.5, 0.75, 1.0]).tolist() == [1.0, 0.875, 0.25, 0.25, 0.0]


def test_a_difference_of_runs_is_welchs():
    ours, theirs = np.array([1.0, 2.0, 3.0, 4.0, 5.0]), np.array([0.0, 0.0, 3.0, 3.0, 9.0, 9.0])
    low, high = difference_interval(ours, theirs)
    variances = ours.var(ddof=1) / 5, theirs.var(ddof=1) / 6
    degrees = sum(variances) ** 2 / (variances[0] ** 2 / 4 + variances[1] ** 2 / 5)
    half = stats.t.ppf(0.975, degrees) * np.sqrt(sum(variances))
    assert (low, high) == pytest.approx((-1.0 - half, -1.0 + half))
    assert np.isnan(difference_interval(ours[:4], theirs)).all()
    assert difference_interval([2.0] * 5, [1.0] * 5) == (1.0, 1.0)


def test_p_values_are_welchs_and_holms():
    ours, theirs = (4062.5, 205.7, 5), (4829.4, 338.9, 10)
    expected = stats.ttest_ind_from_stats(*ours, *theirs, equal_var=False).pvalue
    assert welch_p_value(ours, theirs) == pytest.approx(expected) and expected < 0.001
    assert np.isnan([welch_p_value((1.0, np.nan, 1), theirs), welch_p_value((1.0, 0.0, 3), (2.0, 0.0, 3))]).all()
    assert holm([0.01, np.nan, 0.04, 0.03]) == pytest.approx([0.03, np.nan, 0.06, 0.06], nan_ok=True)
    assert holm([0.5, 0.9]).tolist() == [1.0, 1.0]


def test_the_bootstrap_draws_runs_within_tasks():
    assert stratified_iqm([[0.0, 0.0], [1.0] * 6]) == (0.5, (0.5, 0.5))  # tasks weigh alike
    scores = [np.linspace(0, 1, 10), np.linspace(1, 2, 10)]
    mean, (low, high) = stratified_iqm(scores)
    assert mean == pytest.approx(interquartile_mean(np.concatenate(scores)))
    drawn = np.random.default_rng(5)
    means = [
        interquartile_mean(np.concatenate([drawn.choice(each, len(each)) for each in scores])) for _ in range(4000)
    ]
    assert (low, high) == pytest.approx(np.quantile(means, [0.025, 0.975]), abs=0.02) and low < mean < high
    thresholds = [-1.0, 0.45, 3.0]
    band, share = profile_band(scores, thresholds), performance_profile(scores, thresholds)
    assert band[:, [0, 2]].tolist() == [[1.0, 0.0], [1.0, 0.0]] and band[0, 1] < share[1] < band[1, 1]


def test_pairing_takes_out_what_a_start_is_worth():
    starts = np.random.default_rng(1).normal(0.0, 200.0, 100)
    ours, theirs = np.stack((starts + 2.0, starts + 4.0)), starts[None] + np.tile([0.0, 2.0], 50)
    difference, (low, high) = paired_difference(ours, theirs)
    assert difference == pytest.approx(2.0)
    assert (low, high) == pytest.approx((2.0 - 0.199412, 2.0 + 0.199412), abs=1e-4)
    with pytest.raises(ValueError, match="100 starts of ours, 99 of theirs"):
        paired_difference(ours, theirs[:, :99])


def test_resampled_areas_are_those_of_the_drawn_rows():
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 2, (80, 2)).astype(float)
    labels[::7, 1] = np.nan
    outputs = np.round(rng.normal(size=(3, 80, 2)) + np.nan_to_num(labels), 1)  # with ties
    outputs[2] = outputs[0]
    areas = ResampledAreas(labels, 20)
    found = areas.of(outputs)
    rows = [np.repeat(np.arange(80), weights.astype(int)) for weights in areas._weights]
    for area, drawn in zip(found, rows, strict=True):
        known = [drawn[~np.isnan(labels[drawn, label])] for label in (0, 1)]
        pairs = [(run, label, chosen) for run in outputs for label, chosen in enumerate(known)]
        expected = [roc_auc_score(labels[chosen, label], run[chosen, label]) for run, label, chosen in pairs]
        assert area == pytest.approx(np.mean(expected), abs=1e-6)
    assert ResampledAreas.difference(found, found) == (0.0, (0.0, 0.0))
    one_class = np.column_stack((np.tile([0.0, 1.0], 10), np.ones(20)))  # a label of one class is left out
    assert ResampledAreas(one_class, 5).of(one_class[None])[0] == 1.0


def test_rows_of_a_group_are_drawn_together():
    labels = np.random.default_rng(2).integers(0, 2, (60, 1)).astype(float)
    groups = np.repeat(["a", "b", "c", "d"], 15)
    weights = ResampledAreas(labels, 30, groups)._weights
    by_group = weights.reshape(31, 4, 15)
    assert (by_group == by_group[:, :, :1]).all() and (by_group[:, :, 0].sum(axis=1) == 4).all()
    assert len(np.unique(by_group[:, :, 0], axis=0)) > 5
    alone = ResampledAreas(labels, 30, np.arange(60))._weights
    assert (alone == ResampledAreas(labels, 30)._weights).all()
