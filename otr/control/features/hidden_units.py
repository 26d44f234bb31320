"""Affine features of a state that a network's hidden units give."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import BoolArray, FloatArray
from otr.core.black_box import BlackBox
from otr.core.network import ReluNetwork
from otr.core.smooth_network import Oracle
from otr.learners.base.column_units import Units

# Unit normals count as the same where they agree to this many decimals.
_DECIMALS = 10


@dataclass(frozen=True)
class AffineFeatures:
    """The m features A x + a of a state x, with A (m, d) and a (m,)."""

    A: FloatArray
    a: FloatArray

    def values(self, X: FloatArray) -> NDArray[np.float32]:
        """Return the features of states X (n, d), feature by feature: (m, n) float32, for a learner."""
        return (self.A @ X.T + self.a[:, None]).astype(np.float32)

    def resolved(self, X: FloatArray) -> AffineFeatures:
        """Return the features, each less its offset on X (n, d) where that would hide its differences in float32."""
        return AffineFeatures(self.A, self.a - Units.of(X @ self.A.T + self.a).shift)

    def joined(self, other: AffineFeatures) -> AffineFeatures:
        """Return these features and then the other ones."""
        return AffineFeatures(np.concatenate((self.A, other.A)), np.concatenate((self.a, other.a)))

    def distinct(self) -> AffineFeatures:
        """Return the features that do not equal a factor times an earlier one plus a constant, in their order.

        One that is dropped gives the same tests ``feature <= threshold`` as the one that is kept, but for the side of
        states on the boundary; one that is constant gives none.
        """
        norms = np.linalg.norm(self.A, axis=1)
        varies = np.flatnonzero(norms > 0)
        units = self.A[varies] / norms[varies, None]
        largest = units[np.arange(len(units)), np.abs(units).argmax(axis=1)]
        # Adding 0.0 makes -0.0 the same bytes as 0.0.
        rounded = np.round(units * np.sign(largest)[:, None], _DECIMALS) + 0.0
        first = np.unique(rounded, axis=0, return_index=True)[1]
        kept = varies[np.sort(first)]
        return AffineFeatures(self.A[kept], self.a[kept])


def first_layer_features(network: Oracle, *, include_inputs: bool) -> AffineFeatures:
    """Return x (d), where included, and z_1 = W_1 x + b_1 (n_1)."""
    if isinstance(network, BlackBox):
        first = AffineFeatures(network.first_layer[:, :-1], network.first_layer[:, -1])
    else:
        first = AffineFeatures(network.weights[0], network.biases[0])
    d = network.n_inputs
    return AffineFeatures(np.eye(d), np.zeros(d)).joined(first) if include_inputs else first


def deep_features(network: ReluNetwork, X: FloatArray, max_patterns: int) -> AffineFeatures:
    """Return the pre-activations of the layers after the first, as functions of x where earlier neurons have a pattern.

    For layer l and activation pattern p of the layers before it, z_l^p(x) = W_l (p * z_(l-1)^p(x)) + b_l is affine, and
    is z_l(x) where x has that pattern. Of the patterns that the states X (n, d) show before each layer, the
    `max_patterns` most frequent ones are taken (ties: in the order of their bits), which gives at most max_patterns
    (n_2 + ... + n_L) features, layer after layer. Orfanos (2023) counts 2^(n_1) n_2 of them for the second layer; those
    of patterns that no state shows never come up.
    """
    patterns = network.patterns(X)
    starts = network.unit_form().layer_starts
    parts_A, parts_a = [], []
    for start, stop in pairwise(starts[1:]):
        frequent = _most_frequent(patterns[:, :start], max_patterns)
        forms, offsets = unit_forms(network, frequent, stop)
        parts_A.append(forms[:, start:].reshape(-1, network.n_inputs))
        parts_a.append(offsets[:, start:].ravel())
    return AffineFeatures(np.concatenate(parts_A), np.concatenate(parts_a))


def unit_forms(network: ReluNetwork, patterns: BoolArray, n_units: int) -> tuple[FloatArray, FloatArray]:
    """Return the first hidden neurons' pre-activations, ``forms[i, j] @ x + offsets[i, j]`` under activation pattern i.

    `patterns` (k, p) are those of all neurons that the first `n_units` read; forms are (k, n_units, d).
    """
    units = network.unit_form()
    k = len(patterns)
    forms = np.empty((k, n_units, network.n_inputs))
    offsets = np.empty((k, n_units))
    factors = np.where(patterns, 1.0, network.negative_slope)
    for start, stop in pairwise(units.layer_starts):
        if start >= n_units:
            break
        links = units.links[start:stop, :start] * factors[:, None, :start]  # (k, n_l, start)
        forms[:, start:stop] = links @ forms[:, :start] + units.inputs[start:stop]
        offsets[:, start:stop] = (links @ offsets[:, :start, None])[..., 0] + units.offsets[start:stop]
    return forms, offsets


def _most_frequent(patterns: BoolArray, k: int) -> BoolArray:
    """Return the k most frequent rows, or all distinct ones."""
    packed, counts = np.unique(np.packbits(patterns, axis=1), axis=0, return_counts=True)
    chosen = packed[np.argsort(-counts, kind="stable")[:k]]
    return np.unpackbits(chosen, axis=1, count=patterns.shape[1]).view(np.bool_)
