"""Evaluation of a tree's leaf maps on batches of states, given the leaf of each."""

from __future__ import annotations

import numpy as np

from otr.arrays import FloatArray, IntArray

__all__ = ["LeafMaps"]

# All leaves are evaluated for all states while that is no more work than sorting the states by leaf.
_ALL_LEAVES_MAX_OUTPUTS = 80
# Below this many states a leaf, one small matrix product per state beats one per leaf.
_MIN_STATES_PER_LEAF = 4
_CHUNK_BYTES = 2**20


class LeafMaps:
    """``M[leaf] @ x + c[leaf]`` for batches, by whichever of three routes is the cheapest.

    Few leaves: every leaf for every state in one matrix product, then a selection. Many states a leaf: sort the
    states by leaf, one matrix product a leaf. Few states a leaf: gather each state's map.
    """

    def __init__(self, M: FloatArray, c: FloatArray) -> None:
        """Keep M (n_leaves, o, d) and c (n_leaves, o)."""
        self._M, self._c = M, c
        self._n_leaves, self._n_outputs, self._n_inputs = M.shape

    def __call__(self, X: FloatArray, leaves: IntArray) -> FloatArray:
        """Return the outputs (n, o) of states X (n, d) that lie in `leaves` (n,)."""
        if self._n_leaves == 1:
            outputs: FloatArray = X @ self._M[0].T
            outputs += self._c[0]
            return outputs
        if self._n_leaves * self._n_outputs <= _ALL_LEAVES_MAX_OUTPUTS:
            return self._select(X, leaves)
        if len(X) >= _MIN_STATES_PER_LEAF * self._n_leaves:
            return self._by_leaf(X, leaves)
        return self._gather(X, leaves)

    def _select(self, X: FloatArray, leaves: IntArray) -> FloatArray:
        n, o, L = len(X), self._n_outputs, self._n_leaves
        maps = self._M.reshape(L * o, -1).T
        outputs = np.empty((n, o))
        chunk = max(1, _CHUNK_BYTES // (8 * L * o))
        first_row = np.arange(min(n, chunk)) * L
        for start in range(0, n, chunk):
            rows = slice(start, min(start + chunk, n))
            every_leaf = (X[rows] @ maps).reshape(-1, o)
            every_leaf.take(first_row[: rows.stop - start] + leaves[rows], axis=0, out=outputs[rows], mode="clip")
        outputs += self._c.take(leaves, axis=0)
        return outputs

    def _by_leaf(self, X: FloatArray, leaves: IntArray) -> FloatArray:
        # numpy sorts 16-bit integers by radix, several times faster than wider ones.
        keys = leaves.astype(np.uint16) if self._n_leaves <= 2**16 else leaves
        order = np.argsort(keys, kind="stable")
        sorted_states = X.take(order, axis=0)
        sorted_outputs = np.empty((len(X), self._n_outputs))
        sizes = np.bincount(leaves, minlength=self._n_leaves)
        stop = 0
        for leaf in np.flatnonzero(sizes).tolist():
            start, stop = stop, stop + int(sizes[leaf])
            np.matmul(sorted_states[start:stop], self._M[leaf].T, out=sorted_outputs[start:stop])
        outputs = np.empty_like(sorted_outputs)
        outputs[order] = sorted_outputs
        outputs += self._c.take(leaves, axis=0)
        return outputs

    def _gather(self, X: FloatArray, leaves: IntArray) -> FloatArray:
        outputs = self._c.take(leaves, axis=0)
        chunk = max(1, _CHUNK_BYTES // (8 * self._n_outputs * self._n_inputs))
        for start in range(0, len(X), chunk):
            rows = slice(start, start + chunk)
            outputs[rows] += np.matmul(self._M[leaves[rows]], X[rows, :, None])[:, :, 0]
        return outputs
