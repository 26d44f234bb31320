"""The features that get a full search for a split between linear models."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import FloatArray, IntArray
from otr.learners.model_tree import LinearTreeRegressor, ridge_objectives

_N_CUTS = 7
_N_ROWS = 2000
_BLOCK = 64


def best_columns(
    features: NDArray[Any], X: FloatArray, Y: FloatArray, options: LinearTreeRegressor, n_best: int
) -> IntArray:
    """Return the `n_best` features whose best of 7 quantiles lowers the ridge objective most, on up to 2,000 rows.

    `features` are (n, m); the linear models on either side read X (n, d) and answer Y (n, o). The Gram matrices left of
    all cuts of a block of features are one product: (cuts, rows) of 0 and 1 times the rows' outer products.
    """
    n, m = features.shape
    if m <= n_best:
        return np.arange(m)
    rows = np.linspace(0, n - 1, min(n, _N_ROWS)).astype(np.int64)
    S, x, y = features[rows], X[rows], Y[rows]
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    joint = np.concatenate((x, y, np.ones((len(rows), 1))), axis=1)
    products = (joint[:, :, None] * joint[:, None, :]).reshape(len(rows), -1)
    best = [
        _best_of_block(S[:, start : start + _BLOCK], products, x.shape[1], options.alpha)
        for start in range(0, m, _BLOCK)
    ]
    return np.sort(np.argsort(np.concatenate(best), kind="stable")[:n_best])


def _best_of_block(S: NDArray[Any], products: FloatArray, d: int, alpha: float) -> FloatArray:
    """Return each feature's lowest objective (m,); infinite where no cut has more than d rows on either side."""
    n, m = S.shape
    side = int(np.sqrt(products.shape[1]))
    thresholds = np.quantile(S, np.linspace(0, 1, _N_CUTS + 2)[1:-1], axis=0)
    on_left = (S[None] <= thresholds[:, None, :]).transpose(0, 2, 1).reshape(-1, n)
    n_left = on_left.sum(axis=1)
    possible = (n_left > d) & (n - n_left > d)
    left = (on_left[possible].astype(np.float64) @ products).reshape(-1, side, side)
    right = products.sum(axis=0).reshape(side, side) - left
    objectives = np.full(len(on_left), np.inf)
    objectives[possible] = sum(
        ridge_objectives(part[:, :-1, :-1], part[:, :-1, -1], part[:, -1, -1], d, alpha) for part in (left, right)
    )
    return np.asarray(objectives.reshape(-1, m).min(axis=0))
