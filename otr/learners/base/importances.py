"""How much each input matters to a tree's tests, as scikit-learn's trees say it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from otr.core.arrays import FloatArray
from otr.core.tree import ObliqueTree


def importances_of(tree: ObliqueTree, X: NDArray[Any], Y: FloatArray, weights: FloatArray | None) -> FloatArray:
    """Return the shares (d,) that the inputs have in the fall of impurity at all tests, 0 for a tree without tests.

    Impurity is the squared error of a node's mean, for indicators of classes Gini's, times the weight of its rows. A
    test's fall is divided among its inputs in proportion to ``|P[f]|`` times the input's deviation, so that a test of
    one input counts for that one alone (Breiman et al. 1984, as in scikit-learn).

    Args:
        tree: the fitted tree.
        X, Y, weights: training rows (n, d), their targets or indicators (n, o), and weights (n,) or None.
    """
    w = np.ones(len(X)) if weights is None else weights
    Y = Y - np.average(Y, axis=0, weights=w)  # so that squares of large targets do not cancel
    leaves = sparse.csr_matrix((np.ones(len(X)), (np.arange(len(X)), tree.apply(X))), shape=(len(X), tree.n_leaves))
    reach = sparse.hstack((tree.decision_path(X), leaves)).T
    sums, squares = reach @ (w[:, None] * Y), reach @ (w * np.square(Y).sum(axis=1))
    impurity = squares - np.square(sums).sum(axis=1) / np.maximum(reach @ w, np.finfo(float).tiny)
    n = len(tree.v)
    left, right = (np.where(at < 0, n + ~at, at) for at in (tree.children_left, tree.children_right))
    falls = np.maximum(impurity[:n] - impurity[left] - impurity[right], 0.0)
    parts = np.abs(tree.P)
    for f in np.flatnonzero(parts.any(axis=0)):  # one by one: X may be large
        parts[:, f] *= np.sqrt(np.cov(X[:, f].astype(np.float64), ddof=0, aweights=weights))
    total = parts.sum(axis=1, keepdims=True)
    shares = falls @ np.divide(parts, total, out=np.zeros_like(parts), where=total > 0)
    return np.asarray(shares / shares.sum() if shares.sum() > 0 else shares)
