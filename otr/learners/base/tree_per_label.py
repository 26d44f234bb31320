"""Base of the learners of one tree for every label, networks and linear models: scikit-learn's contract.

The learners that grow a tree are built on `otr/learners/base/single_tree.py`.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from numbers import Integral
from typing import Any, Literal, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import ClassifierMixin, RegressorMixin
from sklearn.utils import check_array, check_random_state
from sklearn.utils.multiclass import type_of_target
from sklearn.utils.validation import check_is_fitted, column_or_1d, validate_data

from otr.core.arrays import FloatArray
from otr.core.pattern_tree import PatternTree
from otr.core.pruning import prune_unreached
from otr.core.tree import ObliqueTree
from otr.learners.base.classes import check_labels
from otr.learners.base.problem import Problem
from otr.learners.base.tree_answers import TreeAnswers
from otr.learners.base.weights import ClassWeight, class_weighted, counted_rows

Validation = tuple[ArrayLike, ArrayLike] | None
Thing = TypeVar("Thing")


class TreeLearner(TreeAnswers, ABC):
    """Base of the estimators that hold one tree for every label.

    Attributes:
        trees_: one tree a label.
        tree_: the tree, where there is one label.
        n_features_in_: number of inputs.
    """

    standardize: bool | Literal["auto"]
    trees_: list[ObliqueTree | PatternTree]

    def fit(
        self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None, *, validation: Validation = None
    ) -> Self:
        """Fit the trees.

        Args:
            X: (n, d).
            y: (n,) labels of two or more classes or targets; or (n, L) of several labels, 0, 1 and NaN where one is
                missing, or of several targets.
            sample_weight: (n,), 0 or more: as how many rows each one counts in the loss and in standardising; None for
                one each. Networks take them in the mean over mini-batches, and exactly where all rows are one batch.
                A classifier's `class_weight` multiplies them in the loss of each label, by the label's own classes.
            validation: (X, y) of rows on which the best epoch is chosen; without, the last is kept.

        Raises:
            ValueError: a parameter that is not what it may be, y of one class only, a label that all rows lack, shapes
                that do not agree, weights that are negative or all 0, or those of classes that are none.
        """
        _require_pair(validation)
        self._fit_problem(self._problem(X, y, sample_weight, validation))
        return self

    @property
    def tree_(self) -> ObliqueTree | PatternTree:
        """The tree of an estimator of one label."""
        return _only(self.trees_, "tree")

    @abstractmethod
    def _problem(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None, validation: Validation) -> Problem:
        """Check the data, set what follows from it, such as `classes_`, and return the problem."""

    @abstractmethod
    def _fit_problem(self, problem: Problem) -> None:
        """Set `trees_`, in terms of the inputs and targets as they were before standardising."""

    def prune(self, X: ArrayLike) -> list[ObliqueTree]:
        """Return, for every label, the tree of the paths that the rows X (n, d) reach: OTR-hat.

        Raises:
            sklearn.exceptions.NotFittedError: before `fit`.
        """
        check_is_fitted(self)
        rows = validate_data(self, X, dtype=np.float64, reset=False)
        return [self._with_names(prune_unreached(tree, rows)) for tree in self.trees_]

    def _with_names(self, tree: ObliqueTree | PatternTree) -> Any:
        """Return a tree with the columns' and classes' names; activation patterns have none."""
        return tree if isinstance(tree, PatternTree) else self._named(tree)

    def _outputs(self, X: ArrayLike) -> FloatArray:
        """Return the leaves' outputs: (n, L, o)."""
        check_is_fitted(self)
        rows = validate_data(self, X, dtype=np.float64, reset=False)
        return np.stack([tree.forward(rows) for tree in self.trees_], axis=1)

    def _standardised(self, problem: Problem, validation: Validation, encoded_valid: FloatArray | None) -> Problem:
        """Return the problem with its validation rows, inputs and targets shifted and scaled as is asked."""
        if validation is not None:
            problem.X_valid = validate_data(self, validation[0], dtype=np.float64, reset=False)
            problem.Y_valid = encoded_valid
            if encoded_valid is not None and len(encoded_valid) != len(problem.X_valid):
                raise ValueError(f"validation has {len(problem.X_valid)} rows of X and {len(encoded_valid)} of y")
            if encoded_valid is not None and encoded_valid.shape[1] != problem.Y.shape[1]:
                given, wanted = encoded_valid.shape[1], problem.Y.shape[1]
                raise ValueError(f"y of validation has {given} columns, and y has {wanted}")
        are_bits = ((problem.X == 0) | (problem.X == 1)).all()
        if not are_bits if self.standardize == "auto" else self.standardize:
            problem.standardise_inputs()
        if problem.loss in ("squared", "poisson"):
            problem.standardise_targets()
        return problem


def _require_pair(validation: Validation) -> None:
    if validation is not None and (not isinstance(validation, tuple | list) or len(validation) != 2):
        raise ValueError("validation is no pair (X, y); its rows all count alike, so that it takes no weights")


class NetworkLearner(TreeLearner):
    """Base of the learners of networks, which many labels and seeds train together."""

    random_state: int | np.random.RandomState | None
    networks_: list[Any]

    @property
    def network_(self) -> Any:
        """The network of an estimator of one label."""
        return _only(self.networks_, "network")

    def fit_seeds(
        self,
        X: ArrayLike,
        y: ArrayLike,
        seeds: Sequence[int],
        *,
        sample_weight: ArrayLike | None = None,
        validation: Validation = None,
    ) -> list[Self]:
        """Return an estimator fitted with each seed as its `random_state`, all of them trained as one batched model.

        Each comes out as `fit` alone would make it, up to rounding; this one stays as it is. Arguments and errors are
        those of `fit`.
        """
        _require_pair(validation)
        if not len(seeds):
            raise ValueError("seeds is empty; give one at least")
        first = copy.copy(self)  # which gets the data, and not this estimator
        problem = first._problem(X, y, sample_weight, validation)
        trained = first._train(problem, seeds)
        fitted = []
        for position, seed in enumerate(seeds):
            one = copy.copy(first)
            one.random_state = seed
            one._take(trained, position, problem)
            fitted.append(one)
        return fitted

    def _fit_problem(self, problem: Problem) -> None:
        self._take(self._train(problem, [seed_of(self.random_state)]), 0, problem)

    def _take(self, trained: Any, position: int, problem: Problem) -> None:
        """Set the fitted attributes from the networks of the seed at this position."""
        scales = zip(trained.networks, problem.y_mean, problem.y_scale, strict=True)
        self.networks_ = [self._unscaled(of_label[position], problem, *scale) for of_label, *scale in scales]
        self.best_epochs_, self.validation_scores_ = trained.epochs[:, position], trained.scores[:, position]
        self.trees_ = [self._with_names(self._tree_of(network)) for network in self.networks_]

    @abstractmethod
    def _train(self, problem: Problem, seeds: Sequence[int]) -> Any:
        """Return the `TrainedNetworks` of all labels and seeds."""

    @abstractmethod
    def _unscaled(self, network: Any, problem: Problem, y_mean: float, y_scale: float) -> Any:
        """Return the network that takes inputs and gives targets as they were before standardising."""

    @abstractmethod
    def _tree_of(self, network: Any) -> ObliqueTree | PatternTree:
        """Return the tree that computes what the network does."""


class TreeClassifier(ClassifierMixin, TreeLearner):  # type: ignore[misc]
    """Base of the classifiers: binary, multi-class, and multi-label with one tree a label.

    Multi-label targets are 0 and 1, (n, L); NaN is a missing label, and its row is left out for that label.
    """

    class_weight: ClassWeight
    classes_: NDArray[Any]

    def _problem(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None, validation: Validation) -> Problem:
        self._validate_params()
        shape = np.asarray(y).shape
        multilabel = len(shape) == 2 and shape[1] > 1
        rows: FloatArray
        if multilabel:
            rows = validate_data(self, X, dtype=np.float64)
            encode = self._encode_labels
            Y = encode(y)
            if len(Y) != len(rows):
                raise ValueError(f"X has {len(rows)} rows and y {len(Y)}")
            rows, Y, weights = counted_rows(rows, Y, sample_weight)
            missing = np.isnan(Y).all(axis=0)
            if missing.any():
                raise ValueError(f"label {int(np.argmax(missing))} of y is missing in all rows; leave the label out")
            self.classes_ = np.arange(Y.shape[1])
        else:
            rows, labels = validate_data(self, X, y, dtype=np.float64)
            labels = column_or_1d(labels, warn=True)
            check_labels(labels)
            rows, labels, weights = counted_rows(rows, labels, sample_weight)
            self.classes_ = np.unique(labels)
            if len(self.classes_) < 2:
                only_class = self.classes_.tolist()[0]
                raise ValueError(f"y has the one class {only_class!r}; a classifier needs at least two classes")
            encode = self._encode_classes
            Y = encode(labels)
        self.multilabel_ = multilabel
        loss: Any = "softmax" if not multilabel and len(self.classes_) > 2 else "logistic"
        problem = Problem(rows, Y, loss, weights)
        problem.n_classes = len(self.classes_)
        if self.class_weight is not None:
            problem.label_weights = self._label_weights(problem.weights, Y)
        return self._standardised(problem, validation, None if validation is None else encode(validation[1]))

    def _label_weights(self, weights: FloatArray | None, Y: FloatArray) -> FloatArray:
        """Return the weights (n, L) of the rows of each label, 0 where it is missing."""
        by_label = np.zeros(Y.shape)
        for column, of_label in zip(Y.T, by_label.T, strict=True):
            present = ~np.isnan(column)
            labels = column[present].astype(np.int64)
            names = labels if self.multilabel_ else self.classes_[labels]
            of_label[present] = class_weighted(None if weights is None else weights[present], self.class_weight, names)
        return by_label

    def _encode_labels(self, y: ArrayLike) -> FloatArray:
        Y: FloatArray = check_array(y, dtype=np.float64, ensure_all_finite="allow-nan", input_name="y")
        if not np.isin(Y[~np.isnan(Y)], (0.0, 1.0)).all():
            kind = type_of_target(np.nan_to_num(Y))
            raise ValueError(f"y has several columns and is of type {kind!r}; multi-label targets are 0, 1 and NaN")
        return Y

    def _encode_classes(self, y: ArrayLike) -> FloatArray:
        labels = column_or_1d(y)
        unknown = np.setdiff1d(labels, self.classes_)
        if len(unknown):
            raise ValueError(f"validation has the class {unknown[:1].tolist()[0]!r}, which y does not have")
        numbers: FloatArray = np.searchsorted(self.classes_, labels).astype(np.float64)[:, None]
        return numbers

    def decision_function(self, X: ArrayLike) -> FloatArray:
        """Return the leaves' outputs, logits: (n,) for two classes, (n, c) for c classes or labels."""
        outputs = self._outputs(X)
        if self.multilabel_:
            return outputs[:, :, 0]
        return outputs[:, 0, 0] if len(self.classes_) == 2 else outputs[:, 0]

    def predict_proba(self, X: ArrayLike) -> FloatArray:
        """Return the probabilities of the leaves' outputs: (n, c) of classes, or (n, L) of ones of the labels."""
        logits = self.decision_function(X)
        if not self.multilabel_ and logits.ndim == 2:
            odds = np.exp(logits - logits.max(axis=1, keepdims=True))
            shares: FloatArray = odds / odds.sum(axis=1, keepdims=True)
            return shares
        ones = np.exp(-np.logaddexp(0.0, -logits))
        return ones if self.multilabel_ else np.column_stack((1 - ones, ones))

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Return the labels that the trees answer: (n,) of the classes, or (n, L) of 0 and 1."""
        check_is_fitted(self)
        rows = validate_data(self, X, dtype=np.float64, reset=False)
        answers = np.stack([tree.predict(rows) for tree in self.trees_], axis=1)
        return answers if self.multilabel_ else np.asarray(self.classes_[answers[:, 0]])

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.classifier_tags.multi_label = True
        tags.target_tags.single_output = True
        return tags


class TreeRegressor(RegressorMixin, TreeLearner):  # type: ignore[misc]
    """Base of the regressors, with one tree a target."""

    loss: Literal["squared_error", "poisson"] = "squared_error"

    def _problem(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None, validation: Validation) -> Problem:
        self._validate_params()
        rows, targets = validate_data(self, X, y, dtype=np.float64, multi_output=True, y_numeric=True)
        targets = np.asarray(targets, dtype=np.float64)
        if targets.ndim == 2 and targets.shape[1] == 1:
            targets = column_or_1d(targets, warn=True)
        self.one_target_ = targets.ndim == 1
        encoded = None
        if validation is not None:
            encoded = check_array(validation[1], ensure_2d=False, dtype=np.float64, input_name="y of validation")
        rows, targets, weights = counted_rows(rows, targets, sample_weight)
        if self.loss == "poisson":
            _check_counts(targets, "y")
            _check_counts(encoded, "y of validation")
        loss: Any = "poisson" if self.loss == "poisson" else "squared"
        problem = Problem(rows, _columns(targets), loss, weights)
        return self._standardised(problem, validation, None if encoded is None else _columns(encoded))

    def predict(self, X: ArrayLike) -> FloatArray:
        """Return the trees' answers, which are expected counts under loss="poisson": (n,), or (n, L) for several."""
        check_is_fitted(self)
        rows = validate_data(self, X, dtype=np.float64, reset=False)
        answers: FloatArray = np.concatenate([tree.predict(rows) for tree in self.trees_], axis=1)
        return answers[:, 0] if self.one_target_ else answers

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags


def _check_counts(y: FloatArray | None, name: str) -> None:
    """Raise ValueError unless y is counts, or means of counts, of which each column has one above 0."""
    if y is None:
        return
    if (y < 0).any():
        raise ValueError(f"{name} holds {y.min():g}, and loss='poisson' is for counts, which are 0 or more")
    if name == "y" and not _columns(y).any(axis=0).all():
        raise ValueError(f"{name} is 0 in every row, and the expected count of loss='poisson' is above 0")


def _columns(y: ArrayLike) -> FloatArray:
    Y: FloatArray = np.asarray(y, dtype=np.float64)
    return Y[:, None] if Y.ndim == 1 else Y


def _only(things: list[Thing], what: str) -> Thing:
    """Return the one thing, or raise AttributeError that names the attribute with all of them."""
    if len(things) != 1:
        raise AttributeError(f"there are {len(things)} {what}s, one for each label; see {what}s_")
    return things[0]


def seed_of(random_state: int | np.random.RandomState | None) -> int:
    """Return an integer seed: `random_state` itself where it is one, else a number drawn from it."""
    if isinstance(random_state, Integral):
        return int(random_state)
    return int(check_random_state(random_state).randint(2**31 - 1))
