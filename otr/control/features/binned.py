"""Features in few bins, on which CART sorts less, and thresholds between the values that bins represent."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from otr.core.tree import ObliqueTree

_N_BINS = 255
_N_CELLS = 2**12


def quantised(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (n, m) the number of the bin of each of the values (m, n), at most 255 a feature, in their order.

    A feature's range is cut into 4,096 cells, and cells are put together into bins of about equally many rows. Where an
    outlier leaves fewer cells than bins with rows, distinct values take the place of the cells.
    """
    m, n = values.shape
    low = values.min(axis=1, keepdims=True)
    span = values.max(axis=1, keepdims=True) - low
    scale = (_N_CELLS - 1) / np.where(span > 0, span, 1).astype(np.float64)
    cells = ((values - low) * scale).astype(np.int64)
    bins = np.empty((m, n), dtype=np.uint8)
    for feature in range(m):
        own, n_rows = cells[feature], np.bincount(cells[feature], minlength=_N_CELLS)
        if np.count_nonzero(n_rows) < _N_BINS:
            _, own, n_rows = np.unique(values[feature], return_inverse=True, return_counts=True)
        n_before = n_rows.cumsum() - n_rows
        bins[feature] = (n_before * _N_BINS // n).astype(np.uint8)[own]
    return np.ascontiguousarray(bins.T, dtype=np.float32)


def with_thresholds_between(tree: ObliqueTree, bins: NDArray[np.float32], values: NDArray[np.float32]) -> ObliqueTree:
    """Return the tree on features for CART's on bins: it parts `values` (m, n) as that parts their `bins` (n, m).

    A threshold is midway between the largest value of the bins on its left and the smallest of those on its right.
    """
    columns = np.abs(tree.P).argmax(axis=1)
    v = np.array([_minus_midpoint(values[j], bins[:, j] <= -t) for j, t in zip(columns, tree.v, strict=True)])
    return tree.replace(v=v)


def _minus_midpoint(values: NDArray[np.float32], on_left: NDArray[np.bool_]) -> float:
    low, high = float(values[on_left].max()), float(values[~on_left].min())
    return -(low + (high - low) / 2)
