"""Policies of one shape as one batch: each answers its own states, in a few products of stacked arrays."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import BoolArray, FloatArray
from otr.core.head import Head
from otr.core.network import ReluNetwork
from otr.core.tree import ObliqueTree


def stack_policies(policies: Sequence[ObliqueTree] | Sequence[ReluNetwork]) -> TreeStack | NetworkStack:
    """Return k policies that differ in their numbers alone as one.

    Raises:
        ValueError: there is none, or they differ in more.
    """
    if not policies:
        raise ValueError("no policies to stack")
    first = policies[0]
    return NetworkStack(policies) if isinstance(first, ReluNetwork) else TreeStack(policies)  # type: ignore[arg-type]


class NetworkStack:
    """k networks of the same widths, links, slope and head."""

    def __init__(self, networks: Sequence[ReluNetwork]) -> None:
        first = networks[0]
        for network in networks:
            alike = (network.hidden_widths, network.n_inputs, network.n_outputs, network.dense, network.negative_slope)
            expected = (first.hidden_widths, first.n_inputs, first.n_outputs, first.dense, first.negative_slope)
            if alike != expected or network.head != first.head:
                raise ValueError(f"networks of different shapes or heads: {first} and {network}")
        self._head, self._dense, self._slope = first.head, first.dense, first.negative_slope
        layers = range(len(first.weights))
        # Transposed, so that states are rows: (k, columns read, n_l).
        self._weights = [np.stack([network.weights[layer].T for network in networks]) for layer in layers]
        self._biases = [np.stack([network.biases[layer] for network in networks])[:, None] for layer in layers]

    def forward(self, X: FloatArray) -> FloatArray:
        """Return the affine outputs (k, m, o) for m states of each network, X (k, m, d)."""
        read = X  # what the next layer reads: (k, m, columns)
        earlier: list[FloatArray] = []
        for W, b in zip(self._weights[:-1], self._biases[:-1], strict=True):
            z = np.matmul(read, W)
            z += b
            a = np.maximum(z, self._slope * z if self._slope else 0.0, out=z)
            if self._dense == "all":
                earlier.append(a)
                read = np.concatenate((*earlier, X), axis=2)
            else:
                read = a if self._dense is False else np.concatenate((a, X), axis=2)
        outputs: FloatArray = np.matmul(read, self._weights[-1])
        outputs += self._biases[-1]
        return outputs

    def predict(self, X: FloatArray) -> NDArray[Any]:
        """Return the answers (k, m, o), or labels (k, m), for m states of each network, X (k, m, d)."""
        return _answers(self._head, self.forward(X))

    def take(self, rows: BoolArray) -> NetworkStack:
        """Return the stack of some of the networks, rows (k,)."""
        taken = copy.copy(self)
        taken._weights = [W[rows] for W in self._weights]
        taken._biases = [b[rows] for b in self._biases]
        return taken


class TreeStack:
    """k trees of the same structure, labels and head."""

    def __init__(self, trees: Sequence[ObliqueTree]) -> None:
        first = trees[0]
        for tree in trees:
            if not (
                np.array_equal(tree.children_left, first.children_left)
                and np.array_equal(tree.children_right, first.children_right)
                and tree.M.shape == first.M.shape
                and _same_labels(tree, first)
                and tree.head == first.head
            ):
                raise ValueError(f"trees of different structure, labels or heads: {first} and {tree}")
        self._head, self._labels, self._depth = first.head, first.labels, first.depth
        self._left, self._right = first.children_left, first.children_right
        self._P = np.stack([tree.P.T for tree in trees])  # (k, d, n_nodes)
        self._v = np.stack([tree.v for tree in trees])[:, None]
        self._M = np.stack([tree.M for tree in trees])  # (k, n_leaves, o, d)
        self._c = np.stack([tree.c for tree in trees])
        self._rows = np.arange(len(trees))[:, None]

    def apply(self, X: FloatArray) -> NDArray[np.int64]:
        """Return the leaves (k, m) that m states of each tree end in, X (k, m, d)."""
        k, m, _ = X.shape
        if not self._depth:
            return np.zeros((k, m), dtype=np.int64)
        goes_left = (np.matmul(X, self._P) + self._v <= 0.0).reshape(k * m, -1)
        every = np.arange(k * m)
        at = np.zeros(k * m, dtype=np.int64)  # a test node, or ~leaf
        for _ in range(self._depth):
            node = np.maximum(at, 0)
            at = np.where(at < 0, at, np.where(goes_left[every, node], self._left[node], self._right[node]))
        return ~at.reshape(k, m)

    def predict(self, X: FloatArray) -> NDArray[Any]:
        """Return the answers (k, m, o), or labels (k, m), for m states of each tree, X (k, m, d)."""
        leaves = self.apply(X)
        if self._labels is not None:
            return np.asarray(self._labels[leaves])
        maps = self._M[self._rows, leaves]  # (k, m, o, d)
        return _answers(self._head, np.matmul(maps, X[..., None])[..., 0] + self._c[self._rows, leaves])

    def take(self, rows: BoolArray) -> TreeStack:
        """Return the stack of some of the trees, rows (k,)."""
        taken = copy.copy(self)
        taken._P, taken._v, taken._M, taken._c = self._P[rows], self._v[rows], self._M[rows], self._c[rows]
        taken._rows = self._rows[: len(taken._P)]
        return taken


def _same_labels(one: ObliqueTree, other: ObliqueTree) -> bool:
    if one.labels is None or other.labels is None:
        return one.labels is other.labels
    return np.array_equal(one.labels, other.labels)


def _answers(head: Head, outputs: FloatArray) -> NDArray[Any]:
    k, m, o = outputs.shape
    answers = head(outputs.reshape(k * m, o))
    return answers.reshape(k, m, *answers.shape[1:])
