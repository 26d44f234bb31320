"""Leaves of affine logits, decided by tests."""

from __future__ import annotations

from otr.control.graft import graft
from otr.head import Argmax
from otr.mapping import map_network
from otr.network import ReluNetwork
from otr.tree import ObliqueTree

__all__ = ["argmax_leaves"]


def argmax_leaves(tree: ObliqueTree) -> ObliqueTree:
    """Return the tree whose bottom tests decide which of a leaf's affine logits is the largest.

    Args:
        tree: leaves hold o logits each; its head is not looked at.

    Returns:
        Tree with the head `Argmax` and labels; below each leaf, o - 1 more levels.
    """
    deciders = [map_network(ReluNetwork([M], [c], head=Argmax())) for M, c in zip(tree.M, tree.c, strict=True)]
    return graft(tree, deciders)
