"""VIPER and LM-VIPER: trees fitted to an oracle's answers, to be run under DAgger (Bastani et al. 2018)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.tree import DecisionTreeClassifier, DecisionTreeRegressor

from otr.control.dagger.row_sampling import draw_rows
from otr.control.label_leaves import decided_leaves
from otr.control.settings import CartSettings, ModelTreeSettings
from otr.core.arrays import FloatArray, IntArray
from otr.core.head import Head
from otr.core.tree import ObliqueTree
from otr.learners.base.single_tree import class_tree
from otr.learners.cart import grow_cart
from otr.learners.model_tree import LinearTreeRegressor
from otr.setting import Checked, Criterion


@dataclass(frozen=True)
class CartFit(CartSettings, Checked):
    """VIPER's fit: CART by scikit-learn on the rows that `draw_rows` draws.

    Labels: a classification tree on the resampled rows, a row that was drawn k times counting k times.
    Continuous actions: a regression tree on a subsample, unweighted.

    Attributes:
        max_depth: number of axis-aligned tests on a path at most.
    """

    max_depth: int

    def __call__(
        self, X: FloatArray, answers: FloatArray, weights: FloatArray | None, generator: np.random.Generator
    ) -> ObliqueTree:
        """Return the tree for states X (n, d) and what `run_dagger` says of them."""
        rows, counts = draw_rows(len(X), weights if self.weighted else None, self.max_samples, generator)
        targets = answers[rows] if weights is None else answers[rows].argmax(axis=1)
        return fit_cart(
            X[rows], targets, counts, answers.shape[1], self.max_depth, self.min_samples_leaf, generator, self.criterion
        )


@dataclass(frozen=True)
class LinearModelTreeFit(ModelTreeSettings, Checked):
    """LM-VIPER's fit: axis-aligned tests over affine leaves, by `otr.learners.LinearTreeRegressor`.

    Continuous actions: the leaves are fitted to the oracle's actions and their values clipped to its box. Labels: the
    leaves are fitted to the oracle's centred outputs on the resampled rows, and answer the label of the largest one
    (`argmax_leaves`).

    Attributes:
        head: the oracle's: `Argmax`, `TanhBox` or `ClipBox`.
        max_depth: number of axis-aligned tests on a path at most.
    """

    head: Head
    max_depth: int

    def __call__(
        self, X: FloatArray, answers: FloatArray, weights: FloatArray | None, generator: np.random.Generator
    ) -> ObliqueTree:
        """Return the tree for states X (n, d) and what `run_dagger` says of them."""
        rows, counts = draw_rows(len(X), weights, self.max_samples, generator)
        targets = answers[rows] if weights is None else centred(answers[rows])
        learner = LinearTreeRegressor(
            max_depth=self.max_depth, min_samples_leaf=self.min_samples_leaf, alpha=self.alpha
        )
        tree = learner.fit(np.repeat(X[rows], counts, axis=0), np.repeat(targets, counts, axis=0)).tree_
        return with_head(tree, self.head)


def fit_cart(
    X: FloatArray | NDArray[np.float32],
    targets: FloatArray | IntArray,
    counts: IntArray,
    n_outputs: int,
    max_depth: int,
    min_samples_leaf: int,
    generator: np.random.Generator,
    criterion: Criterion = "gini",
) -> ObliqueTree:
    """Return CART's tree: a classifier for integer labels (n,) among `n_outputs`, a regressor for values (n, o).

    The criterion is that of labels; values are fitted by squared error.
    """
    is_labels = targets.ndim == 1
    learner = DecisionTreeClassifier if is_labels else DecisionTreeRegressor
    model = learner(
        criterion=criterion if is_labels else "squared_error",
        max_depth=max_depth,
        min_samples_leaf=min_samples_leaf,
        random_state=int(generator.integers(2**31)),
    )
    tree = grow_cart(model, X, targets, counts)
    if not is_labels:
        return tree
    shares = np.zeros((tree.n_leaves, n_outputs))  # 0 for labels that no row has
    shares[:, model.classes_] = tree.c
    return class_tree(tree, shares)


def centred(outputs: FloatArray) -> FloatArray:
    """Return the outputs (n, o) less their mean over the o labels, which leaves the argmax as it is."""
    return np.asarray(outputs - outputs.mean(axis=1, keepdims=True))


def with_head(tree: ObliqueTree, head: Head) -> ObliqueTree:
    """Return the tree of affine leaves that answers under an oracle's head: an argmax, or values clipped to its box."""
    return decided_leaves(tree, head if head.gives_labels else box_of(head))


def box_of(head: Head) -> Head:
    """Return the head that clips actions to the box of a head; raise TypeError if it has none."""
    box = head.clip() if head.acts_by_output else None
    if box is None:
        raise TypeError(f"the head is {head!r}, expected Argmax, TanhBox or ClipBox")
    return box
