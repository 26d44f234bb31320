"""The best axis-aligned split of many columns at once, among them columns that a reflection would have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from otr.core.arrays import FloatArray

# Entries of a block of columns: the few arrays of this size stay in the cache.
_BLOCK_ENTRIES = 2**18
# Two values of a column count as different where they differ by more than this share of the column's largest.
_RESOLUTION = 1e-12
# Gains count as equal where they differ by less than this share of the node's impurity.
TIE = 1e-12


@dataclass(frozen=True)
class AxisSplit:
    """``column <= threshold`` goes left; `gain` is the fall of the impurity, summed over rows."""

    column: int
    threshold: float
    gain: float


def best_split(
    X: NDArray[Any],
    Y: FloatArray,
    *,
    normal: FloatArray | None = None,
    weights: FloatArray | None = None,
    min_samples_leaf: int = 1,
    random_state: np.random.RandomState,
    n_jobs: int | None = None,
) -> AxisSplit | None:
    """Return the split of a column of X (I - 2 u u^T) that lowers the impurity most, or None if no column varies.

    The impurity of rows is ``sum |Y - mean(Y)|^2``: the squared error for targets Y, the Gini impurity times the number
    of rows for Y one-hot, and half of that for two classes in one column of 0 and 1. With Y centred at the node and S
    the sums on the left, a split of n rows into p and n - p lowers it by ``|S|^2 (1 / p + 1 / (n - p))``. All of these
    count a row as its weight, but `min_samples_leaf` counts rows, as in scikit-learn.

    X is (n, d), Y (n, o); u is `normal` (d,), of unit length, or None for the columns as they are; `weights` (n,) are
    above 0, None for one each. `random_state` decides between columns of equal gain, and the number of threads `n_jobs`
    changes nothing.

    Cost: O(d n log n), a sort of each column. The columns come in blocks, so each thread needs some tens of MB in
    addition to X, or a few dozen numbers a row where there are more than 2**18 rows.
    """
    n, d = X.shape
    if n < 2 * min_samples_leaf:
        return None
    Y, impurity = _centred(Y, weights)
    shift = None if normal is None else _product(X, normal)
    width = max(1, _BLOCK_ENTRIES // n)
    blocks = [slice(start, min(start + width, d)) for start in range(0, d, width)]
    found = Parallel(n_jobs=n_jobs, prefer="threads")(
        delayed(_best_of_each)(
            X[:, block], None if normal is None else normal[block], shift, Y, weights, min_samples_leaf
        )
        for block in blocks
    )
    gains, thresholds = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return _largest(gains, thresholds, impurity, random_state)


def best_bit_split(
    X: NDArray[Any],
    Y: FloatArray,
    *,
    weights: FloatArray | None = None,
    min_samples_leaf: int = 1,
    random_state: np.random.RandomState,
) -> AxisSplit | None:
    """Return what `best_split` does, for X (n, d) of zeros and ones: one product, O(n d o), and no sorts."""
    n, d = X.shape
    Y, impurity = _centred(Y, weights)
    n_right, right = np.zeros(d), np.zeros((Y.shape[1], d))
    weight_right = n_right if weights is None else np.zeros(d)
    chunk = max(1, _BLOCK_ENTRIES // d)
    for start in range(0, n, chunk):
        part = X[start : start + chunk].astype(np.float64)
        n_right += part.sum(axis=0)
        right += Y[start : start + chunk].T @ part
        if weights is not None:
            weight_right += weights[start : start + chunk] @ part
    weight_left = (n if weights is None else weights.sum()) - weight_right
    possible = np.minimum(n - n_right, n_right) >= max(1, min_samples_leaf)
    gains = np.full(d, -np.inf)
    gains[possible] = np.square(right).sum(axis=0)[possible] * (
        1.0 / weight_left[possible] + 1.0 / weight_right[possible]
    )
    return _largest(gains, np.full(d, 0.5), impurity, random_state)


def _largest(
    gains: FloatArray, thresholds: FloatArray, impurity: float, random_state: np.random.RandomState
) -> AxisSplit | None:
    """Return the column of the largest gain, drawn among those that tie, or None if all are -inf."""
    best = gains.max()
    if not np.isfinite(best):
        return None
    ties = np.flatnonzero(gains >= best - TIE * impurity)
    column = int(ties[random_state.randint(len(ties))]) if len(ties) > 1 else int(ties[0])
    return AxisSplit(column, float(thresholds[column]), float(gains[column]))


def _centred(Y: FloatArray, weights: FloatArray | None) -> tuple[FloatArray, float]:
    """Return the rows of Y (n, o) less their mean, times their weights; and their impurity."""
    centred: FloatArray = Y - np.average(Y, axis=0, weights=weights)
    if weights is None:
        return centred, float(np.square(centred).sum())
    weighted = centred * weights[:, None]
    return weighted, float((centred * weighted).sum())


def _product(X: NDArray[Any], vector: FloatArray) -> FloatArray:
    """Return X @ vector in float64 without a float64 copy of all of X."""
    chunk = max(1, _BLOCK_ENTRIES // X.shape[1])
    parts = [X[start : start + chunk].astype(np.float64) @ vector for start in range(0, len(X), chunk)]
    return np.concatenate(parts)


def _best_of_each(
    columns: NDArray[Any],
    normal: FloatArray | None,
    shift: FloatArray | None,
    Y: FloatArray,
    weights: FloatArray | None,
    min_samples_leaf: int,
) -> tuple[FloatArray, FloatArray]:
    """Return the best gain (m,) and its threshold (m,) for each of m columns; -inf where a column has no split."""
    Z = np.ascontiguousarray(columns.T, dtype=np.float64)
    if normal is not None and shift is not None:
        Z = Z - (2.0 * normal)[:, None] * shift
    m, n = Z.shape
    order = Z.argsort(axis=1)
    Z = np.take_along_axis(Z, order, axis=1)
    equal = Z[:, 1:] - Z[:, :-1] <= _RESOLUTION * np.abs(Z[:, [0, -1]]).max(axis=1, keepdims=True)
    gains = np.zeros((m, n - 1))
    for target in Y.T:
        left = target[order].cumsum(axis=1)[:, :-1]
        left *= left
        gains += left
    if weights is None:
        weight_left = np.arange(1.0, n)
        weight_right = n - weight_left
    else:
        weight_left = weights[order].cumsum(axis=1)[:, :-1]
        weight_right = (weights.sum() - weight_left).clip(min=weights.min())
    gains *= 1.0 / weight_left + 1.0 / weight_right
    gains[equal] = -np.inf
    gains[:, : min_samples_leaf - 1] = -np.inf
    gains[:, n - min_samples_leaf :] = -np.inf
    at = gains.argmax(axis=1)
    each = np.arange(m)
    low, high = Z[each, at], Z[each, at + 1]
    return gains[each, at], low + (high - low) / 2
