"""What every fitted learner answers of its tree, under scikit-learn's names."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator
from sklearn.utils.validation import check_is_fitted, validate_data

from otr.core.arrays import IntArray
from otr.core.pattern_tree import PatternTree
from otr.core.tree import ObliqueTree

if TYPE_CHECKING:
    from scipy import sparse

# Bits are kept in float32 where the caller gives them so: half the memory, and no bit is lost.
FLOATS = [np.float64, np.float32]


class TreeAnswers(BaseEstimator):  # type: ignore[misc]
    """Depth, leaves and paths of `tree_`, the tree of a fitted estimator of one label."""

    n_features_in_: int

    def get_depth(self) -> int:
        """Return the number of tests on the longest path of `tree_`."""
        tree = self._fitted_tree()
        return tree.n_bits if isinstance(tree, PatternTree) else tree.depth

    def get_n_leaves(self) -> int:
        """Return the number of leaves of `tree_`."""
        tree = self._fitted_tree()
        return tree.n_paths if isinstance(tree, PatternTree) else tree.n_leaves

    def apply(self, X: ArrayLike) -> IntArray:
        """Return the leaf of `tree_` that each row of X (n, d) ends in: (n,) int64, from 0 to n_leaves - 1."""
        return self._explicit_tree().apply(self._checked(X))

    def decision_path(self, X: ArrayLike) -> sparse.csr_matrix:
        """Return the test nodes of `tree_` that each row passes: a sparse 0/1 matrix (n, n_nodes).

        Leaves have their own numbers (`apply`) and no column, unlike in scikit-learn's trees.
        """
        return self._explicit_tree().decision_path(self._checked(X))

    def _fitted_tree(self) -> Any:
        check_is_fitted(self)
        return self.tree_

    def _explicit_tree(self) -> ObliqueTree:
        tree = self._fitted_tree()
        if isinstance(tree, PatternTree):
            raise ValueError(
                f"the tree has {tree.n_paths:,} leaves and is held as activation patterns, which have no numbers; "
                "prune(X) returns the tree of the paths that rows take, or fit with fewer neurons or more max_leaves"
            )
        return tree  # type: ignore[no-any-return]

    def _checked(self, X: ArrayLike) -> NDArray[Any]:
        check_is_fitted(self)
        return np.asarray(validate_data(self, X, reset=False, dtype=FLOATS))

    def _named(self, tree: ObliqueTree) -> ObliqueTree:
        return with_names_of(self, tree)


def with_names_of(estimator: BaseEstimator, tree: ObliqueTree) -> ObliqueTree:
    """Return the tree with the names of the columns and classes that a scikit-learn estimator was fitted on."""
    columns, classes = getattr(estimator, "feature_names_in_", None), getattr(estimator, "classes_", None)
    if columns is not None:
        tree = tree.replace(feature_names=columns.tolist())
    # A label is a position among the classes; where it is the class itself, it needs no name.
    if classes is None or np.array_equal(classes, np.arange(len(classes))):
        return tree
    gives_classes = (tree.labels is not None or tree.head.gives_labels) and len(classes) == tree.n_answers
    return tree.replace(output_names=[str(name) for name in classes.tolist()]) if gives_classes else tree
