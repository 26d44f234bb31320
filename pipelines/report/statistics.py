"""What is said of a handful of runs and of the starts that they share: intervals, robust means, comparisons.

Returns of training runs are few and spread wide, so an interval is given from five runs on and not below (Agarwal et
al. 2021, "Deep reinforcement learning at the edge of the statistical precipice", whose other measures these are).
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

MIN_RUNS_FOR_INTERVAL = 5
LEVEL = 0.95

Interval = tuple[float, float]
NO_INTERVAL: Interval = (np.nan, np.nan)


def mean_interval(values: ArrayLike) -> Interval:
    """Return Student's 95 % interval of the mean of values (n,); NaN for fewer than five, NaN among them left out.

    It assumes values that are roughly normal; of values that are all alike it is a point.
    """
    known = _known(values)
    if len(known) < MIN_RUNS_FOR_INTERVAL:
        return NO_INTERVAL
    half = float(stats.t.ppf((1 + LEVEL) / 2, len(known) - 1) * stats.sem(known))
    return float(known.mean()) - half, float(known.mean()) + half


def interquartile_mean(values: ArrayLike) -> float:
    """Return the mean of the middle half of values (n,): a quarter of them, rounded down, is cut off at either end."""
    known = _known(values)
    return float(stats.trim_mean(known, 0.25)) if len(known) else np.nan


def difference_interval(ours: ArrayLike, theirs: ArrayLike) -> Interval:
    """Return Welch's 95 % interval of the difference of two means of runs, ours less theirs; NaN below five of either.

    Args:
        ours, theirs: (n,) and (m,), a number a run; the runs of the two are independent.
    """
    first, second = _known(ours), _known(theirs)
    if min(len(first), len(second)) < MIN_RUNS_FOR_INTERVAL:
        return NO_INTERVAL
    if not (np.ptp(first) or np.ptp(second)):
        difference = float(first.mean() - second.mean())
        return difference, difference
    interval = stats.ttest_ind(first, second, equal_var=False).confidence_interval(LEVEL)
    return float(interval.low), float(interval.high)


def probability_of_improvement(ours: ArrayLike, theirs: ArrayLike) -> float:
    """Return how often a run of ours is better than one of theirs, ties counting half: U / (n m) of Mann and Whitney.

    Args:
        ours, theirs: (n,) and (m,), at least one each.
    """
    first, second = _known(ours), _known(theirs)
    if not (len(first) and len(second)):
        return np.nan
    return float(stats.mannwhitneyu(first, second).statistic) / (len(first) * len(second))


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


class ResampledAreas:
    """Areas under the ROC curve on bootstrap samples of the test rows, the same samples for every method.

    The interval of a difference is about which rows were drawn, for the trees that there are, and not about other
    seeds (percentiles of the paired bootstrap).
    """

    def __init__(self, labels: ArrayLike, n_samples: int = 2000) -> None:
        """Draw the samples.

        Args:
            labels: (n, L), 0, 1 or NaN where a label was not measured.
            n_samples: of n rows each, with replacement, by a fixed seed.
        """
        self._labels = np.asarray(labels, dtype=np.float64)
        n = len(self._labels)
        self._counts = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), n_samples).astype(np.float32)

    def of(self, outputs: ArrayLike) -> np.ndarray:
        """Return the mean area over labels and runs, (1 + n_samples,): first on the rows as they are.

        A label of which a sample has one class alone is left out of its mean, for every method.

        Args:
            outputs: (runs, n, L), larger for label 1.
        """
        runs = np.unique(np.asarray(outputs, dtype=np.float32), axis=0, return_counts=True)
        weights = np.concatenate((np.ones((1, len(self._labels)), dtype=np.float32), self._counts))
        areas = np.full((len(weights), self._labels.shape[1]), np.nan)
        for label, column in enumerate(self._labels.T):
            ones, zeros = np.flatnonzero(column == 1), np.flatnonzero(column == 0)
            if not (len(ones) and len(zeros)):
                continue
            wins = np.zeros((len(ones), len(zeros)), dtype=np.float32)
            for values, n_alike in zip(*runs, strict=True):
                above, below = values[ones, label][:, None], values[zeros, label]
                wins += n_alike * ((above > below) + np.float32(0.5) * (above == below))
            numbers = weights[:, ones].sum(axis=1) * weights[:, zeros].sum(axis=1) * runs[1].sum()
            sums = ((weights[:, zeros] @ wins.T) * weights[:, ones]).sum(axis=1)
            areas[:, label] = np.divide(sums, numbers, out=np.full(len(weights), np.nan), where=numbers > 0)
        return np.asarray(np.nanmean(areas, axis=1))

    @staticmethod
    def difference(ours: np.ndarray, theirs: np.ndarray) -> tuple[float, Interval]:
        """Return the difference of two results of `of`, ours less theirs, and its 95 % interval over the samples."""
        differences = ours - theirs
        low, high = np.quantile(differences[1:], [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
        return float(differences[0]), (float(low), float(high))


def _known(values: ArrayLike) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64).ravel()
    known: np.ndarray = array[~np.isnan(array)]
    return known
