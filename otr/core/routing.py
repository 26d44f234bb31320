"""Routing of states to leaves.

An OTR tree repeats the same test in many nodes: with one hidden layer there are only as many distinct tests as
neurons. So each distinct test is evaluated once per state, all of them in one matrix product, and the tree is walked
on the bits. If the tests can be put in an order that every path respects, the walk reads eight bits at a time from
tables, as a finite automaton would; else it goes level by level.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import BoolArray, FloatArray, IntArray

# One matrix product over all distinct tests beats gathering each state's next test up to about this many tests.
_MAX_SHARED_TESTS = 512
# Tables larger than this leave the cache, and cost more to fill than they save.
_MAX_TABLE_ENTRIES = 2**20
# A single state evaluates the distinct tests at once up to this many, else only those on its path.
_MAX_SHARED_TESTS_SINGLE = 128
_CHUNK_BYTES = 2**20


class Router:
    """Finds the leaf of a state; everything costly is built on first use."""

    def __init__(self, left: IntArray, right: IntArray, P: FloatArray, v: FloatArray) -> None:
        """Keep the tests P (n_nodes, d), v (n_nodes,) and the children as in `ObliqueTree`."""
        self._left, self._right, self._P, self._v = left, right, P, v

    def leaf_of(self, x: FloatArray) -> int:
        """Return the leaf of one state (d,)."""
        if not len(self._v):
            return 0
        left, right, test = self._child_lists
        node = 0
        if len(self._thresholds) <= _MAX_SHARED_TESTS_SINGLE:
            outcomes = (self._tests.dot(x) > self._thresholds).tolist()
            while node >= 0:
                node = right[node] if outcomes[test[node]] else left[node]
        else:
            tests, thresholds = self._test_lists
            while node >= 0:
                go_right = tests[test[node]].dot(x) > thresholds[test[node]]
                node = right[node] if go_right else left[node]
        return ~node

    def leaves_of(self, X: FloatArray) -> IntArray:
        """Return the leaf of every state: (n,) for X (n, d)."""
        leaves = np.zeros(len(X), dtype=np.int64)
        if not len(self._v):
            return leaves
        shared = len(self._thresholds) <= _MAX_SHARED_TESTS
        width = len(self._thresholds) if shared else X.shape[1]
        chunk = max(256, _CHUNK_BYTES // (8 * width))
        for start in range(0, len(X), chunk):
            rows = slice(start, start + chunk)
            if not shared:
                leaves[rows] = self._walk(X[rows], None)
            elif self._tables is not None:
                leaves[rows] = self._read_tables(self._outcomes(X[rows]))
            else:
                leaves[rows] = self._walk(X[rows], self._outcomes(X[rows]))
        return leaves

    def paths_of(self, X: FloatArray) -> tuple[IntArray, IntArray]:
        """Return pairs (row of X, test node on its path), sorted by row, then by node."""
        visited = [(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))]
        self._walk(X, None, visited)
        rows, nodes = (np.concatenate(parts) for parts in zip(*visited, strict=True))
        order = np.argsort(rows, kind="stable")
        return rows[order], nodes[order]

    def _outcomes(self, X: FloatArray) -> BoolArray:
        """Return, for every state and distinct test, whether it goes right: (n, n_tests, a multiple of eight).

        ``P @ x > -v`` has the same truth value as ``P @ x + v > 0``, and saves a pass over the products.
        """
        products = X @ self._tests.T
        return products > self._thresholds

    def _walk(
        self, X: FloatArray, outcomes: BoolArray | None, visited: list[tuple[IntArray, IntArray]] | None = None
    ) -> IntArray:
        """Return the leaves (n,), found level by level; add each level's rows and nodes to `visited`."""
        leaves = np.zeros(len(X), dtype=np.int64)
        rows = np.arange(len(X) if len(self._v) else 0)
        nodes = np.zeros(len(rows), dtype=np.int64)
        while rows.size:
            if visited is not None:
                visited.append((rows, nodes))
            if outcomes is None:
                products = np.einsum("ij,ij->i", X[rows], self._P[nodes])
                go_right = products > -self._v[nodes]
            else:
                go_right = outcomes.ravel().take(rows * outcomes.shape[1] + self._test_of_node[nodes])
            nodes = self._children[2 * nodes + go_right]
            at_leaf = nodes < 0
            leaves[rows[at_leaf]] = ~nodes[at_leaf]
            rows, nodes = rows[~at_leaf], nodes[~at_leaf]
        return leaves

    def _read_tables(self, outcomes: BoolArray) -> IntArray:
        """Return the leaves (n,) by reading the outcomes a byte at a time; `_tables` explains the states."""
        assert self._tables is not None
        codes = np.packbits(outcomes.ravel()).reshape(len(outcomes), -1)
        state = self._tables[0].take(codes[:, 0])
        for group, table in enumerate(self._tables[1:], start=1):
            state += codes[:, group]
            state = table.take(state)
        return state

    @cached_property
    def _distinct(self) -> tuple[FloatArray, FloatArray, IntArray, bool]:
        """Distinct tests, their thresholds, the test of each node, and whether every path meets tests in that order."""
        keyed = np.column_stack((self._P, self._v)) + 0.0  # adding 0.0 makes -0.0 equal to 0.0 in its bytes too
        rows = keyed.view(np.dtype((np.void, keyed.dtype.itemsize * keyed.shape[1]))).ravel()
        _, first, test_of_node = np.unique(rows, return_index=True, return_inverse=True)
        rank = None
        if len(first) <= _MAX_SHARED_TESTS:  # beyond that there are no tables, and no order is needed
            rank = _topological_rank(len(first), test_of_node, self._left, self._right)
        if rank is not None:
            first, test_of_node = first[np.argsort(rank)], rank[test_of_node]
        # Whole bytes of tests; the tests added are zero, and no node refers to them.
        n_tests = len(first) + (-len(first)) % 8
        tests, thresholds = np.zeros((n_tests, self._P.shape[1])), np.zeros(n_tests)
        tests[: len(first)] = self._P[first]
        thresholds[: len(first)] = -self._v[first]
        return tests, thresholds, test_of_node, rank is not None

    @property
    def _tests(self) -> FloatArray:
        return self._distinct[0]

    @property
    def _thresholds(self) -> FloatArray:
        return self._distinct[1]

    @property
    def _test_of_node(self) -> IntArray:
        return self._distinct[2]

    @cached_property
    def _children(self) -> IntArray:
        """Children interleaved: left of node i at 2i, right at 2i + 1."""
        return np.stack((self._left, self._right), axis=1).ravel()

    @cached_property
    def _child_lists(self) -> tuple[list[int], list[int], list[int]]:
        return self._left.tolist(), self._right.tolist(), self._test_of_node.tolist()

    @cached_property
    def _test_lists(self) -> tuple[list[FloatArray], list[float]]:
        return list(self._tests), self._thresholds.tolist()

    @cached_property
    def _tables(self) -> list[NDArray[np.int64]] | None:
        """One table a byte of tests: entry 256 * state + byte is the next state, already multiplied by 256.

        A state is where the walk is between two bytes, a node or a leaf. The last table holds leaves.
        None if no order of the tests suits every path, or the tables would be too large.
        """
        if not self._distinct[3]:
            return None
        codes = np.arange(256)
        standing = np.zeros(1, dtype=np.int64)
        tables: list[NDArray[np.int64]] = []
        n_entries = 0
        for group in range(len(self._thresholds) // 8):
            n_entries += 256 * len(standing)
            if n_entries > _MAX_TABLE_ENTRIES:
                return None
            nodes = np.repeat(standing, 256)
            bytes_read = np.tile(codes, len(standing))
            while True:
                active = np.flatnonzero(nodes >= 0)
                active = active[self._test_of_node[nodes[active]] // 8 == group]
                if not active.size:
                    break
                shift = 7 - self._test_of_node[nodes[active]] % 8
                bits = (bytes_read[active] >> shift) & 1
                nodes[active] = self._children[2 * nodes[active] + bits]
            standing, next_state = np.unique(nodes, return_inverse=True)
            tables.append(next_state * 256)
        tables[-1] = ~standing[tables[-1] // 256]
        return tables


def _topological_rank(n_tests: int, test_of_node: IntArray, left: IntArray, right: IntArray) -> IntArray | None:
    """Return ranks 0 .. n_tests - 1 that grow along every path of the tree, or None if there are none."""
    above, below = [], []
    for children in (left, right):
        parents = np.flatnonzero(children >= 0)
        above.append(test_of_node[parents])
        below.append(test_of_node[children[parents]])
    edges = np.unique(np.concatenate(above) * n_tests + np.concatenate(below))
    above_test, below_test = edges // n_tests, edges % n_tests
    rank = np.zeros(n_tests, dtype=np.int64)
    for _ in range(n_tests + 1):  # a longer chain of tests than this repeats one
        raised = rank.copy()
        np.maximum.at(raised, below_test, rank[above_test] + 1)
        if np.array_equal(raised, rank):
            return np.argsort(np.argsort(rank, kind="stable"))
        rank = raised
    return None
