"""Distillation: a forest, alone or with a linear model, labels rows with probabilities for one small network to learn.

A forest is more accurate than a tree grown on the same rows and can label other rows, too.
Breiman & Shang ("Born again trees", 1996) and Bucila et al. ("Model compression", 2006) let an ensemble label rows made
up from the training rows, and fit one small model to these; Hinton et al. ("Distilling the knowledge in a neural
network", 2015) take its probabilities for targets instead of its decisions. Here the small model is a ReLU network,
hence an oblique tree: `distillation_set` makes rows and targets, on which `train_many` trains with the logistic loss.

The forest answers for the rows that it was grown on, too. Targets from the trees that have not seen a row (out of bag)
were tried on the molecules: the students validate worse on SIDER, by .03 to .04, and alike on Bace.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_matrix
from sklearn.ensemble import ExtraTreesRegressor, RandomForestRegressor
from sklearn.linear_model import LogisticRegression
from sklearn.utils._param_validation import StrOptions

from otr.core.arrays import FloatArray
from otr.learners.base.column_units import Units
from otr.learners.base.parameters import AT_LEAST_0, POSITIVE, SHARE, Constraints, Settings, some_of

_MAX_DENSITY = 0.03  # up to it scikit-learn grows trees faster on sparse rows, on 33,000 molecules seven times
_FORESTS = {"extra_trees": ExtraTreesRegressor, "random_forest": RandomForestRegressor}


@dataclass(frozen=True)
class Teacher(Settings):
    """A forest and what it is asked.

    Attributes:
        forest: "extra_trees" (Geurts et al. 2006) or "random_forest" (Breiman 2001).
        joint: one forest for all labels, whose splits serve the sum of their impurities; a missing label counts as the
            label's mean. Otherwise a forest for each label, grown on the rows that have it.
        n_estimators: trees of a forest.
        min_samples_leaf, max_features: as in scikit-learn; larger leaves give softer probabilities.
        max_samples: rows drawn for a tree, with replacement: a share of them, or their number. None for as many as
            there are (random forest) or for all rows, each once (extra trees).
        n_copies: altered copies of every row, in addition to the row itself.
        alteration: binary inputs: share of a copy's ones that are dropped. Others: share of a copy's entries that are
            replaced by the same input of a row drawn at random.
        weight_of_linear: the teacher's probability is this times that of a logistic regression, one a label on the rows
            that have it, plus the rest times the forest's. The two err differently.
        C: of the logistic regression, inverse strength of its penalty.
        weight_of_labels: the target is this times the row's own label plus the rest times the teacher's probability.
    """

    _parameter_constraints: ClassVar[Constraints] = {
        "forest": [StrOptions(set(_FORESTS))],
        "joint": ["boolean"],
        **some_of(RandomForestRegressor, "n_estimators", "min_samples_leaf", "max_features", "max_samples"),
        "n_copies": [AT_LEAST_0],
        "alteration": [SHARE],
        "weight_of_linear": [SHARE],
        "C": [POSITIVE],
        "weight_of_labels": [SHARE],
    }

    forest: Literal["extra_trees", "random_forest"] = "extra_trees"
    joint: bool = False
    n_estimators: int = 300
    min_samples_leaf: int = 2
    max_features: Literal["sqrt", "log2"] | float | None = "sqrt"
    max_samples: float | int | None = None
    n_copies: int = 5
    alteration: float = 0.2
    weight_of_linear: float = 0.0
    C: float = 0.1
    weight_of_labels: float = 0.0

    def new_forest(self, seed: int, n_jobs: int | None) -> Any:
        """Return a forest that is not fitted: squared error on labels 0 and 1 is half the Gini impurity."""
        return _FORESTS[self.forest](
            self.n_estimators,
            min_samples_leaf=self.min_samples_leaf,
            max_features=self.max_features,
            max_samples=self.max_samples,
            bootstrap=self.forest == "random_forest" or self.max_samples is not None,
            n_jobs=n_jobs,
            random_state=seed,
        )


@dataclass(frozen=True)
class FittedTeacher:
    """What `fit_teacher` returns: the forests and logistic regressions that a teacher's probabilities come from."""

    forests: list[Any]  # one for all labels, or one a label
    linear: list[Any]  # a logistic regression a label, or the one class that a label has; none without their weight
    weight_of_linear: float
    units: Units  # in which both read rows

    def predict_proba(self, X: NDArray[Any]) -> FloatArray:
        """Return the probability (n, L) of class 1 for each label, of rows X (n, d)."""
        X = self.units.changed(X)
        answers = [_mean_answers(forest.estimators_, X) for forest in self.forests]
        probabilities: FloatArray = np.concatenate(answers, axis=1).clip(0.0, 1.0)
        if self.linear:
            linear = [np.full(len(X), model) if isinstance(model, float) else model.predict_proba(X)[:, 1]
                      for model in self.linear]  # fmt: skip
            probabilities += self.weight_of_linear * (np.stack(linear, axis=1) - probabilities)
        return probabilities


def fit_teacher(
    X: ArrayLike, Y: ArrayLike, teacher: Teacher | None = None, *, seed: int = 0, n_jobs: int | None = None
) -> FittedTeacher:
    """Return the teacher of `distillation_set`; arguments and errors are the same."""
    teacher = Teacher() if teacher is None else teacher
    rows, labels = _checked(X, Y)
    for_forests = np.random.SeedSequence(seed).spawn(5)[3]
    present = ~np.isnan(labels)
    if teacher.joint:
        groups = [(np.where(present, labels, np.nanmean(labels, axis=0)), np.ones(len(rows), dtype=np.bool_))]
    else:
        groups = [(labels[:, [label]], present[:, label]) for label in range(labels.shape[1])]
    units = Units.of(rows)
    forests, growing = [], _for_growing(units.changed(rows))
    for (of_group, is_seen), forest_seed in zip(groups, for_forests.generate_state(len(groups)), strict=True):
        forest = teacher.new_forest(int(forest_seed), n_jobs)
        goals = of_group[is_seen]
        forests.append(forest.fit(growing[is_seen], goals[:, 0] if goals.shape[1] == 1 else goals))
    linear = _linear_models(growing, labels, teacher.C) if teacher.weight_of_linear else []
    return FittedTeacher(forests, linear, teacher.weight_of_linear, units)


def distillation_set(
    X: ArrayLike, Y: ArrayLike, teacher: Teacher | None = None, *, seed: int = 0, n_jobs: int | None = None
) -> tuple[NDArray[Any], FloatArray]:
    """Return the rows with altered copies of them, and the probabilities a forest gives them.

    Every row gets a target for every label, also those that it lacked. A label of one class has that class for target.

    Cost: growing the trees, O(sqrt(d) n log^2 n) each, and (1 + n_copies) n ways through every tree. A hundred trees
    for 33,000 molecules (HIV) and one copy of them take 20 to 30 s on one core.

    Args:
        X: (n, d), of any numbers; where all are 0 and 1, so are those of the copies.
        Y: (n, L) or (n,): 0, 1, and NaN where a label is missing.
        teacher: the forest and what it is asked; None for the defaults.
        seed: an integer >= 0, of all that is random.
        n_jobs: threads that grow trees, None for one; the result does not depend on it.

    Returns:
        Rows ((1 + n_copies) n, d) of X's dtype, of which the first n are X; and targets ((1 + n_copies) n, L) in
        [0, 1], for `otr.learners.networks.labels_and_seeds.train_many` with the logistic loss.

    Raises:
        ValueError: shapes do not agree, Y holds something else, or a label has no rows.
    """
    teacher = Teacher() if teacher is None else teacher
    rows, labels = _checked(X, Y)
    # A student of the same seed has the first three streams, see `SeedStreams`; the forests have the fourth.
    for_copies = np.random.SeedSequence(seed).spawn(5)[4]
    parts = [rows, *_altered_copies(rows, teacher, np.random.default_rng(for_copies))]
    fitted = fit_teacher(rows, labels, teacher, seed=seed, n_jobs=n_jobs)
    probabilities = np.concatenate([fitted.predict_proba(part) for part in parts])
    targets = np.tile(labels, (1 + teacher.n_copies, 1))
    mixed = (1 - teacher.weight_of_labels) * probabilities + teacher.weight_of_labels * targets
    return np.concatenate(parts), np.where(np.isnan(targets), probabilities, mixed)


def _checked(X: ArrayLike, Y: ArrayLike) -> tuple[NDArray[Any], FloatArray]:
    rows, labels = np.asarray(X), np.asarray(Y, dtype=np.float64)
    labels = labels[:, None] if labels.ndim == 1 else labels
    if rows.ndim != 2 or labels.ndim != 2 or len(rows) != len(labels) or not rows.size or not labels.size:
        raise ValueError(f"X has shape {rows.shape} and Y {labels.shape}, expected (n, d) and (n, L) with n > 0")
    present = ~np.isnan(labels)
    strange = labels[present & (labels != 0) & (labels != 1)]
    if len(strange):
        raise ValueError(f"Y has the value {strange[0]}; distillation takes binary labels, 0, 1 and NaN for missing")
    if not present.any(axis=0).all():
        raise ValueError(f"label {int(np.argmin(present.any(axis=0)))} is missing in all rows; leave the label out")
    return rows, labels


def _altered_copies(rows: NDArray[Any], teacher: Teacher, stream: np.random.Generator) -> list[NDArray[Any]]:
    """Return `n_copies` arrays like `rows`."""
    is_binary = bool(((rows == 0) | (rows == 1)).all())
    copies = []
    for _ in range(teacher.n_copies):
        altered = stream.random(rows.shape, dtype=np.float32) < teacher.alteration
        if is_binary:
            others = np.zeros_like(rows)
        else:
            others = rows[stream.integers(len(rows), size=rows.shape), np.arange(rows.shape[1])]
        copies.append(np.where(altered, others, rows))
    return copies


def _for_growing(rows: NDArray[Any]) -> Any:
    """Return the rows as float32, sparse where few entries are not zero; the trees are the same."""
    of_forests = rows.astype(np.float32)
    return csr_matrix(of_forests) if (rows != 0).mean() <= _MAX_DENSITY else of_forests


def _linear_models(growing: Any, labels: FloatArray, C: float) -> list[Any]:
    """Return a logistic regression for each label on the rows that have it, or its class where it has one alone."""
    models: list[Any] = []
    for label in labels.T:
        present = ~np.isnan(label)
        is_one = len(np.unique(label[present])) == 1
        known = label[present]
        models.append(
            float(known[0]) if is_one else LogisticRegression(C=C, max_iter=1000).fit(growing[present], known)
        )
    return models


def _mean_answers(trees: list[Any], rows: NDArray[Any]) -> FloatArray:
    """Return the mean (n, L) of the trees' answers, summed in their order whatever the number of threads."""
    rows = rows.astype(np.float32)
    total: FloatArray = sum(tree.predict(rows, check_input=False) for tree in trees)
    return (total / len(trees)).reshape(len(rows), -1)
