"""LCN: oblique trees with constant leaves from the derivatives of ReLU networks (Lee & Jaakkola, ICLR 2020)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import ClassVar, Literal

import numpy as np

from otr.core.tree import ObliqueTree
from otr.learners.base.parameters import (
    AT_LEAST_1,
    CLASS_WEIGHT,
    SEED,
    STANDARDIZE,
    Constraints,
    parameters_of,
    some_of,
)
from otr.learners.base.problem import Problem
from otr.learners.base.tree_per_label import NetworkLearner, TreeClassifier, TreeRegressor
from otr.learners.base.weights import ClassWeight
from otr.learners.networks.batched_lcn import LcnSettings
from otr.learners.networks.batched_training import Schedule, schedule_of
from otr.learners.networks.labels_and_seeds import TrainedNetworks, train_many
from otr.learners.networks.lcn_network import LcnNetwork


@dataclass(eq=False, repr=False)
class _LCNLearner(NetworkLearner):
    _parameter_constraints: ClassVar[Constraints] = {
        **some_of(LcnSettings, "depth", "hidden", "drop_connect"),
        **some_of(Schedule, "batch_size", "learning_rate", "momentum"),
        "epochs": [AT_LEAST_1, None],
        "decay_every": [AT_LEAST_1, None],
        "standardize": STANDARDIZE,
        "max_leaves": [AT_LEAST_1],
        "random_state": SEED,
    }

    depth: int = 6
    _: KW_ONLY
    hidden: int = 0
    drop_connect: float = 0.0
    epochs: int | None = None
    batch_size: int = 64
    learning_rate: float = 0.03
    momentum: float = 0.9
    decay_every: int | None = None
    standardize: bool | Literal["auto"] = "auto"
    max_leaves: int = 2**12
    random_state: int | np.random.RandomState | None = None

    def _train(self, problem: Problem, seeds: Sequence[int]) -> TrainedNetworks[LcnNetwork]:
        if 2**self.depth > self.max_leaves:
            raise ValueError(
                f"depth is {self.depth}, a tree of 2**{self.depth} leaves; the limit max_leaves is {self.max_leaves}"
            )
        settings = LcnSettings(
            **parameters_of(self, LcnSettings),
            loss=problem.loss,
            n_classes=problem.n_classes,
            schedule=schedule_of(self, len(problem.X)),
        )
        return train_many(
            problem.X,
            problem.Y,
            seeds,
            settings,
            sample_weight=problem.label_weights,
            X_valid=problem.X_valid,
            Y_valid=problem.Y_valid,
        )

    def _unscaled(self, network: LcnNetwork, problem: Problem, y_mean: float, y_scale: float) -> LcnNetwork:
        return network.with_input_scaling(problem.mean, problem.scale).with_output_scaling(y_mean, y_scale)

    def _tree_of(self, network: LcnNetwork) -> ObliqueTree:
        return network.to_tree(max_leaves=self.max_leaves)


@dataclass(eq=False, repr=False, kw_only=True)
class LCNClassifier(TreeClassifier, _LCNLearner):
    """Classifier of locally constant networks, as oblique trees with constant leaves.

    `tree_` has 2**depth leaves, each a constant, and computes what `network_` computes. `fit_seeds` trains many seeds
    together.

    Args:
        depth: neurons, one a layer.
        hidden: width of the hidden layer of g; 0 for a linear g.
        drop_connect: see `LcnSettings`.
        epochs: passes over the rows; None for as many as make 1,000 steps, and 30 at least.
        decay_every: see `Schedule`; None for a third of the epochs.
        batch_size, learning_rate, momentum: see `Schedule`.
        standardize: train on inputs shifted and scaled to mean 0 and deviation 1, which is folded into the network;
            "auto": unless all are 0 and 1.
        max_leaves: refuse to train for a larger tree.
        class_weight: None, "balanced" or weights by class, as in scikit-learn, for each label.
        random_state: an integer is the seed as in `train_many`.

    Attributes:
        networks_, network_: the trained networks, or the one.
        trees_, tree_: the trees, or the one.
        best_epochs_, validation_scores_: one entry a label.
    """

    _parameter_constraints: ClassVar[Constraints] = {**_LCNLearner._parameter_constraints, "class_weight": CLASS_WEIGHT}

    class_weight: ClassWeight = None


class LCNRegressor(TreeRegressor, _LCNLearner):
    """Regressor of locally constant networks, as oblique trees with constant leaves; all else as in `LCNClassifier`."""
