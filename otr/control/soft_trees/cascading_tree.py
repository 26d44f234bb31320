"""Cascading decision trees: one tree learns features, a second one decides on them (Ding et al. 2020)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from otr.control.soft_trees.soft_tree import SoftTree
from otr.core.arrays import FloatArray, IntArray
from otr.core.head import Head
from otr.core.tree import ObliqueTree


class CascadingTree(nn.Module):
    """A soft tree of features, affine in x, and a soft tree with constant leaves that tests those features.

    Attributes:
        features: d inputs to m features, affine leaves.
        decisions: m features to o outputs, constant leaves.
    """

    def __init__(
        self,
        n_inputs: int,
        n_outputs: int,
        *,
        feature_depth: int,
        n_features: int,
        decision_depth: int,
        beta: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> None:
        """Draw both trees; the features start at the size of a linear layer's outputs.

        Args:
            n_inputs: d.
            n_outputs: o.
            feature_depth: of the tree of features.
            n_features: m.
            decision_depth: of the tree on the features.
            beta: how hard the tests of both are at first.
            generator: None for torch's default.
        """
        super().__init__()
        self.n_inputs, self.n_outputs, self.n_features = n_inputs, n_outputs, n_features
        self.features = SoftTree(
            n_inputs, n_features, feature_depth, affine_leaves=True, beta=beta, generator=generator
        )
        nn.init.normal_(self.features.leaves, std=n_inputs**-0.5, generator=generator)
        self.decisions = SoftTree(
            n_features, n_outputs, decision_depth, affine_leaves=False, beta=beta, generator=generator
        )

    def set_beta(self, beta: float) -> None:
        """Make the tests of both trees harder or softer."""
        self.features.set_beta(beta)
        self.decisions.set_beta(beta)

    def substitute(self, shift: FloatArray, scale: FloatArray) -> None:
        """Rewrite this cascade of x as the one of u, where x = shift + scale u, both (d,), with float64 parameters."""
        self.double()
        self.features.substitute(shift, scale)

    def forward(self, X: Tensor) -> Tensor:
        """Return the outputs (n, o) for states X (n, d)."""
        outputs: Tensor = self.decisions(self.features(X))
        return outputs

    def harden(self, head: Head | None = None, *, axis_aligned: bool = False) -> ObliqueTree:
        """Return the hard cascade as one tree on x.

        In leaf l of the feature tree the features are F_l x + g_l, so a test ``Q . f + u <= 0`` of the decision tree is
        the oblique test ``(Q F_l) . x + Q . g_l + u <= 0`` there.

        Args:
            head: of the tree; with `Argmax` the leaves have labels. None for Identity.
            axis_aligned: tests of the feature tree keep one input, tests of the decision tree one feature, which still
                is affine in x.

        Returns:
            Tree of depth feature_depth + decision_depth with constant leaves.
        """
        features = self.features.harden(axis_aligned=axis_aligned)
        decisions = self.decisions.harden(head, axis_aligned=axis_aligned)
        return _with_subtrees(features, [decisions.compose(F, g) for F, g in zip(features.M, features.c, strict=True)])


def _with_subtrees(tree: ObliqueTree, subtrees: Sequence[ObliqueTree]) -> ObliqueTree:
    """Return `tree` with leaf i replaced by ``subtrees[i]``; the subtrees differ in their numbers only."""
    one, places = subtrees[0], np.arange(len(subtrees))
    node_starts, leaf_starts = tree.n_nodes + one.n_nodes * places, one.n_leaves * places
    roots = node_starts if one.n_nodes else ~leaf_starts

    def joined(top: IntArray, below: IntArray) -> IntArray:
        copies = np.where(below >= 0, below + node_starts[:, None], below - leaf_starts[:, None])
        return np.concatenate((np.where(top >= 0, top, roots[np.where(top >= 0, 0, ~top)]), copies.ravel()))

    return ObliqueTree(
        joined(tree.children_left, one.children_left),
        joined(tree.children_right, one.children_right),
        np.concatenate([tree.P, *(subtree.P for subtree in subtrees)]),
        np.concatenate([tree.v, *(subtree.v for subtree in subtrees)]),
        np.concatenate([subtree.M for subtree in subtrees]),
        np.concatenate([subtree.c for subtree in subtrees]),
        labels=None if one.labels is None else np.tile(one.labels, len(subtrees)),
        head=one.head,
    )
