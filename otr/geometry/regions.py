"""The regions of a tree's leaves: each is the polytope of the states that take the leaf's path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from otr.core.arrays import BoolArray, FloatArray, IntArray, as_batch
from otr.core.domain import Box, Domain, as_domain
from otr.core.half_spaces import HalfSpaces
from otr.core.tree import ObliqueTree
from otr.geometry.largest_balls import largest_balls
from otr.geometry.largest_values import largest_values
from otr.geometry.simplex import Bases


@dataclass(frozen=True)
class LeafPaths:
    """The paths of a tree's leaves.

    Attributes:
        nodes: (n_leaves, depth) int64, the test nodes on the way, from the root; -1 after the last.
        signs: (n_leaves, depth) int8, -1 where the path goes left, 1 where right, 0 after the last.
    """

    nodes: IntArray
    signs: NDArray[np.int8]


def leaf_paths(tree: ObliqueTree) -> LeafPaths:
    """Return the path of every leaf."""
    n_nodes, depth = tree.n_nodes, tree.depth
    nodes = np.full((n_nodes + tree.n_leaves, depth), -1, dtype=np.int64)
    signs = np.zeros(nodes.shape, dtype=np.int8)
    for at, level in enumerate(tree.levels):
        for side, sign in ((tree.children_left, -1), (tree.children_right, 1)):
            children = np.where(side[level] >= 0, side[level], n_nodes + ~side[level])
            nodes[children], signs[children] = nodes[level], signs[level]
            nodes[children, at], signs[children, at] = level, sign
    return LeafPaths(nodes[n_nodes:], signs[n_nodes:])


def leaf_rows(tree: ObliqueTree, domain: Domain, leaves: IntArray) -> tuple[HalfSpaces, NDArray[np.int8]]:
    """Return the rows of leaves' regions, a group each: the domain's sides, then the path's tests; and their signs."""
    paths, sides = leaf_paths(tree), domain.rows()
    nodes, signs = paths.nodes[leaves], paths.signs[leaves]
    forms = np.concatenate((np.column_stack((tree.P, tree.v)), np.zeros((1, tree.n_inputs + 1))))[nodes]
    of_sides = np.ones((len(leaves), sides.n_rows), dtype=np.int8)
    return sides.followed_by(domain.rows_of(forms)), np.concatenate((of_sides, signs), axis=1)


@dataclass(frozen=True)
class Region:
    """The states of a domain that take a leaf's path: those with ``forms @ (x, 1) <= 0`` or ``> 0``, by the signs.

    Attributes:
        domain: the domain.
        forms: (m, d + 1), the tests [P | v] on the path.
        signs: (m,) int8, -1 for ``<= 0``, 1 for ``> 0``.
    """

    domain: Domain
    forms: FloatArray
    signs: NDArray[np.int8]

    def contains(self, X: ArrayLike) -> BoolArray:
        """Return whether each state (n, d) lies in the region."""
        states = as_batch(X, self.domain.n_inputs)
        right = states @ self.forms[:, :-1].T + self.forms[:, -1] > 0
        inside: BoolArray = (right == (self.signs > 0)).all(axis=1)
        return inside & (states >= self.domain.low).all(axis=1) & (states <= self.domain.high).all(axis=1)

    def inner_point(self) -> FloatArray | None:
        """Return a state inside (d,), beyond rounding from every side; None if floating point finds none."""
        rows, signs = self._rows()
        start = Bases.start(1, self.domain.n_inputs)
        balls = largest_balls(rows, np.zeros(1, dtype=np.int64), signs, start)
        return None if balls.radii[0] == 0 else self.domain.unscaled(balls.centres)[0]

    def bounds(self, form: ArrayLike) -> tuple[float, float]:
        """Return the smallest and the largest value of ``form @ (x, 1)``, form (d + 1,), over the region's closure.

        Raises:
            ValueError: the domain is not bounded.
        """
        self.domain.require_bounded()
        rows, signs = self._rows()
        objectives = self.domain.scaled(np.outer((-1.0, 1.0), np.asarray(form, dtype=np.float64)))
        best = largest_values(rows, np.zeros(2, dtype=np.int64), np.repeat(signs, 2, axis=0), objectives)
        return -float(best.values[0]), float(best.values[1])

    def _rows(self) -> tuple[HalfSpaces, NDArray[np.int8]]:
        sides = self.domain.rows()
        rows = sides.followed_by(self.domain.rows_of(self.forms[None]))
        return rows, np.concatenate((np.ones(sides.n_rows, dtype=np.int8), self.signs))[None]


def leaf_region(tree: ObliqueTree, leaf: int, domain: Domain | Box | None = None) -> Region:
    """Return the region of a leaf in a domain, all of R^d if None.

    Raises:
        ValueError: there is no such leaf, or the domain is none of the tree's.
    """
    if not 0 <= leaf < tree.n_leaves:
        raise ValueError(f"leaf is {leaf}, the tree has the leaves 0 to {tree.n_leaves - 1}")
    paths = leaf_paths(tree)
    nodes = paths.nodes[leaf][paths.nodes[leaf] >= 0]
    forms = np.column_stack((tree.P[nodes], tree.v[nodes]))
    return Region(as_domain(domain, tree.n_inputs), forms, paths.signs[leaf, : len(nodes)])
