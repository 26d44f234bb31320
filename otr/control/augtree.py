"""AugTree: CART on a state and an oracle's hidden units, run under DAgger and written on the state (Orfanos 2023)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from otr.control.dagger.row_sampling import draw_rows
from otr.control.features.binned import quantised, with_thresholds_between
from otr.control.features.hidden_units import AffineFeatures, deep_features, first_layer_features
from otr.control.features.screening import best_columns
from otr.control.settings import AugTreeSettings
from otr.control.viper import centred, fit_cart, with_head
from otr.core.arrays import FloatArray, IntArray
from otr.core.network import ReluNetwork
from otr.core.smooth_network import Oracle
from otr.core.tree import ObliqueTree
from otr.learners.model_tree import LinearTreeRegressor, grow_models
from otr.setting import Checked

# Columns that are searched in full: those with the best results of a few thresholds on some rows.
_N_SEARCHED = 8


@dataclass(frozen=True, eq=False)
class AugTreeFit(AugTreeSettings, Checked):
    """AugTree's fit: a tree whose tests are axis-aligned on features A x + a, and so oblique on x.

    The features are the oracle's first pre-activations z_1 and, unless left out, x itself; ``"deep"`` adds those of
    deeper layers, written in x for the most frequent activation patterns of the drawn rows (`deep_features`). Those
    that are constant, or another one's multiple but for a shift, are dropped, as they add no test.

    Constant leaves: CART, by scikit-learn, on the features in at most 255 bins of about equally many rows, which
    halves its time; thresholds are midway between the values of the drawn rows on either side. Linear leaves: the
    models of `otr.learners.LinearTreeRegressor`, in x alone, as a model in A x + a is one in x; at each node the
    features that promise most are searched (`best_columns`). Labels: see `LinearModelTreeFit`.

    Attributes:
        oracle: the network that is imitated.
        max_depth: number of tests on the features on a path at most; an argmax over linear leaves adds its own.
    """

    oracle: Oracle
    max_depth: int

    def __post_init__(self) -> None:
        """Raise ValueError for a setting out of its range, or an oracle without the hidden layers that it needs."""
        super().__post_init__()
        n_needed = 2 if self.features == "deep" else 1
        if self.features == "deep" and not isinstance(self.oracle, ReluNetwork):
            raise ValueError("features='deep' reads activation patterns, which an oracle of smooth units has none of")
        if len(self.oracle.hidden_widths) < n_needed:
            raise ValueError(
                f"features={self.features!r} needs an oracle of at least {n_needed} hidden layers, "
                f"this one has {len(self.oracle.hidden_widths)}"
            )

    def __call__(
        self, X: FloatArray, answers: FloatArray, weights: FloatArray | None, generator: np.random.Generator
    ) -> ObliqueTree:
        """Return the tree for states X (n, d) and what `run_dagger` says of them."""
        rows, counts = draw_rows(len(X), weights if self.weighted else None, self.max_samples, generator)
        states, targets = np.asarray(X[rows]), np.asarray(answers[rows])
        has_labels = weights is not None
        features = self._features(states).resolved(states)
        values = features.values(states)
        if self.leaves == "linear":
            return self._linear(features, values, states, centred(targets) if has_labels else targets, counts)
        bins = quantised(values)
        tree = fit_cart(
            bins,
            targets.argmax(axis=1) if has_labels else targets,
            counts,
            answers.shape[1],
            self.max_depth,
            self.min_samples_leaf,
            generator,
            self.criterion,
        )
        return with_thresholds_between(tree, bins, values).compose(features.A, features.a)

    def _features(self, states: FloatArray) -> AffineFeatures:
        if self.features != "deep" or not isinstance(self.oracle, ReluNetwork):
            return self._first_layer
        deep = deep_features(self.oracle, states, self.max_patterns)
        return self._first_layer.joined(deep).distinct()

    @cached_property
    def _first_layer(self) -> AffineFeatures:
        return first_layer_features(self.oracle, include_inputs=self.features != "z").distinct()

    def _linear(
        self,
        features: AffineFeatures,
        values: NDArray[np.float32],
        states: FloatArray,
        targets: FloatArray,
        counts: IntArray,
    ) -> ObliqueTree:
        options = LinearTreeRegressor(max_depth=self.max_depth, min_samples_leaf=max(10, self.min_samples_leaf))
        S = np.repeat(values.T, counts, axis=0)

        def searched(rows: IntArray, Z: FloatArray, Y: FloatArray) -> IntArray:
            return best_columns(S[rows], Z, Y, options, _N_SEARCHED)

        states, targets = np.repeat(states, counts, axis=0), np.repeat(targets, counts, axis=0)
        tests, M, c = grow_models(S, states, targets, options, searched)
        P, v = tests.P @ features.A, tests.v + tests.P @ features.a
        tree = ObliqueTree(tests.children_left, tests.children_right, P, v, M, c)
        return with_head(tree, self.oracle.head)
