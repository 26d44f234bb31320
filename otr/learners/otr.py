"""OTR for data: ReLU networks trained by gradient descent and mapped to oblique trees exactly (Orfanos 2023)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import ClassVar, Literal

import numpy as np
from sklearn.utils._param_validation import StrOptions

from otr.core.arrays import FloatArray
from otr.core.mapping import map_network
from otr.core.network import ReluNetwork
from otr.core.pattern_tree import PatternTree
from otr.core.tree import ObliqueTree
from otr.learners.base.parameters import (
    AT_LEAST_1,
    CLASS_WEIGHT,
    NOT_NEGATIVE,
    SEED,
    STANDARDIZE,
    Constraints,
    parameters_of,
    some_of,
)
from otr.learners.base.problem import Problem
from otr.learners.base.tree_per_label import NetworkLearner, TreeClassifier, TreeRegressor
from otr.learners.base.weights import ClassWeight
from otr.learners.distillation import Teacher, distillation_set
from otr.learners.networks.batched_mlp import MlpSettings
from otr.learners.networks.batched_training import Schedule, schedule_of
from otr.learners.networks.labels_and_seeds import TrainedNetworks, train_many


@dataclass(eq=False, repr=False)
class _OTRLearner(NetworkLearner):
    _parameter_constraints: ClassVar[Constraints] = {
        **some_of(MlpSettings, "hidden", "dense", "negative_slope", "shared", "input_dropout", "hidden_dropout"),
        **some_of(Schedule, "batch_size", "learning_rate", "momentum"),
        **some_of(Schedule, "l1", "l2", "averaging", "common_epoch"),
        "epochs": [AT_LEAST_1, None],
        "decay_every": [AT_LEAST_1, None],
        "drop_below": [NOT_NEGATIVE],
        "teacher": [Teacher, None],
        "standardize": STANDARDIZE,
        "max_leaves": [AT_LEAST_1],
        "random_state": SEED,
    }

    hidden: Sequence[int] = (8,)
    _: KW_ONLY
    dense: bool | Literal["input", "all"] = False
    negative_slope: float = 0.0
    shared: bool = False
    input_dropout: float = 0.0
    hidden_dropout: float = 0.0
    l1: float = 0.0
    l2: float = 0.0
    drop_below: float = 0.0
    averaging: float = 0.0
    common_epoch: bool = False
    teacher: Teacher | None = None
    epochs: int | None = None
    batch_size: int = 64
    learning_rate: float = 0.1
    momentum: float = 0.9
    decay_every: int | None = None
    standardize: bool | Literal["auto"] = "auto"
    max_leaves: int = 1024
    random_state: int | np.random.RandomState | None = None

    def _train(self, problem: Problem, seeds: Sequence[int]) -> TrainedNetworks[ReluNetwork]:
        if self.teacher is None:
            return self._train_on(problem.X, problem.Y, seeds, problem)
        if problem.loss != "logistic":
            raise ValueError(f"a teacher is for binary labels, and the loss here is {problem.loss!r}")
        if problem.label_weights is not None:
            raise ValueError(
                "a teacher's rows have no weights; leave out the teacher, or sample_weight and class_weight"
            )
        taught = (distillation_set(problem.X, problem.Y, self.teacher, seed=seed) for seed in seeds)
        return _joined([self._train_on(*rows, [seed], problem) for seed, rows in zip(seeds, taught, strict=True)])

    def _train_on(
        self, X: FloatArray, Y: FloatArray, seeds: Sequence[int], problem: Problem
    ) -> TrainedNetworks[ReluNetwork]:
        """Return the networks of these rows, the problem's own or a teacher's."""
        settings = MlpSettings(
            **{**parameters_of(self, MlpSettings), "loss": problem.loss},
            n_classes=problem.n_classes,
            schedule=schedule_of(self, len(X)),
        )
        return train_many(
            X,
            Y,
            seeds,
            settings,
            sample_weight=problem.label_weights,
            X_valid=problem.X_valid,
            Y_valid=problem.Y_valid,
        )

    def _unscaled(self, network: ReluNetwork, problem: Problem, y_mean: float, y_scale: float) -> ReluNetwork:
        sparse = _without_small_weights(network, self.drop_below)
        return _with_targets(sparse.fold_input_normalisation(problem.mean, problem.scale), y_mean, y_scale)

    def _tree_of(self, network: ReluNetwork) -> ObliqueTree | PatternTree:
        patterns = PatternTree(network)
        return map_network(network, max_leaves=self.max_leaves) if patterns.n_paths <= self.max_leaves else patterns


def _joined(trained: Sequence[TrainedNetworks[ReluNetwork]]) -> TrainedNetworks[ReluNetwork]:
    """Return the networks of several seeds, trained apart, as one."""
    networks = [[one.networks[label][0] for one in trained] for label in range(len(trained[0].networks))]
    scores = np.concatenate([one.scores for one in trained], axis=1)
    return TrainedNetworks(networks, scores, np.concatenate([one.epochs for one in trained], axis=1))


def _without_small_weights(network: ReluNetwork, limit: float) -> ReluNetwork:
    """Return the network with zeros for weights that are smaller than `limit` in size."""
    if not limit:
        return network
    weights = [np.where(np.abs(weight) < limit, 0.0, weight) for weight in network.weights]
    return network.replace(weights=weights)


def _with_targets(network: ReluNetwork, mean: float, scale: float) -> ReluNetwork:
    """Return the network whose outputs are mean + scale times this one's."""
    if mean == 0.0 and scale == 1.0:
        return network
    *weights, last = network.weights
    *biases, last_bias = network.biases
    return network.replace(weights=[*weights, scale * last], biases=[*biases, scale * last_bias + mean])


@dataclass(eq=False, repr=False, kw_only=True)
class OTRClassifier(TreeClassifier, _OTRLearner):
    """Classifier of ReLU networks mapped to oblique trees exactly (Orfanos 2023, Table 4.2).

    `tree_` is the explicit `ObliqueTree` where it has at most `max_leaves` leaves, else a `PatternTree`; both compute
    what `network_` computes. For several labels at once there is a network and a tree for each, in `networks_` and
    `trees_`. `fit_seeds` trains many seeds together.

    Args:
        hidden: widths of the hidden layers; none is a linear model.
        dense, negative_slope: as in `ReluNetwork`.
        shared: labels or targets share their hidden layers in training, see `MlpSettings`.
        input_dropout, hidden_dropout: share of the inputs, and of the hidden neurons, dropped in training.
        epochs: passes over the rows; None for as many as make 1,000 steps, and 30 at least.
        decay_every: see `Schedule`; None for a third of the epochs.
        l1, l2, averaging, common_epoch, batch_size, learning_rate, momentum: see `Schedule`.
        drop_below: weights smaller than this are set to zero after training; L1 leaves many of 1e-6 and so on.
        teacher: settings of a forest whose probabilities are trained on instead of the labels, see `Teacher` in
            `otr.learners.distillation`; for binary labels. None for the labels themselves.
        standardize: train on inputs shifted and scaled to mean 0 and deviation 1, which is folded into the network;
            "auto": unless all are 0 and 1.
        max_leaves: see above.
        class_weight: None, "balanced" or weights by class, as in scikit-learn, for each label.
        random_state: an integer is the seed as in `train_many`.

    Attributes:
        networks_, network_: the trained networks, or the one.
        trees_, tree_: the trees, or the one.
        best_epochs_, validation_scores_: one entry a label, see `train_many`.

    Examples:
        >>> X = np.random.default_rng(0).uniform(-1, 1, size=(200, 2))
        >>> fitted = otr.learners.OTRClassifier(hidden=[2], random_state=0).fit(X, X.sum(axis=1) > 0)
        >>> fitted.tree_  # two neurons, and the sign of what they sum to
        ObliqueTree(n_leaves=8, depth=3, n_inputs=2, n_outputs=1, head=Sign())
        >>> bool((fitted.tree_.predict(X) == fitted.network_.predict(X)).all())
        True
    """

    _parameter_constraints: ClassVar[Constraints] = {**_OTRLearner._parameter_constraints, "class_weight": CLASS_WEIGHT}

    class_weight: ClassWeight = None


@dataclass(eq=False, repr=False, kw_only=True)
class OTRRegressor(TreeRegressor, _OTRLearner):
    """Regressor of ReLU networks mapped to oblique trees exactly; targets are standardised in training.

    Args:
        loss: "squared_error", or "poisson" for counts, whose tree has the head `Exp`, so that `predict`
            returns the expected count (Orfanos 2023 names this link; scikit-learn's `PoissonRegressor` is its depth 0).
            Where inputs are rare and counts large, the default rate is too high: try learning_rate=0.01.

    All else is as in `OTRClassifier`.
    """

    _parameter_constraints: ClassVar[Constraints] = {
        **_OTRLearner._parameter_constraints,
        "loss": [StrOptions({"squared_error", "poisson"})],
    }

    loss: Literal["squared_error", "poisson"] = "squared_error"
