"""ObliqueTree: the one representation that every method ends in."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from otr.arrays import FloatArray, IntArray, as_batch, as_states, read_only
from otr.errors import InvalidTreeError
from otr.head import Head, Identity
from otr.leaves import LeafMaps
from otr.routing import Router

__all__ = ["ObliqueTree"]


class ObliqueTree:
    """A tree with oblique tests and affine leaves, held as parallel arrays.

    Test node i sends a state x left where ``P[i] @ x + v[i] <= 0``, else right. A child reference >= 0 is a test node,
    a reference r < 0 is the leaf ``~r``. Leaf k computes ``M[k] @ x + c[k]``; the answer is the head of that or, if the
    tree has labels, ``labels[k]``: then the tests have decided, and M, c still hold the outputs (logits) behind it.

    Invariants, verified by `check`:
        * the root is node 0, or leaf 0 in a tree without tests;
        * a child's index is above its parent's;
        * every node but the root, and every leaf, has exactly one parent, so n_leaves = n_nodes + 1;
        * all numbers are finite and all shapes agree.

    A test is evaluated in float64. Batch and single-state evaluation may order a sum differently, so a state within
    rounding error (about 1e-16 of the terms' size) of a test's boundary may be sent either way.

    Attributes:
        children_left, children_right: (n_nodes,) int64.
        P, v: (n_nodes, d) and (n_nodes,) float64, the tests.
        M, c: (n_leaves, o, d) and (n_leaves, o) float64, the leaves.
        labels: (n_leaves,) int64, or None.
        head: from a leaf's value to the answer.
    """

    def __init__(
        self,
        children_left: ArrayLike,
        children_right: ArrayLike,
        P: ArrayLike,
        v: ArrayLike,
        M: ArrayLike,
        c: ArrayLike,
        *,
        labels: ArrayLike | None = None,
        head: Head | None = None,
    ) -> None:
        """Keep the arrays, uncopied where they already are float64 or int64 and contiguous, and check them.

        Raises:
            InvalidTreeError: an invariant is broken.
        """
        self.children_left = _array(children_left, np.int64)
        self.children_right = _array(children_right, np.int64)
        self.P: FloatArray = _array(P, np.float64)
        self.v: FloatArray = _array(v, np.float64)
        self.M: FloatArray = _array(M, np.float64)
        self.c: FloatArray = _array(c, np.float64)
        self.labels: IntArray | None = None if labels is None else _array(labels, np.int64)
        self.head: Head = Identity() if head is None else head
        self.check()

    @property
    def n_nodes(self) -> int:
        """Number of test nodes."""
        return len(self.v)

    @property
    def n_leaves(self) -> int:
        """Number of leaves."""
        return len(self.c)

    @property
    def n_inputs(self) -> int:
        """Number of inputs d."""
        return int(self.M.shape[2])

    @property
    def n_outputs(self) -> int:
        """Number of affine outputs o."""
        return int(self.M.shape[1])

    @cached_property
    def depth(self) -> int:
        """Number of tests on the longest path."""
        return len(self.levels)

    @cached_property
    def levels(self) -> tuple[IntArray, ...]:
        """Test nodes by distance from the root: levels[j] holds the ids of the nodes at depth j, ascending."""
        levels = []
        level = np.arange(min(self.n_nodes, 1), dtype=np.int64)
        while level.size:
            levels.append(level)
            children = np.concatenate((self.children_left[level], self.children_right[level]))
            level = np.sort(children[children >= 0])
        return tuple(levels)

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Return the answers: (n, o) values or (n,) labels; without the first axis for one state (d,)."""
        if self.labels is not None:
            return np.asarray(self.labels[self.apply(X)])
        return self.head(self.forward(X))

    def forward(self, X: ArrayLike) -> FloatArray:
        """Return the leaves' affine outputs, before the head: (n, o), or (o,) for one state (d,)."""
        states = as_states(X, self.n_inputs)
        if states.ndim == 1:
            leaf = self._router.leaf_of(states)
            outputs: FloatArray = self.M[leaf].dot(states)
            outputs += self.c[leaf]
            return outputs
        return self._leaf_maps(states, self._router.leaves_of(states))

    def apply(self, X: ArrayLike) -> IntArray:
        """Return the leaf that each state ends in: (n,) int64, or a 0-d array for one state (d,)."""
        states = as_states(X, self.n_inputs)
        if states.ndim == 1:
            return np.asarray(self._router.leaf_of(states), dtype=np.int64)
        return self._router.leaves_of(states)

    def decision_path(self, X: ArrayLike) -> sparse.csr_matrix:
        """Return the test nodes that each state passes: a sparse 0/1 matrix (n, n_nodes), node ids ascending by row."""
        states = as_batch(X, self.n_inputs)
        rows, nodes = self._router.paths_of(states)
        shape = (len(states), self.n_nodes)
        return sparse.csr_matrix((np.ones(len(rows), dtype=np.int8), (rows, nodes)), shape=shape)

    @cached_property
    def _router(self) -> Router:
        return Router(self.children_left, self.children_right, self.P, self.v)

    @cached_property
    def _leaf_maps(self) -> LeafMaps:
        return LeafMaps(self.M, self.c)

    def check(self) -> None:
        """Verify the invariants in the class's docstring.

        Raises:
            InvalidTreeError: names the array and what is wrong with it.
        """
        self._check_shapes()
        for name in ("P", "v", "M", "c"):
            if not np.isfinite(getattr(self, name)).all():
                raise InvalidTreeError(f"{name} holds a number that is not finite (NaN or infinite)")
        n_nodes = self.n_nodes
        children = np.stack((self.children_left, self.children_right), axis=1)
        if n_nodes and (children.max() >= n_nodes or children.min() < -self.n_leaves):
            raise InvalidTreeError(
                f"a child reference lies outside {-self.n_leaves} .. {n_nodes - 1}, "
                f"the range for {n_nodes} nodes and {self.n_leaves} leaves"
            )
        below = (children >= 0) & (children <= np.arange(n_nodes)[:, None])
        if below.any():
            node = int(np.flatnonzero(below.any(axis=1))[0])
            raise InvalidTreeError(f"node {node} has the child {children[node].max()}; a child's index must be higher")
        parents = np.bincount(children.ravel() + self.n_leaves, minlength=self.n_leaves + n_nodes)
        expected = np.ones_like(parents)
        expected[self.n_leaves : self.n_leaves + 1] = 0  # the root node
        if n_nodes and not np.array_equal(parents, expected):
            reference = int(np.flatnonzero(parents != expected)[0]) - self.n_leaves
            what = f"node {reference}" if reference >= 0 else f"leaf {~reference}"
            n_parents = parents[reference + self.n_leaves]
            raise InvalidTreeError(f"{what} has {n_parents} parents, expected one (the root node: none)")

    def _check_shapes(self) -> None:
        if self.M.ndim != 3 or self.P.ndim != 2 or self.v.ndim != 1:
            raise InvalidTreeError(
                f"P, v, M have {self.P.ndim}, {self.v.ndim}, {self.M.ndim} axes, expected 2, 1, 3: "
                "(n_nodes, d), (n_nodes,), (n_leaves, o, d)"
            )
        n_leaves, o, d = self.M.shape
        n_nodes = n_leaves - 1
        expected = {
            "children_left": (n_nodes,),
            "children_right": (n_nodes,),
            "P": (n_nodes, d),
            "v": (n_nodes,),
            "c": (n_leaves, o),
        }
        if self.labels is not None:
            expected["labels"] = (n_leaves,)
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise InvalidTreeError(
                    f"{name} has shape {getattr(self, name).shape}, expected {shape} "
                    f"in a tree of {n_leaves} leaves, {o} outputs and {d} inputs"
                )
        if n_leaves == 0 or o == 0:
            raise InvalidTreeError(f"a tree needs at least one leaf and one output, got {n_leaves} and {o}")
        self.head.check(o)

    def __repr__(self) -> str:
        return (
            f"ObliqueTree(n_leaves={self.n_leaves}, depth={self.depth}, n_inputs={self.n_inputs}, "
            f"n_outputs={self.n_outputs}, head={self.head!r})"
        )


def _array(values: ArrayLike, dtype: type) -> NDArray[Any]:
    return read_only(np.ascontiguousarray(values, dtype=dtype))
