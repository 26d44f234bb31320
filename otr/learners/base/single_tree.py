"""Base of the learners that grow one tree: checks of the data, predictions through `tree_`, class shares in leaves.

The learners of several labels at once, networks and linear models, are built on `otr.learners.base.tree_per_label`.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import ClassifierMixin, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import validate_data

from otr.core.arrays import FloatArray, IntArray
from otr.core.heads import Argmax
from otr.core.tree import ObliqueTree
from otr.learners.base.classes import check_labels
from otr.learners.base.importances import importances_of
from otr.learners.base.tree_answers import FLOATS, TreeAnswers
from otr.learners.base.weights import ClassWeight, class_weighted, counted_rows


class _GrownEstimator(TreeAnswers):
    """An estimator that answers through `tree_`.

    Attributes:
        tree_: the tree.
        feature_importances_: (n_features,) the inputs' shares in the fall of impurity at the tests (`importances_of`);
            of leaves that are affine it says nothing.
    """

    tree_: ObliqueTree
    feature_importances_: FloatArray

    def _take(self, tree: ObliqueTree, X: NDArray[Any], targets: FloatArray, weights: FloatArray | None) -> Self:
        """Set the fitted attributes from the tree of the rows X, targets (n, o) or indicators, and weights."""
        self.tree_ = self._named(tree)
        self.feature_importances_ = importances_of(tree, X, targets, weights)
        return self


class GrownClassifier(ClassifierMixin, _GrownEstimator):  # type: ignore[misc]
    """A classifier whose `tree_` has class shares in its leaves and positions in `classes_` as labels."""

    class_weight: ClassWeight
    classes_: NDArray[Any]

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Return the classes (n,): the largest share in the leaf, ties to the class that comes first."""
        X = self._checked(X)
        return np.asarray(self.classes_[self.tree_.predict(X)])

    def predict_proba(self, X: ArrayLike) -> FloatArray:
        """Return the training shares (n, n_classes) of the classes in each row's leaf, of rows as they are weighted."""
        X = self._checked(X)
        return np.asarray(self.tree_.c[self.tree_.apply(X)])

    def _checked_fit(
        self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None
    ) -> tuple[NDArray[Any], IntArray, FloatArray | None]:
        """Return the rows that count, each one's position of its class in `classes_`, which is set here, and weight."""
        self._validate_params()
        checked, classes = validate_data(self, X, y, dtype=FLOATS)
        check_labels(classes)
        checked, classes, weights = counted_rows(checked, classes, sample_weight)
        self.classes_, labels = np.unique(classes, return_inverse=True)
        return checked, labels, class_weighted(weights, self.class_weight, classes)


class GrownRegressor(MultiOutputMixin, RegressorMixin, _GrownEstimator):  # type: ignore[misc]
    """A regressor of one target (n,) or several (n, o)."""

    _is_flat: bool

    def predict(self, X: ArrayLike) -> FloatArray:
        """Return the values: (n,) if the targets were given so, else (n, o)."""
        X = self._checked(X)
        values = self.tree_.predict(X)
        return np.asarray(values[:, 0] if self._is_flat else values)

    def _checked_fit(
        self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None
    ) -> tuple[NDArray[Any], FloatArray, FloatArray | None]:
        """Return the rows that count, their targets (n, o) as float64, and weights."""
        self._validate_params()
        checked, values = validate_data(self, X, y, dtype=FLOATS, multi_output=True, y_numeric=True)
        targets: FloatArray = np.asarray(values, dtype=np.float64)
        self._is_flat = targets.ndim == 1
        return counted_rows(checked, targets.reshape(len(targets), -1), sample_weight)


def class_tree(tree: ObliqueTree, shares: FloatArray) -> ObliqueTree:
    """Return `tree`'s tests over leaves with class shares (n_leaves, n_classes) as outputs, their argmax as label."""
    M = np.zeros((*shares.shape, tree.n_inputs))
    head = Argmax()
    return tree.replace(M=M, c=shares, labels=head(shares), head=head)
