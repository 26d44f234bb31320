"""Trees put together from trees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from otr.core.arrays import IntArray
from otr.core.tree import ObliqueTree

__all__ = ["graft"]


def graft(tree: ObliqueTree, subtrees: Sequence[ObliqueTree]) -> ObliqueTree:
    """Return `tree` with leaf k replaced by ``subtrees[k]``, which reads the same inputs.

    Args:
        tree: its tests are kept, its leaves are dropped; d inputs.
        subtrees: one for each leaf, all with the same d, number of outputs and head, all with labels or none.

    Raises:
        ValueError: the number of subtrees is not that of the leaves.
        InvalidTreeError: the subtrees differ in shape.
    """
    if len(subtrees) != tree.n_leaves:
        raise ValueError(f"{len(subtrees)} subtrees for a tree of {tree.n_leaves} leaves; give one for each leaf")
    node_starts = tree.n_nodes + np.cumsum([0, *(subtree.n_nodes for subtree in subtrees)])
    leaf_starts = np.cumsum([0, *(subtree.n_leaves for subtree in subtrees)])
    starts = zip(subtrees, node_starts[:-1], leaf_starts[:-1], strict=True)
    roots = np.array([node if subtree.n_nodes else ~leaf for subtree, node, leaf in starts], dtype=np.int64)

    def joined(name: str) -> IntArray:
        top: IntArray = getattr(tree, name)
        parts = [np.where(top >= 0, top, roots[np.where(top >= 0, 0, ~top)])]
        for i, subtree in enumerate(subtrees):
            below: IntArray = getattr(subtree, name)
            parts.append(np.where(below >= 0, below + node_starts[i], below - leaf_starts[i]))
        return np.concatenate(parts)

    labels = [subtree.labels for subtree in subtrees if subtree.labels is not None]
    return ObliqueTree(
        joined("children_left"),
        joined("children_right"),
        np.concatenate([tree.P, *(subtree.P for subtree in subtrees)]),
        np.concatenate([tree.v, *(subtree.v for subtree in subtrees)]),
        np.concatenate([subtree.M for subtree in subtrees]),
        np.concatenate([subtree.c for subtree in subtrees]),
        labels=np.concatenate(labels) if labels else None,
        head=subtrees[0].head,
    )
