"""The tree of depth 0: linear models by scikit-learn, the baseline of every tree."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import KW_ONLY, dataclass
from typing import ClassVar, Literal

import numpy as np
from sklearn.linear_model import LogisticRegression, Ridge

from otr.core.arrays import FloatArray
from otr.core.head import Head
from otr.core.heads import Argmax, Identity, Sign
from otr.core.tree import ObliqueTree
from otr.learners.base.parameters import (
    AT_LEAST_1,
    CLASS_WEIGHT,
    NOT_NEGATIVE,
    POSITIVE,
    STANDARDIZE,
    Constraints,
)
from otr.learners.base.problem import Problem
from otr.learners.base.tree_per_label import TreeClassifier, TreeLearner, TreeRegressor
from otr.learners.base.weights import ClassWeight


class _LinearLearner(TreeLearner):
    def _fit_problem(self, problem: Problem) -> None:
        trees = []
        for label, (y_mean, y_scale) in enumerate(zip(problem.y_mean, problem.y_scale, strict=True)):
            present = ~np.isnan(problem.Y[:, label])
            weights = None if problem.label_weights is None else problem.label_weights[present, label]
            W, b, head = self._fit_linear(problem.X[present], problem.Y[present, label], weights, problem.loss)
            # Back to inputs and targets as they were before standardising.
            W = W * y_scale / problem.scale
            trees.append(_one_leaf(W, b * y_scale + y_mean - W @ problem.mean, head))
        self.trees_ = [self._named(tree) for tree in trees]

    @abstractmethod
    def _fit_linear(
        self, X: FloatArray, y: FloatArray, weights: FloatArray | None, loss: str
    ) -> tuple[FloatArray, FloatArray, Head]:
        """Return coefficients, intercepts and head of one label's linear model."""


@dataclass(eq=False, repr=False)
class LinearTreeClassifier(TreeClassifier, _LinearLearner):
    """Logistic regression with an L2 penalty, as a tree of depth 0.

    `fit` takes validation rows as the other learners do, and has no use for them.

    Args:
        C: inverse strength of the penalty.
        max_iter: of the solver.
        standardize: fit on inputs shifted and scaled to mean 0 and deviation 1; "auto": unless all are 0 and 1.
        class_weight: None, "balanced" or weights by class, as in scikit-learn, for each label.

    Attributes:
        trees_, tree_: the trees, one a label, or the one.
        n_iter_: iterations of the solver, the most of all labels.
    """

    _parameter_constraints: ClassVar[Constraints] = {
        "C": [POSITIVE],
        "max_iter": [AT_LEAST_1],
        "standardize": STANDARDIZE,
        "class_weight": CLASS_WEIGHT,
    }

    C: float = 0.1
    _: KW_ONLY
    max_iter: int = 1000
    standardize: bool | Literal["auto"] = "auto"
    class_weight: ClassWeight = None

    def _fit_problem(self, problem: Problem) -> None:
        self.n_iter_ = 0
        super()._fit_problem(problem)

    def _fit_linear(
        self, X: FloatArray, y: FloatArray, weights: FloatArray | None, loss: str
    ) -> tuple[FloatArray, FloatArray, Head]:
        if len(np.unique(y)) < 2:
            raise ValueError("a label has one class only among its training rows; leave the label out")
        model = LogisticRegression(C=self.C, max_iter=self.max_iter).fit(X, y, weights)
        self.n_iter_ = max(self.n_iter_, int(model.n_iter_.max()))
        return model.coef_, model.intercept_, Sign() if loss == "logistic" else Argmax()


class LinearTreeRegressor(TreeRegressor, _LinearLearner):
    """Ridge regression, as a tree of depth 0.

    `fit` takes validation rows as the other learners do, and has no use for them.

    Args:
        alpha: strength of the penalty, for standardised targets.
        standardize: as in `LinearTreeClassifier`.

    Attributes:
        trees_, tree_: the trees, one a target, or the one.
    """

    _parameter_constraints: ClassVar[Constraints] = {"alpha": [NOT_NEGATIVE], "standardize": STANDARDIZE}

    def __init__(self, alpha: float = 1.0, *, standardize: bool | Literal["auto"] = "auto") -> None:
        self.alpha = alpha
        self.standardize = standardize

    def _fit_linear(
        self, X: FloatArray, y: FloatArray, weights: FloatArray | None, loss: str
    ) -> tuple[FloatArray, FloatArray, Head]:
        model = Ridge(alpha=self.alpha).fit(X, y, weights)
        return model.coef_[None], np.atleast_1d(model.intercept_), Identity()


def _one_leaf(coefficients: FloatArray, intercepts: FloatArray, head: Head) -> ObliqueTree:
    """Return the tree of one leaf, ``coefficients @ x + intercepts``, (o, d) and (o,)."""
    d = coefficients.shape[1]
    none = np.zeros(0, dtype=np.int64)
    return ObliqueTree(none, none, np.zeros((0, d)), np.zeros(0), coefficients[None], intercepts[None], head=head)
