"""Statistics of a handful of runs and of the starts that they share: intervals, robust means, comparisons.

Returns of training runs are few and spread wide, so an interval is given from five runs on and not below (Agarwal et
al. 2021, "Deep reinforcement learning at the edge of the statistical precipice", whose other measures these are).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtr, stdtrit  # scipy.stats takes longer to import than the tables take to write

MIN_RUNS_FOR_INTERVAL = 5
LEVEL = 0.95

N_SAMPLES = 2000  # of a bootstrap

Interval = tuple[float, float]
Moments = tuple[float, float, float]
NO_INTERVAL: Interval = (np.nan, np.nan)


def mean_interval(values: ArrayLike) -> Interval:
    """Return Student's 95 % interval of the mean of values (n,); NaN for fewer than five, NaN among them left out.

    It assumes values that are roughly normal. Values that are all alike have none: what made them used no chance.
    """
    known = _known(values)
    if len(known) < MIN_RUNS_FOR_INTERVAL or not np.ptp(known):
        return NO_INTERVAL
    return _students(known.mean(), known.std(ddof=1) / np.sqrt(len(known)), len(known) - 1)


def resplit_interval(differences: ArrayLike, test_to_train: float) -> Interval:
    """Return the 95 % interval of the mean of differences (n,), one for each random split into training and test rows.

    The training rows of two splits are mostly the same, so that the differences vary less than they would on fresh
    data. The standard error is enlarged for it by sqrt(1 + n `test_to_train`), as Nadeau & Bengio correct it
    ("Inference for the generalization error", Machine Learning 52, 2003). NaN for fewer than five.

    Args:
        differences: (n,), NaN left out.
        test_to_train: the number of test rows over that of training rows.
    """
    known = _known(differences)
    if len(known) < MIN_RUNS_FOR_INTERVAL:
        return NO_INTERVAL
    return _students(known.mean(), known.std(ddof=1) * np.sqrt(1 / len(known) + test_to_train), len(known) - 1)


def interquartile_mean(values: ArrayLike) -> float:
    """Return the mean of the middle half of values (n,): a quarter of them, rounded down, is cut off at either end."""
    known = np.sort(_known(values))
    cut = len(known) // 4
    return float(known[cut : len(known) - cut].mean()) if len(known) else np.nan


def difference_interval(ours: ArrayLike, theirs: ArrayLike) -> Interval:
    """Return Welch's 95 % interval of the difference of two means of runs, ours less theirs; NaN below five of either.

    Args:
        ours, theirs: (n,) and (m,), a number a run; the runs of the two are independent.
    """
    first, second = _known(ours), _known(theirs)
    if min(len(first), len(second)) < MIN_RUNS_FOR_INTERVAL:
        return NO_INTERVAL
    difference = float(first.mean() - second.mean())
    if not (np.ptp(first) or np.ptp(second)):
        return difference, difference
    squares = [runs.var(ddof=1) / len(runs) for runs in (first, second)]  # of the standard errors
    degrees = sum(squares) ** 2 / (squares[0] ** 2 / (len(first) - 1) + squares[1] ** 2 / (len(second) - 1))
    return _students(difference, np.sqrt(sum(squares)), degrees)


def welch_p_value(ours: Moments, theirs: Moments) -> float:
    """Return Welch's two-sided p-value of two means of runs being equal, each from (mean, deviation, number of runs).

    NaN where either has fewer than two runs or no deviation is known.
    """
    means, stds, numbers = np.array([ours, theirs], dtype=float).T
    squares = stds**2 / numbers  # of the standard errors
    if not (squares.sum() > 0 and numbers.min() > 1):
        return np.nan
    degrees = squares.sum() ** 2 / (squares**2 / (numbers - 1)).sum()
    return float(2 * stdtr(degrees, -abs(means[0] - means[1]) / np.sqrt(squares.sum())))


def holm(p_values: ArrayLike) -> np.ndarray:
    """Return p-values (n,) corrected for their number (Holm 1979); NaN where there is none, which does not count."""
    values = np.asarray(p_values, dtype=float)
    order = np.argsort(values)[: np.sum(~np.isnan(values))]
    corrected = np.full(len(values), np.nan)
    corrected[order] = np.minimum(np.maximum.accumulate(values[order] * np.arange(len(order), 0, -1)), 1)
    return corrected


def resampled_runs(scores: Sequence[ArrayLike], n_samples: int = N_SAMPLES) -> list[np.ndarray]:
    """Return bootstrap samples of runs, drawn within each task (stratified): (n_samples, n) for each of the tasks.

    The same samples every time: of task i by seed i.
    """
    runs = [_known(task) for task in scores]
    return [
        task[np.random.default_rng(i).integers(len(task), size=(n_samples, len(task)))] for i, task in enumerate(runs)
    ]


def stratified_iqm(scores: Sequence[ArrayLike]) -> tuple[float, Interval]:
    """Return the interquartile mean of the runs of all tasks and its 95 % interval (after Agarwal et al. 2021).

    Tasks weigh alike: a run weighs one over the number of its task's runs, and a quarter of the weight is cut off at
    either end. Percentiles of the stratified bootstrap: about which runs were drawn, for these tasks.

    Args:
        scores: (n,) for each of one or more tasks, a normalised score a run.
    """
    runs = [_known(task) for task in scores]
    weights = np.concatenate([np.full(len(task), 1 / (len(task) * len(runs))) for task in runs])

    def means(drawn: np.ndarray) -> np.ndarray:
        order = np.argsort(drawn, axis=1)
        ends = np.cumsum(weights[order], axis=1)
        kept = np.clip(ends, 0.25, 0.75) - np.clip(ends - weights[order], 0.25, 0.75)
        middle: np.ndarray = 2 * (kept * np.take_along_axis(drawn, order, axis=1)).sum(axis=1)
        return middle

    observed = means(np.concatenate(runs)[None])
    return float(observed[0]), _percentiles(means(np.concatenate(resampled_runs(scores), axis=1)))


def probability_of_improvement(ours: ArrayLike, theirs: ArrayLike) -> float:
    """Return how often a run of ours is better than one of theirs, ties counting half: U / (n m) of Mann and Whitney.

    Args:
        ours, theirs: (n,) and (m,), at least one each.
    """
    first, second = _known(ours), _known(theirs)
    if not (len(first) and len(second)):
        return np.nan
    return float(np.mean((first[:, None] > second) + (first[:, None] == second) / 2))


def paired_difference(ours: ArrayLike, theirs: ArrayLike) -> tuple[float, Interval]:
    """Return the mean difference on shared starts, ours less theirs, and its 95 % interval over the starts.

    Returns of a start are first averaged over the runs, so the interval is about which starts were drawn, for the runs
    that there are, and not about other runs.

    Args:
        ours, theirs: (n, k) and (m, k), a row a run and a column a start, the same starts for both.

    Raises:
        ValueError: the numbers of starts differ.
    """
    first, second = np.atleast_2d(np.asarray(ours, dtype=float)), np.atleast_2d(np.asarray(theirs, dtype=float))
    if first.shape[1] != second.shape[1]:
        raise ValueError(f"{first.shape[1]} starts of ours, {second.shape[1]} of theirs; give the same starts")
    differences = first.mean(axis=0) - second.mean(axis=0)
    return float(differences.mean()), mean_interval(differences)


def performance_profile(scores: Sequence[ArrayLike], thresholds: ArrayLike) -> np.ndarray:
    """Return the share of runs whose score is above each threshold, (k,): the mean over tasks of each task's share.

    Every task counts alike, however many runs it has. The profiles of two methods compare these where
    they are over the same tasks, whose scores are on one scale.

    Args:
        scores: (n,) for each of one or more tasks, a normalised score a run, at least one each.
        thresholds: (k,).
    """
    shares = [(_known(task)[:, None] > np.asarray(thresholds)).mean(axis=0) for task in scores]
    return np.asarray(np.mean(shares, axis=0))


def profile_band(scores: Sequence[ArrayLike], thresholds: ArrayLike) -> np.ndarray:
    """Return the 95 % band of `performance_profile` by the stratified bootstrap, (2, k), at each threshold alone."""
    drawn, at = resampled_runs(scores), np.asarray(thresholds)
    shares = np.mean([(task[:, :, None] > at).mean(axis=1) for task in drawn], axis=0)
    return np.quantile(shares, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)


class ResampledAreas:
    """Areas under the ROC curve on bootstrap samples of the test rows, the same samples for every method.

    The interval of a difference is about which rows were drawn, for the trees that there are, and not about other
    seeds (percentiles of the paired bootstrap).
    """

    def __init__(self, labels: ArrayLike, n_samples: int = N_SAMPLES, groups: ArrayLike | None = None) -> None:
        """Draw the samples.

        Args:
            labels: (n, L), 0, 1 or NaN where a label was not measured.
            n_samples: of as many groups as there are, with replacement, by a fixed seed.
            groups: (n,), each row's group, of which all rows are drawn together; None where each row is its own.
        """
        labels = np.asarray(labels, dtype=np.float64)
        n = len(labels)
        self._weights = np.ones((1 + n_samples, n), dtype=np.float32)
        of_row = np.arange(n) if groups is None else np.unique(np.asarray(groups), return_inverse=True)[1]
        n_groups = of_row.max() + 1
        drawn = np.random.default_rng(0).multinomial(n_groups, np.full(n_groups, 1 / n_groups), n_samples)
        self._weights[1:] = drawn[:, of_row]
        # Of each label: the rows of class 1 and of class 0, and either with its weights, which every method shares.
        classes = [[np.flatnonzero(column == known) for known in (1, 0)] for column in labels.T]
        self._classes = [[(rows, self._weights[:, rows]) for rows in both] for both in classes]

    def of(self, outputs: ArrayLike) -> np.ndarray:
        """Return the mean area over labels and runs, (1 + n_samples,): first on the rows as they are.

        A label of which a sample has one class alone is left out of its mean, for every method.

        Args:
            outputs: (runs, n, L), larger for label 1.
        """
        runs = np.asarray(outputs, dtype=np.float32)
        areas = np.full((len(self._weights), len(self._classes)), np.nan)
        for label, ((ones, ones_weights), (zeros, zeros_weights)) in enumerate(self._classes):
            twice_wins = np.zeros((len(ones), len(zeros)), dtype=np.int32)
            for values in runs[:, :, label]:
                above, below = values[ones][:, None], values[zeros]
                twice_wins += above > below
                twice_wins += above >= below
            sums = ((zeros_weights @ twice_wins.T.astype(np.float32)) * ones_weights).sum(axis=1)
            numbers = 2 * len(runs) * ones_weights.sum(axis=1) * zeros_weights.sum(axis=1)
            areas[:, label] = np.divide(sums, numbers, out=np.full(len(numbers), np.nan), where=numbers > 0)
        return np.asarray(np.nanmean(areas, axis=1))

    @staticmethod
    def difference(ours: np.ndarray, theirs: np.ndarray) -> tuple[float, Interval]:
        """Return the difference of two results of `of`, ours less theirs, and its 95 % interval over the samples."""
        differences = ours - theirs
        return float(differences[0]), _percentiles(differences[1:])


def _percentiles(samples: np.ndarray) -> Interval:
    low, high = np.quantile(samples, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def _students(mean: float, error: float, degrees: float) -> Interval:
    """Return Student's interval of a mean with this standard error."""
    half = float(stdtrit(degrees, (1 + LEVEL) / 2) * error)
    return float(mean) - half, float(mean) + half


def _known(values: ArrayLike) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64).ravel()
    known: np.ndarray = array[~np.isnan(array)]
    return known
