"""Evaluation of a tree's leaf maps on batches of states, given the leaf of each."""

from __future__ import annotations

import numpy as np

from otr.core.arrays import FloatArray, IntArray

# All leaves are evaluated for all states while that is less work than gathering each state's own map.
_ALL_LEAVES_MAX_OUTPUTS = 24
_CHUNK_BYTES = 2**20


class LeafMaps:
    """``M[leaf] @ x + c[leaf]`` for batches, by the cheaper of two routes.

    Few leaves: every leaf for every state in one matrix product, then a selection. Otherwise each state's map is
    gathered and applied, in chunks that stay in the cache.
    """

    def __init__(self, M: FloatArray, c: FloatArray) -> None:
        """Keep M (n_leaves, o, d) and c (n_leaves, o)."""
        self._M, self._c = M, c
        self._n_leaves, self._n_outputs, self._n_inputs = M.shape

    def __call__(self, X: FloatArray, leaves: IntArray) -> FloatArray:
        """Return the outputs (n, o) of states X (n, d) in `leaves` (n,)."""
        if self._n_leaves == 1:
            outputs: FloatArray = X @ self._M[0].T
            outputs += self._c[0]
            return outputs
        few = self._n_leaves * self._n_outputs <= _ALL_LEAVES_MAX_OUTPUTS
        return self._select(X, leaves) if few else self._gather(X, leaves)

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

    def _gather(self, X: FloatArray, leaves: IntArray) -> FloatArray:
        outputs = self._c.take(leaves, axis=0)
        chunk = max(1, _CHUNK_BYTES // (8 * self._n_outputs * self._n_inputs))
        for start in range(0, len(X), chunk):
            rows = slice(start, start + chunk)
            outputs[rows] += np.einsum("noi,ni->no", self._M.take(leaves[rows], axis=0), X[rows])
        return outputs
