"""Whether two trees answer alike on a box: exactly decided, by conditions on both of their answers at once."""

from __future__ import annotations

import numpy as np

from otr.clock import time_limit
from otr.core.domain import Box, Domain
from otr.core.head import Head
from otr.core.heads import Argmax, ClipBox, Exp, Identity, TanhBox
from otr.core.tree import ObliqueTree
from otr.errors import TreeTooLargeError
from otr.proof.properties import find_violation
from otr.proof.verdict import Condition, Verdict


def find_difference(
    tree: ObliqueTree,
    other: ObliqueTree,
    box: Box | Domain,
    *,
    max_difference: float = 0.0,
    max_leaves: int = 2**14,
    max_seconds: float | None = None,
) -> Verdict:
    """Return a proof that two trees differ by no more than `max_difference` on a box, or a state where they do.

    Both are asked at once, as one tree whose leaves are the pairs of theirs; `find_violation` says what is proved. What
    is compared are the actions or, under one and the same tanh or exp, the outputs before it, as in `otr.certify`. Of a
    tree with a basis P and M count as they are in float64, multiplied out.

    Args:
        tree, other: with equal numbers of inputs and outputs and heads of one kind, or both with labels.
        box: bounded.
        max_difference: of labels, which are equal or not, 0.
        max_leaves, max_seconds: refuse more pairs of leaves, or to look for longer.

    Returns:
        A verdict whose `value` is the largest difference or, where it does not hold, the one at `state`. Its `action`
        is there what is compared of `tree`, then of `other`; of labels, [0, 1] says that they differ.

    Raises:
        ValueError: the trees do not fit each other, the box is unbounded, or labels are allowed to differ.
        TreeTooLargeError: there are more pairs of leaves, or, a TimeLimitError, the time was over.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> other = otr.parse_program("if x <= 1: -x else: x", ["x"])
        >>> otr.find_difference(tree, other, ([-1], [0])).holds
        True
        >>> otr.find_difference(tree, other, ([-1], [2])).holds
        False
    """
    with time_limit(max_seconds, lambda: f"{tree.n_leaves:,} leaves were compared with {other.n_leaves:,}"):
        return _find_difference(tree, other, box, max_difference, max_leaves)


def _find_difference(
    tree: ObliqueTree, other: ObliqueTree, box: Box | Domain, max_difference: float, max_leaves: int
) -> Verdict:
    n_pairs = tree.n_leaves * other.n_leaves
    if n_pairs > max_leaves:
        raise TreeTooLargeError(
            f"trees of {tree.n_leaves:,} and {other.n_leaves:,} leaves have {n_pairs:,} pairs of leaves, more than "
            f"{max_leaves:,}; compare a smaller tree, or raise max_leaves"
        )
    both = _both(tree, other)
    if both.labels is not None and max_difference:
        raise ValueError(f"max_difference is {max_difference}; labels are equal or not, leave it out")
    o = 1 if both.labels is not None else tree.n_outputs
    none, worst = np.zeros(tree.n_inputs), None
    for k in range(o):
        for sign in (1.0,) if both.labels is not None else (1.0, -1.0):
            action = np.zeros(both.n_outputs)
            action[[k, k + o]] = (0.0, 1.0) if both.labels is not None else (sign, -sign)
            verdict = find_violation(both, Condition(none, action, max_difference), box)
            if not verdict.holds:
                return verdict
            worst = verdict if worst is None or verdict.value > worst.value else worst
    assert worst is not None
    return worst


def _both(tree: ObliqueTree, other: ObliqueTree) -> ObliqueTree:
    """Return the tree that answers as two do, one after the other; of labels, whether they differ, 0 or 1."""
    sizes = (tree.n_inputs, other.n_inputs), (tree.n_outputs, other.n_outputs)
    if tree.n_inputs != other.n_inputs or (tree.labels is None) != (other.labels is None):
        raise ValueError(
            f"the trees have inputs {sizes[0]} and labels {tree.labels is not None, other.labels is not None}"
        )
    n, m, n_nodes, m_nodes = tree.n_leaves, other.n_leaves, tree.n_nodes, other.n_nodes
    # Below each leaf of the first hangs the whole second, whose nodes follow and whose leaves are numbered by pairs.
    roots = n_nodes + np.arange(n) * m_nodes if m_nodes else ~np.arange(n)
    upper = [
        np.where(side >= 0, side, roots[~np.minimum(side, -1)]) for side in (tree.children_left, tree.children_right)
    ]
    lower = [
        np.where(side >= 0, side + roots[:, None], ~(~side + np.arange(n)[:, None] * m)).ravel()
        for side in (other.children_left, other.children_right)
    ]
    left, right = (np.concatenate(sides) for sides in zip(upper, lower, strict=True))
    P, v = np.concatenate((tree.P, np.tile(other.P, (n, 1)))), np.concatenate((tree.v, np.tile(other.v, n)))
    if tree.labels is not None and other.labels is not None:
        differ = (tree.labels[:, None] != other.labels).ravel().astype(np.int64)
        M, c = np.zeros((n * m, 2, tree.n_inputs)), np.eye(2)[differ]
        return ObliqueTree(left, right, P, v, M, c, labels=differ, head=Argmax())
    if sizes[1][0] != sizes[1][1]:
        raise ValueError(f"the trees have {sizes[1][0]} and {sizes[1][1]} outputs; they must have the same")
    M = np.concatenate((np.repeat(tree.M, m, axis=0), np.tile(other.M, (n, 1, 1))), axis=1)
    c = np.concatenate((np.repeat(tree.c, m, axis=0), np.tile(other.c, (n, 1))), axis=1)
    return ObliqueTree(left, right, P, v, M, c, head=_head_of_both(tree.head, other.head, tree.n_outputs))


def _head_of_both(head: Head, other: Head, n_outputs: int) -> Head:
    """Return the head of what is compared of both."""
    if head == other and isinstance(head, Identity | TanhBox | Exp):
        return Identity()
    if isinstance(head, ClipBox) and isinstance(other, ClipBox):
        both = zip(head.limits(n_outputs), other.limits(n_outputs), strict=True)
        return ClipBox(*(np.concatenate(sides) for sides in both))
    raise ValueError(f"the heads are {head!r} and {other!r}; only answers of one kind of head are compared")
