"""Locally constant networks: what they compute, and the oblique tree that computes the same (Lee & Jaakkola 2020)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from otr.core.arrays import BoolArray, FloatArray, as_batch
from otr.core.head import Head
from otr.core.heads import Identity
from otr.core.mapping import map_network
from otr.core.network import ReluNetwork
from otr.core.tree import ObliqueTree
from otr.errors import InvalidNetworkError

_CHUNK_BYTES = 2**26


@dataclass(frozen=True)
class LcnNetwork:
    """M densely connected layers of one ReLU neuron, and a function g of their derivatives.

        z_i = W_i x + sum_(j < i) U_ij a_j + b_i,  a_i = relu(z_i)
        a_i = J_i x + c_i,  J_i = [z_i > 0] (W_i + sum_(j < i) U_ij J_j),  c_i likewise of b_i and c_j
        y   = g(J_1, c_1, ..., J_M, c_M)

    J and c are constant wherever the activation pattern is, and so is y: an oblique tree with constant leaves. The
    first layer of g is `G . J + h . c + offset`; a second one, V and v, comes after a ReLU where g is not linear.
    """

    W: FloatArray  # (M, d)
    U: FloatArray  # (M, M), zero on and above the diagonal
    b: FloatArray  # (M,)
    G: FloatArray  # (q, M, d)
    h: FloatArray  # (q, M)
    offset: FloatArray  # (q,)
    V: FloatArray | None = None  # (o, q); without it q = o
    v: FloatArray | None = None  # (o,)
    head: Head = field(default_factory=Identity)  # from y to the answer

    def __post_init__(self) -> None:
        """Raise InvalidNetworkError that names an array of the wrong shape."""
        M, d = self.W.shape
        q = len(self.offset)
        expected = {"U": (M, M), "b": (M,), "G": (q, M, d), "h": (q, M)}
        if self.V is not None and self.v is not None:
            expected |= {"V": (len(self.v), q)}
        elif self.V is not None or self.v is not None:
            raise InvalidNetworkError("only one of V and v was given; give both, or none for a linear g")
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise InvalidNetworkError(f"{name} has shape {getattr(self, name).shape}, expected {shape}")
        if np.triu(self.U).any():
            raise InvalidNetworkError("U must be zero on and above the diagonal: a neuron reads earlier ones only")

    @property
    def n_outputs(self) -> int:
        """Number of outputs o."""
        return len(self.offset if self.v is None else self.v)

    def patterns(self, X: ArrayLike) -> BoolArray:
        """Return which neurons are active: (n, M)."""
        return self._relu_network().patterns(as_batch(X, self.W.shape[1]))

    def forward(self, X: ArrayLike) -> FloatArray:
        """Return the outputs (n, o) of rows (n, d), from the Jacobians, built up row by row and neuron by neuron."""
        rows = as_batch(X, self.W.shape[1])
        M, d = self.W.shape
        active = self.patterns(rows)
        outputs = np.empty((len(rows), self.n_outputs))
        chunk = max(1, _CHUNK_BYTES // (8 * M * d))
        for start in range(0, len(rows), chunk):
            part = active[start : start + chunk]
            J, c = np.zeros((len(part), M, d)), np.zeros((len(part), M))
            for i in range(M):
                J[:, i] = part[:, i, None] * (self.W[i] + np.einsum("j,njd->nd", self.U[i, :i], J[:, :i]))
                c[:, i] = part[:, i] * (self.b[i] + c[:, :i] @ self.U[i, :i])
            first = np.tensordot(J, self.G, ((1, 2), (1, 2))) + c @ self.h.T + self.offset
            outputs[start : start + chunk] = self._second_layer(first)
        return outputs

    def with_input_scaling(self, mean: FloatArray, scale: FloatArray) -> LcnNetwork:
        """Return the network that answers on x as this one does on (x - mean) / scale, both (d,)."""
        W = self.W / scale
        # On x, the Jacobian is J / scale and the offset c - (J / scale) mean.
        G = self.G * scale + self.h[:, :, None] * mean
        return replace(self, W=W, b=self.b - W @ mean, G=G)

    def with_output_scaling(self, mean: float, scale: float) -> LcnNetwork:
        """Return the network whose outputs are mean + scale times this one's."""
        if self.V is not None and self.v is not None:
            return replace(self, V=scale * self.V, v=scale * self.v + mean)
        return replace(self, G=scale * self.G, h=scale * self.h, offset=scale * self.offset + mean)

    def to_tree(self, *, max_leaves: int = 2**12) -> ObliqueTree:
        """Return the tree of depth M with a constant in each leaf; raise TreeTooLargeError beyond `max_leaves`."""
        M, d = self.W.shape
        tests = map_network(self._relu_network(), max_leaves=max_leaves)
        numbers = np.arange(2**M)[:, None]
        c = self._leaf_values((numbers >> np.arange(M - 1, -1, -1)) & 1 == 1)
        labels = self.head(c) if self.head.gives_labels else None
        return tests.replace(M=np.zeros((2**M, self.n_outputs, d)), c=c, labels=labels, head=self.head)

    def _relu_network(self) -> ReluNetwork:
        M, d = self.W.shape
        weights = [np.concatenate((self.U[i, :i], self.W[i]))[None] for i in range(M)]
        return ReluNetwork([*weights, np.zeros((1, M + d))], [*self.b[:, None], np.zeros(1)], dense="all")

    def _leaf_values(self, active: BoolArray) -> FloatArray:
        """Return the outputs (n, o) of activation patterns (n, M), without a Jacobian.

        J_i = sum_k T_ik W_k with T = (1 - S U)^-1 S and S the pattern's diagonal matrix, so that G . J needs the
        products of G's rows with those of W only.
        """
        M = len(self.W)
        T = np.zeros((len(active), M, M))
        for i in range(M):
            T[:, i, i] = 1.0
            T[:, i] += np.einsum("j,njk->nk", self.U[i, :i], T[:, :i])
            T[:, i] *= active[:, i, None]
        products = self.G @ self.W.T + self.h[:, :, None] * self.b
        return self._second_layer(np.tensordot(T, products, ((1, 2), (1, 2))) + self.offset)

    def _second_layer(self, first: FloatArray) -> FloatArray:
        if self.V is None or self.v is None:
            return first
        return np.maximum(first, 0.0) @ self.V.T + self.v
