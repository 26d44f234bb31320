"""LCN: oblique trees with constant leaves from the derivatives of ReLU networks (Lee & Jaakkola, ICLR 2020)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np

from otr.core.tree import ObliqueTree
from otr.learners.base.parameters import AT_LEAST_1, SEED, STANDARDIZE, Constraints, parameters_of, some_of
from otr.learners.base.problem import Problem
from otr.learners.base.tree_per_label import NetworkLearner, TreeClassifier, TreeRegressor
from otr.learners.networks.batched_lcn import LcnSettings
from otr.learners.networks.batched_training import Schedule
from otr.learners.networks.labels_and_seeds import TrainedNetworks, train_many
from otr.learners.networks.lcn_network import LcnNetwork


class _LCNLearner(NetworkLearner):
    networks_: list[LcnNetwork]

    _parameter_constraints: ClassVar[Constraints] = {
        **some_of(LcnSettings, "depth", "hidden", "drop_connect"),
        **some_of(Schedule, "epochs", "batch_size", "learning_rate", "momentum", "decay_every"),
        "standardize": STANDARDIZE,
        "max_leaves": [AT_LEAST_1],
        "random_state": SEED,
    }

    def __init__(
        self,
        depth: int = 6,
        *,
        hidden: int = 0,
        drop_connect: float = 0.0,
        epochs: int = 30,
        batch_size: int = 64,
        learning_rate: float = 0.1,
        momentum: float = 0.9,
        decay_every: int = 10,
        standardize: bool | Literal["auto"] = "auto",
        max_leaves: int = 2**12,
        random_state: int | np.random.RandomState | None = None,
    ) -> None:
        self.depth = depth
        self.hidden = hidden
        self.drop_connect = drop_connect
        self.epochs = epochs
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.momentum = momentum
        self.decay_every = decay_every
        self.standardize = standardize
        self.max_leaves = max_leaves
        self.random_state = random_state

    def _train(self, problem: Problem, seeds: Sequence[int]) -> TrainedNetworks[LcnNetwork]:
        if 2**self.depth > self.max_leaves:
            raise ValueError(
                f"depth is {self.depth}, a tree of 2**{self.depth} leaves; the limit max_leaves is {self.max_leaves}"
            )
        settings = LcnSettings(
            **parameters_of(self, LcnSettings),
            loss=problem.loss,
            n_classes=problem.n_classes,
            schedule=Schedule(**parameters_of(self, Schedule)),
        )
        return train_many(
            problem.X,
            problem.Y,
            seeds,
            settings,
            sample_weight=problem.weights,
            X_valid=problem.X_valid,
            Y_valid=problem.Y_valid,
        )

    def _unscaled(self, network: LcnNetwork, problem: Problem, y_mean: float, y_scale: float) -> LcnNetwork:
        return network.with_input_scaling(problem.mean, problem.scale).with_output_scaling(y_mean, y_scale)

    def _tree_of(self, network: LcnNetwork) -> ObliqueTree:
        return network.to_tree(max_leaves=self.max_leaves)


_PARAMETERS = """

    `tree_` has 2**depth leaves, each a constant, and computes what `network_` computes. `fit_seeds` trains many seeds
    together.

    Args:
        depth: neurons, one a layer.
        hidden: width of the hidden layer of g; 0 for a linear g.
        drop_connect: see `LcnSettings`.
        epochs, batch_size, learning_rate, momentum, decay_every: see `Schedule`.
        standardize: train on inputs shifted and scaled to mean 0 and deviation 1, which is folded into the network;
            "auto": unless all are 0 and 1.
        max_leaves: refuse to train for a larger tree.
        random_state: an integer is the seed as in `train_many`.

    Attributes:
        networks_, network_: the trained networks, or the one.
        trees_, tree_: the trees, or the one.
        best_epochs_, validation_scores_: one entry a label.
    """


class LCNClassifier(TreeClassifier, _LCNLearner):
    __doc__ = "Classifier of locally constant networks, as oblique trees with constant leaves." + _PARAMETERS


class LCNRegressor(TreeRegressor, _LCNLearner):
    __doc__ = "Regressor of locally constant networks, as oblique trees with constant leaves." + _PARAMETERS
