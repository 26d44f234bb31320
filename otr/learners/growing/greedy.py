"""Greedy growth of a tree from the root, the part that the learners with recursive splits share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.core.tree import ObliqueTree

_CHUNK_ENTRIES = 2**22


@dataclass(frozen=True)
class Test:
    """A test ``P @ x + v <= 0``."""

    P: FloatArray
    v: float


@dataclass(frozen=True)
class Skeleton:
    """A tree's tests, and the training rows that end in each leaf."""

    children_left: list[int]
    children_right: list[int]
    P: FloatArray
    v: FloatArray
    leaf_rows: list[IntArray]

    def with_leaves(self, c: FloatArray, M: FloatArray | None = None) -> ObliqueTree:
        """Return the tree whose leaf k answers ``M[k] @ x + c[k]``, or the constant c[k]; c (n_leaves, o)."""
        M = np.zeros((*c.shape, self.P.shape[1])) if M is None else M
        return ObliqueTree(self.children_left, self.children_right, self.P, self.v, M, c)


def grow(X: NDArray[Any], find_test: Callable[[IntArray], Test | None], max_depth: int | None) -> Skeleton:
    """Split rows of X (n, d) from the root until `find_test` gives none, all rows go one way, or at `max_depth`.

    `find_test` maps a node's rows, ascending, to its test, or to None for a leaf; it is called in preorder.
    """
    left: list[int] = []
    right: list[int] = []
    tests: list[Test] = []
    leaf_rows: list[IntArray] = []
    # Rows, depth, and the list and position where the reference to this node or leaf belongs.
    pending: list[tuple[IntArray, int, list[int], int]] = [(np.arange(len(X)), 0, [0], 0)]
    while pending:
        rows, depth, siblings, position = pending.pop()
        test = find_test(rows) if max_depth is None or depth < max_depth else None
        sides = None if test is None else goes_right(X, rows, test)
        if test is None or sides is None or sides.all() or not sides.any():
            siblings[position] = ~len(leaf_rows)
            leaf_rows.append(rows)
            continue
        node = siblings[position] = len(tests)
        tests.append(test)
        left.append(0)
        right.append(0)
        pending.append((rows[sides], depth + 1, right, node))
        pending.append((rows[~sides], depth + 1, left, node))
    P = np.array([test.P for test in tests], dtype=np.float64).reshape(len(tests), X.shape[1])
    return Skeleton(left, right, P, np.array([test.v for test in tests], dtype=np.float64), leaf_rows)


def goes_right(X: NDArray[Any], rows: IntArray, test: Test) -> BoolArray:
    """Return, for each of `rows`, whether the test sends it right; float64, in chunks."""
    products = np.empty(len(rows))
    chunk = max(1, _CHUNK_ENTRIES // X.shape[1])
    for start in range(0, len(rows), chunk):
        part = slice(start, start + chunk)
        products[part] = X[rows[part]].astype(np.float64, copy=False) @ test.P
    return np.asarray(products > -test.v)
