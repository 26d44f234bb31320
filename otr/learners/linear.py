"""Trees with a linear classifier in every leaf: of depth 0, logistic regression, the baseline of every tree."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import ClassVar, Literal

import numpy as np
from sklearn.linear_model import LogisticRegression

from otr.core.arrays import FloatArray, IntArray
from otr.core.heads import Argmax, Sign
from otr.core.pattern_tree import PatternTree
from otr.core.tree import ObliqueTree
from otr.learners.base.parameters import (
    AT_LEAST_0,
    AT_LEAST_1,
    CLASS_WEIGHT,
    POSITIVE,
    STANDARDIZE,
    Constraints,
)
from otr.learners.base.problem import Problem
from otr.learners.base.tree_per_label import TreeClassifier
from otr.learners.base.weights import ClassWeight
from otr.learners.growing.greedy import Skeleton
from otr.learners.model_tree import LinearTreeRegressor, grow_models

_ODDS = 0.01  # of a class that a leaf lacks, compared with those of its rarest class


@dataclass(eq=False, repr=False)
class LinearTreeClassifier(TreeClassifier):
    """Axis-aligned tests with a logistic regression in every leaf, L2 penalty; of depth 0 that regression alone.

    The tests are those of `LinearTreeRegressor` on the classes' indicators, so chosen that linear models below them fit
    best; each leaf's regression is then fitted to its rows. A class that a leaf lacks has a hundredth of the odds of
    its rarest class. `fit` takes validation rows as the other learners do, and has no use for them.

    Args:
        C: inverse strength of the penalty.
        max_depth: number of tests on a path at most; 0 for logistic regression.
        min_samples_leaf: rows in a leaf at least, whatever their weights.
        max_iter: of the solver.
        standardize: fit on inputs shifted and scaled to mean 0 and deviation 1; "auto": unless all are 0 and 1.
        class_weight: None, "balanced" or weights by class, as in scikit-learn, for each label.

    Attributes:
        trees_, tree_: the trees, one a label, or the one, with affine leaves.
        n_iter_: iterations of the solver, the most of all leaves.
    """

    _parameter_constraints: ClassVar[Constraints] = {
        "C": [POSITIVE],
        "max_depth": [AT_LEAST_0],
        "min_samples_leaf": [AT_LEAST_1],
        "max_iter": [AT_LEAST_1],
        "standardize": STANDARDIZE,
        "class_weight": CLASS_WEIGHT,
    }

    C: float = 0.1
    _: KW_ONLY
    max_depth: int = 3
    min_samples_leaf: int = 10
    max_iter: int = 1000
    standardize: bool | Literal["auto"] = "auto"
    class_weight: ClassWeight = None

    def _fit_problem(self, problem: Problem) -> None:
        self.n_iter_ = 0
        trees: list[ObliqueTree | PatternTree] = []
        for label in range(problem.Y.shape[1]):
            present = ~np.isnan(problem.Y[:, label])
            weights = None if problem.label_weights is None else problem.label_weights[present, label]
            rows, classes = problem.X[present], problem.Y[present, label].astype(np.int64)
            trees.append(self._named(self._tree(rows, classes, weights, problem)))
        self.trees_ = trees

    def _tree(self, X: FloatArray, y: IntArray, weights: FloatArray | None, problem: Problem) -> ObliqueTree:
        """Return the tree of standardised inputs (n, d) and classes (n,), in the inputs as they were before."""
        if len(np.unique(y)) < 2:
            raise ValueError("a label has one class only among its training rows; leave the label out")
        n_classes = 2 if problem.loss == "logistic" else problem.n_classes  # of several labels that is their number
        tests = self._tests(X, np.eye(n_classes)[y], weights)
        models = [
            self._model(X[rows], y[rows], None if weights is None else weights[rows], n_classes)
            for rows in tests.leaf_rows
        ]
        M = np.stack([W for W, _ in models]) / problem.scale
        c = np.stack([b for _, b in models]) - M @ problem.mean
        column = tests.P.argmax(axis=1)  # of unit vectors
        v = tests.v * problem.scale[column] - problem.mean[column]
        if problem.loss == "logistic":
            M, c = M[:, 1:] - M[:, :1], c[:, 1:] - c[:, :1]
        head = Sign() if problem.loss == "logistic" else Argmax()
        return ObliqueTree(tests.children_left, tests.children_right, tests.P, v, M, c, head=head)

    def _tests(self, X: FloatArray, indicators: FloatArray, weights: FloatArray | None) -> Skeleton:
        options = LinearTreeRegressor(max_depth=self.max_depth, min_samples_leaf=self.min_samples_leaf)
        every = np.arange(X.shape[1])
        return grow_models(X, X, indicators, options, lambda *_: every, weights)[0]

    def _model(
        self, X: FloatArray, y: IntArray, weights: FloatArray | None, n_classes: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return the logits' coefficients (n_classes, d) and intercepts (n_classes,) of a leaf's rows."""
        sums = np.bincount(y, weights, minlength=n_classes)
        classes = np.flatnonzero(sums)
        W, b = np.zeros((len(classes), X.shape[1])), np.zeros(len(classes))
        if len(classes) > 1:
            model = LogisticRegression(C=self.C, max_iter=self.max_iter).fit(X, y, weights)
            self.n_iter_ = max(self.n_iter_, int(model.n_iter_.max()))
            # Of two classes scikit-learn has the second one's logit alone.
            W[-len(model.coef_) :], b[-len(model.coef_) :] = model.coef_, model.intercept_
        rarest = sums[classes].argmin()
        all_W, all_b = np.tile(W[rarest], (n_classes, 1)), np.full(n_classes, b[rarest] + np.log(_ODDS))
        all_W[classes], all_b[classes] = W, b
        return all_W, all_b
