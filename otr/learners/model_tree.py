"""Linear model trees: axis-aligned tests chosen for the linear models below them, one such model in every leaf."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from itertools import pairwise
from numbers import Integral
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils._param_validation import Interval
from sklearn.utils.validation import check_random_state

from otr.core.arrays import FloatArray, IntArray
from otr.learners.base.parameters import AT_LEAST_0, AT_LEAST_1, NOT_NEGATIVE, Constraints
from otr.learners.base.single_tree import GrownRegressor
from otr.learners.base.weights import mean_and_divisor
from otr.learners.growing.greedy import Skeleton, Test, grow

# A split has to lower the objective by this share of the targets' total sum of squares.
_MIN_GAIN = 1e-9
# Added to the Gram matrices, as a share of the rows: keeps them regular with alpha = 0 and collinear inputs.
_JITTER = 1e-10


@dataclass(eq=False, repr=False)
class LinearTreeRegressor(GrownRegressor):
    """CART-like tree with a ridge regression in every leaf, one or several targets.

    A node is split at the axis-aligned test that minimises the two sides' ridge objectives
    ``|Y - X W - c|^2 + alpha |W|^2`` together, with a model of all inputs on either side (as in M5 and its heirs, but
    by exact search: the models of all candidates follow from cumulative sums). Inputs are standardised over the
    training rows for the penalty; targets are weighted by 1 / variance where there are several. The penalty counts
    on both sides, so a split has to earn it: a node whose best split does not lower the objective is a leaf. Rows with
    `sample_weight` w count as w rows in the objective, in standardising and in the variance.

    Search: for each input, at most `max_bins` - 1 thresholds at quantiles of the node's rows, all of them where it has
    fewer distinct values; then as many between the two neighbours of the best one, on its input, and so on until none
    is left there. For a node with n rows, d inputs and o targets the Gram matrices cost
    O(n d (d + o) f) for f inputs searched, the solutions O(max_bins d^2 (d + o) f); memory
    O(n d + max_bins (d + o)^2). That is meant for states of control tasks, d up to about a hundred; with more,
    `max_features` keeps f small.

    Args:
        max_depth: number of tests on a path at most; None for no limit; 0 for one ridge regression.
        min_samples_leaf: rows in a leaf at least, whatever their weights.
        alpha: ridge penalty on the slopes, not the offset, for standardised inputs.
        max_bins: see above, at least 4.
        max_features: inputs searched at a node, drawn at random; None for all. Models always read all inputs.
        random_state: the draws of `max_features`.

    Attributes:
        tree_: the `otr.ObliqueTree`, with affine leaves.
    """

    _parameter_constraints: ClassVar[Constraints] = {
        "max_depth": [AT_LEAST_0, None],
        "min_samples_leaf": [AT_LEAST_1],
        "alpha": [NOT_NEGATIVE],
        "max_bins": [Interval(Integral, 4, None, closed="left")],
        "max_features": [AT_LEAST_1, None],
        "random_state": ["random_state"],
    }

    _: KW_ONLY
    max_depth: int | None = 6
    min_samples_leaf: int = 10
    alpha: float = 0.1
    max_bins: int = 32
    max_features: int | None = None
    random_state: Any = None

    def fit(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> LinearTreeRegressor:
        """Fit on X (n, d) and targets y, (n,) or (n, o); `sample_weight` (n,) counts a row as that many."""
        X, targets, weights = self._checked_fit(X, y, sample_weight)
        X = X.astype(np.float64, copy=False)
        random_state = check_random_state(self.random_state)
        features = np.arange(X.shape[1])

        def drawn(rows: IntArray, Z: FloatArray, Y: FloatArray) -> IntArray:
            if self.max_features is None or self.max_features >= len(features):
                return features
            return np.sort(random_state.choice(features, self.max_features, replace=False))

        tests, M, c = grow_models(X, X, targets, self, drawn, weights)
        return self._take(tests.with_leaves(c, M), X, targets, weights)


def grow_models(
    features: NDArray[Any],
    X: FloatArray,
    targets: FloatArray,
    options: LinearTreeRegressor,
    searched: Callable[[IntArray, FloatArray, FloatArray], IntArray],
    weights: FloatArray | None = None,
) -> tuple[Skeleton, FloatArray, FloatArray]:
    """Return the tests of `LinearTreeRegressor` on features (n, m), and the leaves' models M, c of X (n, d).

    `options` holds depth, leaf size, penalty and bins. `searched` maps a node's rows, and their standardised inputs and
    targets, to the columns of `features` that are searched there. `weights` (n,) are above 0, None for one each.
    """
    x_mean, x_scale = mean_and_divisor(X, weights)
    y_mean, y_scale = mean_and_divisor(targets, weights)
    Z, Y = (X - x_mean) / x_scale, (targets - y_mean) / y_scale
    min_gain = _MIN_GAIN * float(np.square(Y if weights is None else Y * np.sqrt(weights)[:, None]).sum())

    def of(rows: IntArray) -> FloatArray | None:
        return None if weights is None else weights[rows]

    def find_test(rows: IntArray) -> Test | None:
        z, y = Z[rows], Y[rows]
        split = _best_split(features[rows], z, y, searched(rows, z, y), options, of(rows))
        if split is None or split.gain <= min_gain:
            return None
        P = np.zeros(features.shape[1])
        P[split.column] = 1.0
        return Test(P, -_midpoint(features[rows, split.column].astype(np.float64), split.n_left))

    tests = grow(features, find_test, options.max_depth)
    models = [_ridge(Z[rows], Y[rows], options.alpha, of(rows)) for rows in tests.leaf_rows]
    M = np.array([W.T for W, _ in models]) * y_scale[:, None] / x_scale
    c = np.array([offset for _, offset in models]) * y_scale + y_mean - M @ x_mean
    return tests, M, c


@dataclass(frozen=True)
class _ModelSplit:
    """The `n_left` rows of smallest values in a column go left; `gain` is the fall of the objective."""

    column: int
    n_left: int
    gain: float


def _midpoint(column: FloatArray, n_left: int) -> float:
    low, high = np.partition(column, (n_left - 1, n_left))[n_left - 1 : n_left + 1]
    middle = low + (high - low) / 2
    return float(middle if middle < high else low)  # neighbouring floats have no middle


def _best_split(
    features: NDArray[Any],
    X: FloatArray,
    Y: FloatArray,
    columns: IntArray,
    options: LinearTreeRegressor,
    weights: FloatArray | None = None,
) -> _ModelSplit | None:
    """Return the best split of a node's rows by one of the `columns` of their features (n, m), for models of X (n, d).

    None if there is no threshold to try. `weights` (n,) of the rows are above 0; None for one each.
    """
    n, d, m = *X.shape, options.min_samples_leaf
    if n < 2 * m:
        return None
    X, Y = X - np.average(X, axis=0, weights=weights), Y - np.average(Y, axis=0, weights=weights)
    rows = np.concatenate((X, Y), axis=1)
    gram, _, total = _moments(rows, weights)
    parent = float(ridge_objectives(gram[None], np.zeros((1, rows.shape[1])), np.array([total]), d, options.alpha)[0])

    def objectives_of(order: IntArray, cuts: IntArray) -> FloatArray:
        return _split_objectives(rows[order], cuts, d, options.alpha, None if weights is None else weights[order])

    n_most = options.max_bins - 1
    counts = np.ones(n) if weights is None else weights
    best: tuple[float, int, int] | None = None
    for column in columns.tolist():
        order = features[:, column].argsort(kind="stable")
        values = features[order, column]
        cuts = np.flatnonzero(values[1:] > values[:-1]) + 1
        cuts = cuts[(cuts >= m) & (cuts <= n - m)]
        before = np.concatenate(((0.0,), counts[order].cumsum()))
        tried = _spread(cuts, before, 0, n, n_most)
        if not len(tried):
            continue
        objectives = objectives_of(order, tried)
        at = int(objectives.argmin())
        if best is None or objectives[at] < best[0]:
            best = float(objectives[at]), column, int(tried[at])
            finer = order, before, cuts, tried
    if best is None:
        return None
    order, before, cuts, tried = finer
    objective, column, n_left = best
    low, high = 0, n
    while True:
        low, high = max(tried[tried < n_left], default=low), min(tried[tried > n_left], default=high)
        between = cuts[(cuts > low) & (cuts < high) & (cuts != n_left)]
        if not len(between):
            return _ModelSplit(column, n_left, parent - objective)
        tried = _spread(between, before, low, high, n_most)
        objectives = objectives_of(order, tried)
        if objectives.min() < objective:
            tried = np.append(tried, n_left)
            objective, n_left = float(objectives.min()), int(tried[objectives.argmin()])


def _spread(cuts: IntArray, before: FloatArray, low: int, high: int, n_most: int) -> IntArray:
    """Return at most `n_most` of the ascending `cuts`: all, or those next to evenly spaced shares of the rows.

    `before` (n + 1,) is how many rows, as they are weighted, come before each position.
    """
    if len(cuts) <= n_most:
        return cuts
    wanted = np.linspace(before[low], before[high], n_most + 2)[1:-1]
    return np.unique(cuts[np.searchsorted(before[cuts], wanted).clip(0, len(cuts) - 1)])


def _moments(rows: FloatArray, weights: FloatArray | None) -> tuple[FloatArray, FloatArray, float]:
    """Return the Gram matrix, the sums and the number of rows (n, k), each as it is weighted."""
    if weights is None:
        return rows.T @ rows, rows.sum(axis=0), len(rows)
    weighted = rows * weights[:, None]
    return rows.T @ weighted, weighted.sum(axis=0), float(weights.sum())


def _split_objectives(rows: FloatArray, cuts: IntArray, d: int, alpha: float, weights: FloatArray | None) -> FloatArray:
    """Return, for each cut of the sorted rows (X, Y), the ridge objectives of the two sides, added."""
    slices = [slice(*ends) for ends in pairwise((0, *cuts.tolist(), len(rows)))]
    moments = [_moments(rows[part], None if weights is None else weights[part]) for part in slices]
    grams, sums, counts = (np.cumsum(each, axis=0) for each in zip(*moments, strict=True))
    left = ridge_objectives(grams[:-1], sums[:-1], counts[:-1], d, alpha)
    right = ridge_objectives(grams[-1] - grams[:-1], sums[-1] - sums[:-1], counts[-1] - counts[:-1], d, alpha)
    return left + right


def ridge_objectives(
    grams: FloatArray, sums: FloatArray, counts: IntArray | FloatArray, d: int, alpha: float
) -> FloatArray:
    """Return the least of |Y - X W - c|^2 + alpha |W|^2 from Gram matrices (k, d + o, d + o) and sums (k, d + o)."""
    scatter = grams - sums[:, :, None] * sums[:, None, :] / counts[:, None, None]
    xx, xy, yy = scatter[:, :d, :d], scatter[:, :d, d:], scatter[:, d:, d:]
    xx = xx + (alpha + _JITTER * counts)[:, None, None] * np.eye(d)
    slopes = np.linalg.solve(xx, xy)
    return np.asarray(np.trace(yy, axis1=1, axis2=2) - (xy * slopes).sum(axis=(1, 2)))


def _ridge(X: FloatArray, Y: FloatArray, alpha: float, weights: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Return W (d, o) and c (o,) of the ridge regression, of least norm where alpha = 0 leaves a choice."""
    x_mean, y_mean = np.average(X, axis=0, weights=weights), np.average(Y, axis=0, weights=weights)
    d = X.shape[1]
    X, Y = X - x_mean, Y - y_mean
    if weights is not None:
        X, Y = X * np.sqrt(weights)[:, None], Y * np.sqrt(weights)[:, None]
    A = np.concatenate((X, np.sqrt(alpha) * np.eye(d)))
    B = np.concatenate((Y, np.zeros((d, Y.shape[1]))))
    W = np.linalg.lstsq(A, B, rcond=None)[0]
    return W, y_mean - x_mean @ W
