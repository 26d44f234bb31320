"""AugTree: axis-aligned trees on inputs and a network's hidden units, which are oblique trees on the inputs."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPClassifier, MLPRegressor
from sklearn.tree import DecisionTreeClassifier, DecisionTreeRegressor
from sklearn.utils._param_validation import StrOptions
from sklearn.utils.validation import check_random_state

from otr.core.arrays import FloatArray
from otr.core.network import ReluNetwork
from otr.importers import from_sklearn
from otr.learners.base.column_units import Units
from otr.learners.base.parameters import AT_LEAST_1, CLASS_WEIGHT, Constraints, Widths, some_of
from otr.learners.base.single_tree import GrownClassifier, GrownRegressor
from otr.learners.base.weights import ClassWeight, mean_and_divisor
from otr.learners.cart import grow_cart
from otr.learners.model_tree import LinearTreeRegressor


class _AugTree:
    """What both have: the network, and the inputs x~ = A x + a of the tree."""

    network: ReluNetwork | None
    hidden_layer_sizes: Sequence[int] | int
    mlp_max_iter: int
    include_inputs: bool

    _parameter_constraints: ClassVar[Constraints] = {
        "network": [ReluNetwork, None],
        "hidden_layer_sizes": [Widths(), AT_LEAST_1],
        "mlp_max_iter": [AT_LEAST_1],
        "include_inputs": ["boolean"],
        **some_of(DecisionTreeClassifier, "max_depth", "random_state"),
    }

    def _augmentation(
        self,
        mlp_class: type,
        X: NDArray[Any],
        y: NDArray[Any],
        weights: FloatArray | None,
        random_state: np.random.RandomState,
    ) -> tuple[FloatArray, FloatArray]:
        """Set `network_`, trained where none was given, and return A (m, d) and a (m,)."""
        network = self.network
        if network is None:
            units = Units.of(X)
            Z = units.changed(X)
            size = np.abs(Z).max(axis=0).astype(np.float64)
            size = np.where(size > 0, size, 1.0)
            mlp = mlp_class(
                hidden_layer_sizes=self.hidden_layer_sizes, max_iter=self.mlp_max_iter, random_state=random_state
            )
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ConvergenceWarning)
                mlp.fit(Z / size, y, weights)
            network = from_sklearn(mlp).fold_input_normalisation(units.shift, np.ldexp(size, -units.exponent))
        self.network_, d = network, X.shape[1]
        if network.n_inputs != d or network.n_hidden == 0:
            raise ValueError(
                f"the network reads {network.n_inputs} inputs and has {network.n_hidden} hidden neurons; "
                f"expected {d} inputs, as X has, and at least one hidden neuron"
            )
        W, b = network.weights[0], network.biases[0]
        return (np.concatenate((np.eye(d), W)), np.concatenate((np.zeros(d), b))) if self.include_inputs else (W, b)


@dataclass(eq=False, repr=False)
class AugTreeClassifier(_AugTree, GrownClassifier):
    """Neurally augmented decision tree (Orfanos 2023): CART on x~ = [x, z_1], z_1 = W_1 x + b_1 of a ReLU network.

    A test ``z_1k <= t`` is the oblique test ``W_1[k] @ x + b_1[k] - t <= 0`` on x. Units of deeper layers are no
    affine functions of x and are left out. The thesis's published code reads z_1 after the ReLU; its tests are those
    here with t >= 0.

    Cost: the network's training, if there is none yet, and CART's O((d + n_1) n log n) for each level.

    Args:
        network: the oracle; None to train scikit-learn's `MLPClassifier` on the same data (inputs divided by their
            largest absolute value).
        hidden_layer_sizes: widths of that network.
        mlp_max_iter: epochs of its training at most.
        include_inputs: False for the variant with features z_1 alone.
        max_depth, min_samples_leaf, max_leaf_nodes: the tree's, as in scikit-learn.
        class_weight: None, "balanced" or weights by class, as in scikit-learn; of the network and the tree.
        random_state: the network's training, and splits of equal gain.

    Attributes:
        tree_: the `otr.ObliqueTree` on x; its labels are positions in `classes_`.
        classes_: (n_classes,) the classes, sorted.
        network_: the network whose first layer is read.
    """

    _parameter_constraints: ClassVar[Constraints] = {
        **_AugTree._parameter_constraints,
        **some_of(DecisionTreeClassifier, "min_samples_leaf", "max_leaf_nodes"),
        "class_weight": CLASS_WEIGHT,
    }

    _: KW_ONLY
    network: ReluNetwork | None = None
    hidden_layer_sizes: Sequence[int] = (8,)
    mlp_max_iter: int = 200
    include_inputs: bool = True
    max_depth: int | None = None
    min_samples_leaf: int = 1
    max_leaf_nodes: int | None = None
    class_weight: ClassWeight = None
    random_state: Any = None

    def fit(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> AugTreeClassifier:
        """Fit on X (n, d) and classes y (n,); `sample_weight` (n,) counts a row as that many.

        Raises:
            ValueError: the network reads another number of inputs, or has no hidden layer.
        """
        X, labels, weights = self._checked_fit(X, y, sample_weight)
        random_state = check_random_state(self.random_state)
        A, a = self._augmentation(MLPClassifier, X, labels, weights, random_state)
        cart = DecisionTreeClassifier(
            max_depth=self.max_depth,
            min_samples_leaf=self.min_samples_leaf,
            max_leaf_nodes=self.max_leaf_nodes,
            random_state=random_state,
        )
        tree = grow_cart(cart, X @ A.T + a, labels, weights).compose(A, a)
        return self._take(tree, X, np.eye(len(self.classes_))[labels], weights)


@dataclass(eq=False, repr=False)
class AugTreeRegressor(_AugTree, GrownRegressor):
    """Neurally augmented decision tree for regression: as `AugTreeClassifier`, with constant or linear leaves.

    Linear leaves come from `LinearTreeRegressor` on x~ and are written in x; its cost is in its docstring, with
    d + n_1 inputs.

    Args:
        leaves: "constant", or "linear" for the variant for continuous control.
        min_samples_leaf: None for 1 with constant leaves, and with linear ones for the default of
            `LinearTreeRegressor`.
        network, hidden_layer_sizes, mlp_max_iter, include_inputs, max_depth, random_state: as in `AugTreeClassifier`,
            with scikit-learn's `MLPRegressor` on standardised targets.

    Attributes:
        tree_: the `otr.ObliqueTree` on x.
        network_: the network whose first layer is read.
    """

    _parameter_constraints: ClassVar[Constraints] = {
        **_AugTree._parameter_constraints,
        "leaves": [StrOptions({"constant", "linear"})],
        "min_samples_leaf": [*DecisionTreeRegressor._parameter_constraints["min_samples_leaf"], None],
    }

    _: KW_ONLY
    network: ReluNetwork | None = None
    hidden_layer_sizes: Sequence[int] = (8,)
    mlp_max_iter: int = 200
    include_inputs: bool = True
    leaves: Literal["constant", "linear"] = "constant"
    max_depth: int | None = None
    min_samples_leaf: int | None = None
    random_state: Any = None

    def fit(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> AugTreeRegressor:
        """Fit on X (n, d) and targets y, (n,) or (n, o); `sample_weight` (n,) counts a row as that many.

        Raises:
            ValueError: the network reads another number of inputs or has no hidden layer.
        """
        X, targets, weights = self._checked_fit(X, y, sample_weight)
        random_state = check_random_state(self.random_state)
        mean, scale = mean_and_divisor(targets, weights)
        Y = (targets - mean) / scale
        A, a = self._augmentation(MLPRegressor, X, Y if Y.shape[1] > 1 else Y[:, 0], weights, random_state)
        options = {"max_depth": self.max_depth, "random_state": random_state}
        if self.min_samples_leaf is not None:
            options["min_samples_leaf"] = self.min_samples_leaf
        features = X @ A.T + a
        if self.leaves == "linear":
            tree = LinearTreeRegressor(**options).fit(features, targets, weights).tree_
        else:
            tree = grow_cart(DecisionTreeRegressor(**options), features, targets, weights)
        return self._take(tree.compose(A, a), X, targets, weights)
