"""The regions of a tree's leaves: each is the polytope of the states that take the leaf's path."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import IntArray
from otr.core.domain import Domain
from otr.core.half_spaces import HalfSpaces
from otr.core.tree import ObliqueTree


def leaf_paths(tree: ObliqueTree) -> tuple[IntArray, NDArray[np.int8]]:
    """Return, (n_leaves, depth) each, the test nodes on every leaf's path and its signs, -1 for left, 1 for right.

    The root comes first; after the last test nodes are -1 and signs 0.
    """
    n_nodes, depth = tree.n_nodes, tree.depth
    nodes = np.full((n_nodes + tree.n_leaves, depth), -1, dtype=np.int64)
    signs = np.zeros(nodes.shape, dtype=np.int8)
    for at, level in enumerate(tree.levels):
        for side, sign in ((tree.children_left, -1), (tree.children_right, 1)):
            children = np.where(side[level] >= 0, side[level], n_nodes + ~side[level])
            nodes[children], signs[children] = nodes[level], signs[level]
            nodes[children, at], signs[children, at] = level, sign
    return nodes[n_nodes:], signs[n_nodes:]


def leaf_rows(tree: ObliqueTree, domain: Domain, leaves: IntArray) -> tuple[HalfSpaces, NDArray[np.int8]]:
    """Return the rows of leaves' regions, a group each: the domain's sides, then the path's tests; and their signs."""
    sides = domain.rows()
    nodes, signs = (of_paths[leaves] for of_paths in leaf_paths(tree))
    forms = np.concatenate((tree.test_forms, np.zeros((1, tree.n_inputs + 1))))[nodes]
    of_sides = np.ones((len(leaves), sides.n_rows), dtype=np.int8)
    return sides.followed_by(domain.rows_of(forms)), np.concatenate((of_sides, signs), axis=1)
