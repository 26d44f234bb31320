"""Trees without tests that decide nothing: whose two sides answer the same, or of which no state takes one."""

from __future__ import annotations

import numpy as np

from otr.core.arrays import BoolArray, IntArray
from otr.core.pruning import keep_leaves
from otr.core.tree import ObliqueTree


def merge_equal_leaves(tree: ObliqueTree) -> ObliqueTree:
    """Return the tree that answers the same in every state, without the tests below which all leaves are equal.

    A test whose row P is 0 goes, too, with the side that no state takes. Leaves are equal where they have the same
    label or, in a tree without labels, exactly the same M and c. From the bottom up, a test over two equal leaves is
    replaced by one of them, until there is none. Programs are printed and drawn so. With labels, the outputs (logits)
    of the leaf that stays replace those of all merged ones.

    Args:
        tree: any tree; one without such tests is returned itself.
    """
    reached = _reached_leaves(tree)
    if not reached.all():
        tree = keep_leaves(tree, reached)
    answers = _numbered_answers(tree)
    mixed = -1
    first = {~leaf: leaf for leaf in range(tree.n_leaves)}  # from a reference to the first leaf below it
    answer = {~leaf: int(number) for leaf, number in enumerate(answers)}  # what all leaves below it answer, or mixed
    keep = np.ones(tree.n_leaves, dtype=np.bool_)
    for node in reversed(range(tree.n_nodes)):
        left, right = int(tree.children_left[node]), int(tree.children_right[node])
        first[node] = first[left]
        is_one = answer[left] != mixed and answer[left] == answer[right]
        answer[node] = answer[left] if is_one else mixed
        if is_one:
            keep[first[right]] = False
    return tree if keep.all() else keep_leaves(tree, keep)


def _reached_leaves(tree: ObliqueTree) -> BoolArray:
    """Return the leaves (n_leaves,) that are not on the wrong side of a test whose row is 0."""
    is_constant, is_left = ~tree.P_of_basis.any(axis=1), tree.v <= 0
    reached = np.ones(tree.n_nodes + tree.n_leaves, dtype=np.bool_)  # a leaf's reference ~i counts from the end
    if is_constant.any():
        for level in tree.levels:
            for side, is_taken in ((tree.children_left, is_left), (tree.children_right, ~is_left)):
                reached[side[level]] = reached[level] & (~is_constant | is_taken)[level]
    return reached[tree.n_nodes :][::-1]


def _numbered_answers(tree: ObliqueTree) -> IntArray:
    """Return a number a leaf (n_leaves,), from 0 on, which equal leaves share."""
    maps = np.column_stack((tree.M_of_basis.reshape(tree.n_leaves, -1), tree.c))
    _, numbers = np.unique(maps if tree.labels is None else tree.labels[:, None], axis=0, return_inverse=True)
    return np.asarray(numbers, dtype=np.int64).reshape(-1)
