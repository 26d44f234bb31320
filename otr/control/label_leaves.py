"""Labels from affine leaves: the tests of a head that decides labels, appended below each leaf."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from otr.core.arrays import BoolArray, FloatArray
from otr.core.head import Head
from otr.core.heads import Argmax
from otr.core.tree import ObliqueTree

# Two unit normals count as the same where no component differs by more.
_SAME_NORMAL = 4 * np.finfo(np.float64).eps


def argmax_leaves(tree: ObliqueTree) -> ObliqueTree:
    """Return the tree that answers the label of the largest of `tree`'s affine outputs, ties to the lowest index.

    Below each leaf comes the tournament of `otr.Argmax`: with champion i = 0, the test ``y_j - y_i <= 0`` for
    j = 1 .. o - 1 keeps i on the left and puts j in its place on the right, so a leaf grows into at most 2**(o - 1).
    A test is left out where it can have one outcome only and that is cheap to see: its normal is zero, or it is
    parallel to a test above it, whose outcome decides it. Other branches that no state reaches may be left.

    Args:
        tree: its leaves hold (o, d) affine outputs; its head is not asked.

    Returns:
        A tree with labels and head `Argmax`, the outputs kept in its leaves.
    """
    return decided_leaves(tree, Argmax())


def decided_leaves(tree: ObliqueTree, head: Head) -> ObliqueTree:
    """Return the tree with the tests of `head` below each leaf, and labels; as it is under a head without labels.

    The leaves hold affine outputs (o, d); the tree's own head is not asked.
    """
    if not head.gives_labels:
        return tree.replace(head=head)
    grower = _Tournaments(tree, head)
    grower.grow()
    return ObliqueTree(
        grower.left,
        grower.right,
        np.reshape(grower.P, (-1, tree.n_inputs)),
        np.array(grower.v, dtype=np.float64),
        tree.M[grower.leaves],
        tree.c[grower.leaves],
        labels=grower.labels,
        head=head,
    )


@dataclass(frozen=True)
class _KnownTests:
    """What is known at a node: each test above it as ``unit @ x <= bound`` or, `above`, ``unit @ x > bound``."""

    units: FloatArray  # (k, d)
    bounds: FloatArray  # (k,)
    above: BoolArray  # (k,)

    def extended(self, unit: FloatArray, bound: float, above: bool) -> _KnownTests:
        return _KnownTests(np.vstack((self.units, unit)), np.append(self.bounds, bound), np.append(self.above, above))

    def outcome(self, unit: FloatArray, bound: float) -> bool | None:
        """Return whether ``unit @ x > bound`` holds for all x of the path (True) or none (False); else None."""
        same = np.abs(self.units - unit).max(axis=1, initial=0.0) <= _SAME_NORMAL
        opposite = np.abs(self.units + unit).max(axis=1, initial=0.0) <= _SAME_NORMAL
        # What the path says of s = unit @ x, by row: s <= b, then s < -b; s > b, then s >= -b.
        if (self.bounds[same & ~self.above] <= bound).any() or (-self.bounds[opposite & self.above] <= bound).any():
            return False
        if (self.bounds[same & self.above] >= bound).any() or (-self.bounds[opposite & ~self.above] > bound).any():
            return True
        return None


@dataclass
class _Tournaments:
    """Copies a tree in preorder, so that a child's index is above its parent's, and grows its leaves on."""

    tree: ObliqueTree
    head: Head
    left: list[int] = field(default_factory=list)
    right: list[int] = field(default_factory=list)
    P: list[FloatArray] = field(default_factory=list)
    v: list[float] = field(default_factory=list)
    leaves: list[int] = field(default_factory=list)  # the leaf of `tree` that each new leaf is part of
    labels: list[int] = field(default_factory=list)

    def grow(self) -> None:
        d = self.tree.n_inputs
        nothing = _KnownTests(np.zeros((0, d)), np.zeros(0), np.zeros(0, dtype=np.bool_))
        root = 0 if self.tree.n_nodes else ~0
        self._copy(root, nothing)

    def _copy(self, reference: int, path: _KnownTests) -> int:
        """Copy what is at `reference` of the old tree; return its reference in the new one."""
        if reference < 0:
            return self._decide(~reference, (), path)
        P, v = self.tree.P[reference], float(self.tree.v[reference])
        node = self._add_node(P, v)
        for side, children in ((False, self.tree.children_left), (True, self.tree.children_right)):
            self._link(node, side, self._copy(int(children[reference]), _known(path, P, v, side)))
        return node

    def _decide(self, leaf: int, outcomes: tuple[bool, ...], path: _KnownTests) -> int:
        """Grow the head's tests from those with known outcomes on; return the reference of the first."""
        so_far = np.array([outcomes], dtype=np.bool_)
        if len(outcomes) == self.head.n_tests(self.tree.n_outputs):
            labels = self.head.labels(so_far)
            assert labels is not None
            self.leaves.append(leaf)
            self.labels.append(int(labels[0]))
            return ~(len(self.leaves) - 1)
        outputs = np.column_stack((self.tree.M[leaf], self.tree.c[leaf]))
        test = self.head.next_test(outputs[None], so_far)[0]
        P, v = test[:-1], float(test[-1])
        norm = float(np.linalg.norm(P))
        right = v > 0 if norm == 0 else path.outcome(P / norm, -v / norm)
        if right is not None:
            return self._decide(leaf, (*outcomes, right), path)
        node = self._add_node(P, v)
        for side in (False, True):
            self._link(node, side, self._decide(leaf, (*outcomes, side), _known(path, P, v, side)))
        return node

    def _add_node(self, P: FloatArray, v: float) -> int:
        self.P.append(P)
        self.v.append(v)
        self.left.append(0)
        self.right.append(0)
        return len(self.v) - 1

    def _link(self, node: int, side: bool, reference: int) -> None:
        (self.right if side else self.left)[node] = reference


def _known(path: _KnownTests, P: FloatArray, v: float, above: bool) -> _KnownTests:
    norm = float(np.linalg.norm(P))
    return path.extended(P / norm, -v / norm, above) if norm > 0 else path
