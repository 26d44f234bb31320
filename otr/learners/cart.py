"""CART: scikit-learn's axis-aligned trees, held as oblique trees whose normals are unit vectors."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.tree import BaseDecisionTree, DecisionTreeClassifier, DecisionTreeRegressor
from sklearn.utils.validation import check_is_fitted

from otr.core.tree import ObliqueTree
from otr.learners.base.column_units import Units
from otr.learners.base.parameters import CLASS_WEIGHT, Constraints, some_of
from otr.learners.base.single_tree import GrownClassifier, GrownRegressor, class_tree
from otr.learners.base.tree_answers import with_names_of
from otr.learners.base.weights import ClassWeight


def from_sklearn_tree(model: BaseDecisionTree) -> ObliqueTree:
    """Return the tree of a fitted scikit-learn `DecisionTreeClassifier` or `DecisionTreeRegressor`.

    ``x_f <= t`` becomes ``e_f @ x - t <= 0``. A classifier's leaf holds the class shares (scikit-learn's
    `predict_proba`), and its label is a position in ``model.classes_``; a regressor's holds the values of its outputs.
    scikit-learn rounds inputs to float32 before it tests them and the tree does not: the two answer alike wherever
    that rounding crosses no threshold, so on everything that float32 can hold. Rules for missing values (NaN), which
    no `ObliqueTree` takes, are left out; a test for these alone, whose threshold is infinite, has no inputs
    and sends every state where scikit-learn sends values that are not missing. The names of columns and classes go with
    the tree.

    Args:
        model: the fitted tree; an `ExtraTree` is one, too.

    Raises:
        TypeError: not a decision tree of scikit-learn.
        ValueError: a classifier of several outputs.
        sklearn.exceptions.NotFittedError: not fitted.
    """
    if not isinstance(model, BaseDecisionTree):
        raise TypeError(f"model is a {type(model).__name__}, expected a DecisionTreeClassifier or -Regressor")
    check_is_fitted(model)
    is_classifier = isinstance(model, DecisionTreeClassifier)
    if is_classifier and model.n_outputs_ > 1:
        raise ValueError(f"the classifier has {model.n_outputs_} outputs; fit and convert one tree for each")
    source, n_inputs = model.tree_, int(model.n_features_in_)
    is_leaf = source.children_left < 0
    nodes, leaves = np.flatnonzero(~is_leaf), np.flatnonzero(is_leaf)
    reference = np.empty(source.node_count, dtype=np.int64)
    reference[nodes] = np.arange(len(nodes))
    reference[leaves] = ~np.arange(len(leaves))
    threshold, P = source.threshold[nodes], np.zeros((len(nodes), n_inputs))
    is_finite = np.isfinite(threshold)
    P[np.arange(len(nodes)), source.feature[nodes]] = is_finite
    v = np.where(is_finite, -threshold, -np.sign(threshold))
    values = source.value[leaves]  # (n_leaves, n_outputs, n_classes), the last being 1 in a regression tree
    values = values[:, 0, :] if is_classifier else values[:, :, 0]
    left, right = reference[source.children_left[nodes]], reference[source.children_right[nodes]]
    tree = ObliqueTree(left, right, P, v, np.zeros((*values.shape, n_inputs)), values)
    return with_names_of(model, class_tree(tree, values) if is_classifier else tree)


def grow_cart(
    model: BaseDecisionTree, X: NDArray[Any], targets: NDArray[Any], weights: NDArray[Any] | None
) -> ObliqueTree:
    """Fit scikit-learn's tree in units in which it distinguishes values (`Units`), and return it in those of the data.

    Args:
        model: the `DecisionTreeClassifier` or `DecisionTreeRegressor`; it is left fitted to data in the other units.
        X, targets, weights: rows (n, d), labels (n,) or values (n, o), and weights (n,) or None.
    """
    units = Units.of(X)
    if isinstance(model, DecisionTreeClassifier):
        return units.restored_tests(from_sklearn_tree(model.fit(units.changed(X), targets, weights)))
    of_targets = Units.of(targets, jointly=True)
    model.set_params(ccp_alpha=float(np.ldexp(model.ccp_alpha, 2 * of_targets.exponent[0])))  # a squared target
    tree = from_sklearn_tree(model.fit(units.changed(X), of_targets.changed(targets), weights))
    return units.restored_tests(tree.replace(c=of_targets.restored(tree.c)))


@dataclass(eq=False, repr=False)
class _Cart:
    """The parameters of both."""

    _parameter_constraints: ClassVar[Constraints] = some_of(
        DecisionTreeClassifier, "max_depth", "min_samples_leaf", "max_leaf_nodes", "ccp_alpha", "random_state"
    )

    _: KW_ONLY
    max_depth: int | None = None
    min_samples_leaf: int = 1
    max_leaf_nodes: int | None = None
    ccp_alpha: float = 0.0
    random_state: Any = None


@dataclass(eq=False, repr=False, kw_only=True)
class CARTClassifier(_Cart, GrownClassifier):
    """CART classifier (Breiman et al. 1984) by scikit-learn, Gini impurity.

    Columns that scikit-learn's float32 would not resolve are shifted and scaled for it (`grow_cart`).

    Cost: O(d n log n) for each level of the tree.

    Args:
        max_depth, min_samples_leaf, max_leaf_nodes, ccp_alpha, random_state: as in scikit-learn's
            `DecisionTreeClassifier`; `random_state` decides between splits of equal gain.
        class_weight: None, "balanced" or weights by class, as in scikit-learn.

    Attributes:
        tree_: the `otr.ObliqueTree`; its labels are positions in `classes_`.
        classes_: (n_classes,) the classes, sorted.

    Examples:
        >>> X, y = [[0.0, 1.0], [1.0, 0.0], [2.0, 2.0], [3.0, 1.0]], ["low", "low", "high", "high"]
        >>> fitted = otr.learners.CARTClassifier(max_depth=1, random_state=0).fit(X, y)
        >>> fitted.predict([[0.5, 0.5], [2.5, 0.5]])
        array(['low', 'high'], dtype='<U4')
        >>> print(otr.to_text(fitted.tree_, feature_names=["x", "y"], output_names=fitted.classes_))
        if -1.5 + x <= 0 then
            return low
        else
            return high
    """

    _parameter_constraints: ClassVar[Constraints] = {**_Cart._parameter_constraints, "class_weight": CLASS_WEIGHT}

    class_weight: ClassWeight = None

    def fit(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> CARTClassifier:
        """Fit on X (n, d) and classes y (n,); `sample_weight` (n,) counts a row as that many."""
        X, labels, weights = self._checked_fit(X, y, sample_weight)
        parameters = self.get_params() | {"class_weight": None}  # it is in the weights
        tree = grow_cart(DecisionTreeClassifier(**parameters), X, labels, weights)
        return self._take(tree, X, np.eye(len(self.classes_))[labels], weights)


class CARTRegressor(_Cart, GrownRegressor):
    """CART regressor (Breiman et al. 1984) by scikit-learn, squared error, one or several targets.

    Columns and targets that scikit-learn would not resolve are shifted and scaled for it (`grow_cart`).

    Cost: O(d n log n) for each level of the tree.

    Args:
        max_depth, min_samples_leaf, max_leaf_nodes, ccp_alpha, random_state: as in scikit-learn's
            `DecisionTreeRegressor`; `random_state` decides between splits of equal gain.

    Attributes:
        tree_: the `otr.ObliqueTree`.
    """

    def fit(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> CARTRegressor:
        """Fit on X (n, d) and targets y, (n,) or (n, o); `sample_weight` (n,) counts a row as that many."""
        X, targets, weights = self._checked_fit(X, y, sample_weight)
        tree = grow_cart(DecisionTreeRegressor(**self.get_params()), X, targets, weights)
        return self._take(tree, X, targets, weights)
