"""The regions of a tree's leaves: each is the polytope of the states that take the leaf's path."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from otr.clock import check_time
from otr.core.arrays import IntArray
from otr.core.domain import Domain
from otr.core.half_spaces import HalfSpaces
from otr.core.tree import ObliqueTree

_CHUNK_NUMBERS = 2**19  # of the rows of leaves at once


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


def leaves_at_once(tree: ObliqueTree, domain: Domain, *, in_box: bool = False) -> int:
    """Return of how many leaves the rows, as `leaf_rows` returns them, take little memory."""
    n_rows = len(domain.sides(in_box=in_box)[1]) + tree.depth + 1
    return max(1, _CHUNK_NUMBERS // (n_rows * (domain.n_inputs + 1)))


def chunks_of_leaves(tree: ObliqueTree, domain: Domain, *, in_box: bool = False) -> Iterator[IntArray]:
    """Yield all leaves, in order, in parts whose rows take little memory; the time limit is checked in between."""
    size = leaves_at_once(tree, domain, in_box=in_box)
    for start in range(0, tree.n_leaves, size):
        check_time()
        yield np.arange(start, min(start + size, tree.n_leaves))


def leaf_rows(
    tree: ObliqueTree, domain: Domain, leaves: IntArray, *, in_box: bool = False
) -> tuple[HalfSpaces, NDArray[np.int8]]:
    """Return the rows of leaves' regions, a group each: the domain's sides, then the path's tests; and their signs.

    With `in_box` the domain's box bounds the regions without rows, as `HalfSpaces` has it.
    """
    sides = domain.rows(in_box=in_box)
    nodes, signs = (of_paths[leaves] for of_paths in leaf_paths(tree))
    forms = np.concatenate((tree.test_forms, np.zeros((1, tree.n_inputs + 1))))[nodes]
    of_sides = np.ones((len(leaves), sides.n_rows), dtype=np.int8)
    return sides.followed_by(domain.rows_of(forms)), np.concatenate((of_sides, signs), axis=1)
