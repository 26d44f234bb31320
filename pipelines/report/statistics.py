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


def _known(values: ArrayLike) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64).ravel()
    known: np.ndarray = array[~np.isnan(array)]
    return known
