"""Tests refitted by sparse linear discriminant analysis and rounded, under a measured bound.

For two classes the direction of linear discriminant analysis is that of least squares on coded classes, and with an L1
penalty it is that of the lasso (Mai, Zou & Yuan 2012, "A direct approach to sparse discriminant analysis in ultra-high
dimensions"); the threshold is set again afterwards. The classes of a test are the two ways it sends the states that
reach it, weighted alike. Orfanos 2023, Figure 4.7, simplifies a policy in this way.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from otr.core.arrays import BoolArray, FloatArray, as_batch
from otr.core.tree import ObliqueTree, require_tree

N_PENALTIES, SMALLEST_PENALTY = 60, 1e-3  # of the largest, which leaves no coefficient
MAX_SWEEPS, TOLERANCE = 1000, 1e-9  # of coordinate descent


@dataclass(frozen=True)
class RefittedTest:
    """The outcome of a test node.

    Attributes:
        node: its id.
        n_left, n_right: states that reach it and that the original test sends either way.
        agreement: of the states that it sends left and of those that it sends right, the share that still goes there;
            the smaller of the two. 1 where no state decides.
        n_coefficients_before, n_coefficients: inputs that it reads.
        change: refitted, rounded, or kept.
    """

    node: int
    n_left: int
    n_right: int
    agreement: float
    n_coefficients_before: int
    n_coefficients: int
    change: str


@dataclass(frozen=True)
class RefittedTree:
    """The simpler tree and the outcome of each of its tests."""

    tree: ObliqueTree
    tests: tuple[RefittedTest, ...]


def refit_tests(
    tree: ObliqueTree, X: ArrayLike, *, agreement: float = 0.95, digits: int = 2, nodes: Iterable[int] | None = None
) -> RefittedTree:
    """Return the tree with simpler tests on the states X; its leaves are unchanged.

    Of the penalties that a test may be refitted with, the largest is taken under which at least the share `agreement`
    of the states that it sends left still goes left, and of those right, right; measured with rounded coefficients,
    the largest of which is 1. Where none reads fewer inputs than the original, that one is rounded if the share allows
    it, and else kept as it is; so are tests that X does not reach on both sides.

    Args:
        tree: any tree.
        X: (n, d) states, such as those that the policy visits; the original tree decides which test they reach.
        agreement: the bound, in (0, 1].
        digits: significant digits of coefficients and thresholds, at least 1.
        nodes: the test nodes to refit, all if None; the others are rounded alone.

    Raises:
        TypeError: `tree` is no ObliqueTree, or `digits` no integer.
        ValueError: `agreement` or `digits` is out of its range, a node is not the tree's, or X is not finite.

    Examples:
        >>> tree = otr.parse_program("if x + 0.001 v <= 0: -1 else: 1", ["x", "v"])
        >>> states = np.random.default_rng(0).normal(size=(200, 2))
        >>> print(otr.to_text(otr.refit_tests(tree, states).tree, feature_names=["x", "v"]))
        if -0.015 + x <= 0 then
            return -1
        else
            return 1
    """
    if not 0 < agreement <= 1:
        raise ValueError(f"agreement is {agreement}, expected a share above 0 and up to 1")
    if operator.index(digits) < 1:
        raise ValueError(f"digits is {digits}, expected at least 1")
    require_tree(tree)
    chosen = set(range(tree.n_nodes) if nodes is None else nodes)
    if not chosen <= set(range(tree.n_nodes)):
        raise ValueError(f"nodes are {sorted(chosen)}, expected some of 0 to {tree.n_nodes - 1}")
    states = as_batch(X, tree.n_inputs)
    if not np.isfinite(states).all():
        raise ValueError("X holds numbers that are not finite; tests are refitted on states that the policy visits")
    paths = tree.decision_path(states).tocsc()
    P, v, tests = tree.P.copy(), tree.v.copy(), []
    for node in range(tree.n_nodes):
        reached = states[paths.indices[paths.indptr[node] : paths.indptr[node + 1]]]
        P[node], v[node], test = _simpler_test(
            node, tree.P[node], tree.v[node], reached, agreement, digits, node in chosen
        )
        tests.append(test)
    return RefittedTree(tree.replace(P=P, v=v), tuple(tests))


def _simpler_test(
    node: int, weights: FloatArray, offset: float, X: FloatArray, bound: float, digits: int, refit: bool
) -> tuple[FloatArray, float, RefittedTest]:
    """Return a test's new coefficients and offset, and what was done."""
    right = X @ weights + offset > 0
    n_before, n_right = int(np.count_nonzero(weights)), int(np.count_nonzero(right))
    n_left = len(X) - n_right

    def about(share: float, new: FloatArray, change: str) -> RefittedTest:
        return RefittedTest(node, n_left, n_right, share, n_before, int(np.count_nonzero(new)), change)

    if not (n_left and n_right):
        return weights, offset, about(1.0, weights, "kept")
    if refit:
        for direction in _sparse_directions(X, right):
            if np.count_nonzero(direction) >= n_before:
                break
            new = rounded(direction / np.abs(direction).max(), digits)
            threshold = float(rounded(np.array(_threshold(X @ new, right)), digits))
            share = _share_kept(X @ new - threshold > 0, right)
            if share >= bound:
                return new, -threshold, about(share, new, "refitted")
    new, new_offset = rounded(weights, digits), float(rounded(np.array(offset), digits))
    share = _share_kept(X @ new + new_offset > 0, right)
    if share >= bound:
        return new, new_offset, about(share, new, "rounded")
    return weights, offset, about(1.0, weights, "kept")


def rounded(values: FloatArray, digits: int) -> FloatArray:
    """Return numbers with so many significant digits."""
    return np.array([float(f"{value:.{digits - 1}e}") for value in values.ravel()]).reshape(values.shape)


def _share_kept(now: BoolArray, before: BoolArray) -> float:
    """Return the smaller share, of those that went left and of those that went right, that still goes there."""
    return float(min(now[before].mean(), 1 - now[~before].mean()))


def _threshold(values: FloatArray, right: BoolArray) -> float:
    """Return the threshold of `values > threshold` that keeps the largest share of the side that it keeps less of."""
    order = np.argsort(values, kind="stable")
    ordered, is_right = values[order], right[order]
    kept_left = np.cumsum(~is_right) / np.count_nonzero(~right)
    kept_right = 1 - np.cumsum(is_right) / np.count_nonzero(right)
    shares = np.minimum(kept_left, kept_right)[:-1]
    shares[ordered[1:] == ordered[:-1]] = -1.0  # no threshold fits between equal values
    if not len(shares) or shares.max() < 0:
        return float(ordered[0])
    best = np.flatnonzero(shares == shares.max())
    gap = best[np.argmax(ordered[best + 1] - ordered[best])]  # the widest
    return float((ordered[gap] + ordered[gap + 1]) / 2)


def _sparse_directions(X: FloatArray, right: BoolArray) -> Iterable[FloatArray]:
    """Yield directions across the classes, from the sparsest to the densest: the lasso under falling penalties."""
    share = np.where(right, 0.5 / np.count_nonzero(right), 0.5 / np.count_nonzero(~right))
    centred = X - share @ X
    scale = np.sqrt(share @ centred**2)
    varies = scale > 1e-12 * np.maximum(1.0, np.abs(X).max(axis=0))
    Z = np.where(varies, centred / np.where(varies, scale, 1.0), 0.0)
    gram, target = Z.T @ (share[:, None] * Z), Z.T @ (share * np.where(right, 1.0, -1.0))
    largest, w = np.abs(target).max(), np.zeros(X.shape[1])
    if largest == 0:
        return
    for penalty in largest * np.geomspace(1, SMALLEST_PENALTY, N_PENALTIES + 1)[1:]:
        w = _lasso(gram, target, penalty, w, np.flatnonzero(varies))
        if w.any():
            yield w / np.where(varies, scale, 1.0)


def _lasso(gram: FloatArray, target: FloatArray, penalty: float, start: FloatArray, inputs: np.ndarray) -> FloatArray:
    """Return argmin_w 1/2 w.gram.w - target.w + penalty |w|_1 by coordinate descent over `inputs` from `start`.

    Once the signs are those of the solution, it follows from a linear system: after each sweep it is tried whether the
    system's solution meets the optimality conditions.
    """
    w, slack = start.copy(), 1e-12 * np.abs(target).max()
    for _ in range(MAX_SWEEPS):
        change = 0.0
        for j in inputs.tolist():
            before = w[j]
            pull = target[j] - gram[j] @ w + gram[j, j] * before
            w[j] = np.sign(pull) * max(abs(pull) - penalty, 0.0) / gram[j, j]
            change = max(change, abs(w[j] - before))
        if change < TOLERANCE:
            break
        signs, active, exact = np.sign(w), np.flatnonzero(w), np.zeros_like(w)
        exact[active] = np.linalg.lstsq(gram[np.ix_(active, active)], (target - penalty * signs)[active])[0]
        excess = np.abs(target - gram @ exact - penalty * signs) - np.where(signs == 0, penalty, 0.0)
        if np.array_equal(np.sign(exact), signs) and excess.max() <= slack:
            return exact
    return w
