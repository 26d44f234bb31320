"""HHCART: axis-aligned splits after a Householder reflection, which are oblique splits before it."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from numbers import Integral
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils._param_validation import Interval
from sklearn.utils.validation import check_random_state

from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.core.tree import ObliqueTree
from otr.learners.base.parameters import AT_LEAST_0, AT_LEAST_1, CLASS_WEIGHT, Constraints
from otr.learners.base.single_tree import GrownClassifier, GrownRegressor, class_tree
from otr.learners.base.weights import ClassWeight, mean_and_divisor
from otr.learners.growing.eigenvector import dominant_direction
from otr.learners.growing.greedy import Test, grow
from otr.learners.growing.splits import TIE, AxisSplit, best_bit_split, best_split

# An eigenvector nearer than this (L2) to an axis, or to its opposite, is left to the axis-aligned split.
_NEAR_AXIS = 0.05


def householder_normal(q: FloatArray) -> FloatArray | None:
    """Return the unit u (d,) whose reflection ``I - 2 u u^T`` takes the unit vector q (d,) to the first axis.

    None where q is within 0.05 (L2) of an axis, so that the reflection would change next to nothing.
    """
    if np.sqrt(max(0.0, 2.0 - 2.0 * np.abs(q).max())) < _NEAR_AXIS:
        return None
    u = -q
    u[0] += 1.0
    return np.asarray(u / np.linalg.norm(u))


class _Grower:
    """Finds HHCART's test for a node."""

    def __init__(
        self,
        X: NDArray[Any],
        Y: FloatArray,
        weights: FloatArray | None,
        groups: list[BoolArray],
        options: _Hhcart,
    ) -> None:
        """Keep X (n, d), Y (n, o) as `best_split` takes it, the weights (n,), and the masks (n,) of groups of rows.

        A group's covariance gives a reflection.
        """
        self._X, self._Y, self._weights, self._groups, self._options = X, Y, weights, groups, options
        self._random_state = check_random_state(options.random_state)
        self._are_bits = bool(((X == 0) | (X == 1)).all())
        self._noise = 1e-12 * _sum_of_squares(Y, weights)

    def tree(self, targets: FloatArray) -> ObliqueTree:
        """Return the tree with the mean of the rows' targets (n, o) in each leaf."""
        skeleton = grow(self._X, self.find_test, self._options.max_depth)
        means = [np.average(targets[rows], axis=0, weights=self._of(rows)) for rows in skeleton.leaf_rows]
        return skeleton.with_leaves(np.array(means))

    def _of(self, rows: IntArray | BoolArray) -> FloatArray | None:
        return None if self._weights is None else self._weights[rows]

    def find_test(self, rows: IntArray) -> Test | None:
        """Return the test of the node that holds `rows`, None if it is pure, too small, or has nothing to split on."""
        Y, weights = self._Y[rows], self._of(rows)
        impurity = _sum_of_squares(Y - np.average(Y, axis=0, weights=weights), weights)
        if len(rows) < self._options.min_samples_split or impurity <= self._noise:
            return None
        X = self._X if len(rows) == len(self._X) else self._X[rows]
        best = self._split(X, Y, weights, None)
        normal = None
        for group in self._groups:
            candidate = self._normal(X, weights, group[rows])
            if candidate is None:
                continue
            split = self._split(X, Y, weights, candidate)
            if split is not None and (best is None or split.gain > best.gain + TIE * impurity):
                best, normal = split, candidate
        if best is None:
            return None
        P = np.zeros(X.shape[1])
        P[best.column] = 1.0
        if normal is not None:
            P -= 2.0 * normal[best.column] * normal
        return Test(P, -best.threshold)

    def _split(
        self, X: NDArray[Any], Y: FloatArray, weights: FloatArray | None, normal: FloatArray | None
    ) -> AxisSplit | None:
        options: dict[str, Any] = {
            "weights": weights,
            "min_samples_leaf": self._options.min_samples_leaf,
            "random_state": self._random_state,
        }
        if normal is None and self._are_bits:
            return best_bit_split(X, Y, **options)
        return best_split(X, Y, normal=normal, n_jobs=self._options.n_jobs, **options)

    def _normal(self, X: NDArray[Any], weights: FloatArray | None, mask: BoolArray) -> FloatArray | None:
        n_members = int(mask.sum())
        if n_members < 2:
            return None
        members = X if n_members == len(X) else X[mask]
        eigenvalue, q = dominant_direction(members, self._random_state, None if weights is None else weights[mask])
        return householder_normal(q) if eigenvalue > 0 else None


def _sum_of_squares(values: FloatArray, weights: FloatArray | None) -> float:
    squares = np.square(values)
    return float((squares if weights is None else squares * weights[:, None]).sum())


@dataclass(eq=False, repr=False)
class _Hhcart:
    """The parameters of both."""

    _parameter_constraints: ClassVar[Constraints] = {
        "max_depth": [AT_LEAST_0, None],
        "min_samples_split": [Interval(Integral, 2, None, closed="left")],
        "min_samples_leaf": [AT_LEAST_1],
        "random_state": ["random_state"],
        "n_jobs": [Integral, None],
    }

    _: KW_ONLY
    max_depth: int | None = None
    min_samples_split: int = 2
    min_samples_leaf: int = 1
    random_state: Any = None
    n_jobs: int | None = None


@dataclass(eq=False, repr=False, kw_only=True)
class HHCARTClassifier(_Hhcart, GrownClassifier):
    """HHCART(D) (Wickramarachchi, Robertson, Reale, Price & Brown 2016), one reflection for each class.

    At every node, the dominant eigenvector q of each class's covariance is taken to the first axis by the Householder
    reflection H = I - 2 u u^T, u = (e_1 - q) / |e_1 - q|. The node's test is the best split by Gini impurity on a
    column of X or of one of the X H: ``x_j - 2 u_j (u @ x) <= t`` is oblique in x. No reflection is made where the
    eigenvalue is 0 or q is within 0.05 of an axis, or for a class with fewer than two rows in the node.

    Neither H nor a covariance nor X H is ever formed: eigenvectors come from Lanczos on an implicit operator
    (`dominant_direction`), and X H, a rank-one change of X, is made a block of columns at a time (`best_split`).
    For n rows and K classes, a level of the tree costs O((K + 1) d n log n) for the sorts (K in place of K + 1 if all
    inputs are 0 or 1) and O(s d n) for s, some tens, Lanczos products; the memory besides X is one copy of the rows of
    a node, and a constant.

    The paper leaves open: ties between columns, drawn by `random_state`, and between reflections, where the plain
    axes come first and then the classes in their order; the eigenvector's sign, chosen so that its largest entry is
    positive; the stopping rule, which is purity or the limits below. There is no cost-complexity pruning.

    Args:
        max_depth: number of tests on a path at most; None for no limit.
        min_samples_split: a node with fewer rows is a leaf.
        min_samples_leaf: rows in a leaf at least.
        class_weight: None, "balanced" or weights by class, as in scikit-learn.
        random_state: ties, and the start of Lanczos.
        n_jobs: threads that share the columns; the tree is the same for any number.

    Attributes:
        tree_: the `otr.ObliqueTree`; its labels are positions in `classes_`.
        classes_: (n_classes,) the classes, sorted.
    """

    _parameter_constraints: ClassVar[Constraints] = {**_Hhcart._parameter_constraints, "class_weight": CLASS_WEIGHT}

    class_weight: ClassWeight = None

    def fit(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> HHCARTClassifier:
        """Fit on X (n, d) and classes y (n,); `sample_weight` (n,) counts a row as that many."""
        X, labels, weights = self._checked_fit(X, y, sample_weight)
        one_hot = np.eye(len(self.classes_))[labels]
        groups = [labels == k for k in range(len(self.classes_))]
        Y = one_hot[:, :1] if len(self.classes_) == 2 else one_hot  # for two classes, half of it says it all
        tree = _Grower(X, Y, weights, groups, self).tree(one_hot)
        return self._take(class_tree(tree, tree.c), X, one_hot, weights)


class HHCARTRegressor(_Hhcart, GrownRegressor):
    """HHCART for regression: as `HHCARTClassifier`, with squared error, and one reflection a node.

    The 2016 paper is about classes. As in the code that LCN's authors compared with, a regression node has one
    reflection, from the covariance of all its inputs; targets play no part in it. With several targets the squared
    errors are added, each target divided by its variance over the training rows.

    A level of the tree costs O(d n log n) for the sorts of n rows, and O(s d n) for s Lanczos products.

    Args:
        max_depth, min_samples_split, min_samples_leaf, random_state, n_jobs: as in `HHCARTClassifier`.

    Attributes:
        tree_: the `otr.ObliqueTree`.
    """

    def fit(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> HHCARTRegressor:
        """Fit on X (n, d) and targets y, (n,) or (n, o); `sample_weight` (n,) counts a row as that many."""
        X, targets, weights = self._checked_fit(X, y, sample_weight)
        mean, scale = mean_and_divisor(targets, weights)
        Y = (targets - mean) / scale
        everyone = [np.ones(len(X), dtype=np.bool_)]
        return self._take(_Grower(X, Y, weights, everyone, self).tree(targets), X, targets, weights)
