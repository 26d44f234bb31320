"""How far apart two trees' actions can be on a box: a bound, by linear programs over pairs of leaves."""

from __future__ import annotations

import numpy as np

from otr.arrays import BoolArray, FloatArray, IntArray
from otr.domain import Box, Domain, as_domain
from otr.exact_cells import decide, largest_over, stacked
from otr.head import ClipBox, Head, Identity, TanhBox
from otr.linear_programs import Bases, largest_balls, largest_values
from otr.rational import Integers
from otr.regions import leaf_paths, leaf_rows
from otr.statement import TreeOnDomain
from otr.tree import ObliqueTree

__all__ = ["largest_difference"]


def largest_difference(tree: ObliqueTree, other: ObliqueTree, box: Box | Domain) -> float:
    """Return a bound on the difference of any action of two trees over a box; it is taken where both heads are affine.

    For each pair of leaves whose regions meet, an action's difference is at most that of its ranges there and, under
    one and the same clip or tanh, at most the outputs' own difference times the head's steepest slope. Pairs count that
    meet in some real point, however thin their meeting is.

    Args:
        tree, other: of as many inputs and outputs; each with an identity, clip or tanh head.
        box: bounded.

    Returns:
        The bound; 0 or 1 for trees with labels: whether a state exists where they differ.

    Raises:
        ValueError: the box is unbounded, or the trees do not fit each other.
    """
    domain = as_domain(box, tree.n_inputs)
    domain.require_bounded()
    ours, theirs = (
        (tree.n_inputs, tree.n_outputs, tree.labels is None),
        (other.n_inputs, other.n_outputs, other.labels is None),
    )
    if ours != theirs:
        raise ValueError(f"the trees have (inputs, outputs, values) {ours} and {theirs}; they must be the same")
    if not (tree.head.acts_by_output and other.head.acts_by_output):
        raise ValueError(
            f"the heads are {tree.head!r} and {other.head!r}; one that multiplies outputs has no such bound"
        )
    meetings = _Meetings(tree, other, domain)
    leaves, others = meetings.leaves, meetings.others
    if tree.labels is not None and other.labels is not None:
        return float((tree.labels[leaves] != other.labels[others]).any())
    (low, high), (other_low, other_high) = meetings.ranges(tree, leaves), meetings.ranges(other, others)
    apart = np.maximum(high - other_low, other_high - low)
    slope = _common_slope(tree.head, other.head, tree.n_outputs)
    if slope is not None:
        between = _outputs(tree, leaves) - _outputs(other, others)
        widest = np.maximum(meetings.largest(between), meetings.largest(-between))
        apart = np.minimum(apart, slope * widest)
    return float(apart.max(initial=0.0))


class _Meetings:
    """The meetings of two trees' leaves on a domain that some real point is in.

    Attributes:
        leaves, others: (n,) the leaves that meet.
    """

    def __init__(self, tree: ObliqueTree, other: ObliqueTree, domain: Domain) -> None:
        leaves, others = np.nonzero(~_part_ways(tree, other))
        n_pairs = len(leaves)
        rows, signs = leaf_rows(tree, domain, leaves)
        more, more_signs = leaf_rows(other, domain, others)
        n_sides = domain.rows().n_rows
        rows = rows.followed_by(more.take(slice(None), slice(n_sides, None)))
        signs = np.concatenate((signs, more_signs[:, n_sides:]), axis=1)
        balls = largest_balls(rows, np.arange(n_pairs), signs, Bases.start(n_pairs, tree.n_inputs))
        undecided = np.flatnonzero(~balls.is_empty & (balls.radii == 0)).tolist()
        self._thin: dict[int, Integers] = {}
        if undecided:
            power = max(TreeOnDomain(each, domain).power for each in (tree, other))
            ours, theirs = (TreeOnDomain(each, domain, power) for each in (tree, other))
            for pair in undecided:
                of_other = theirs.rows_of_leaf(int(others[pair]))
                together = ours.rows_of_leaf(int(leaves[pair])) | {
                    f"other {name}": row for name, row in of_other.items()
                }
                if isinstance(decide(together, tree.n_inputs), tuple):
                    self._thin[pair] = stacked(together, tree.n_inputs)
        at = np.concatenate((np.flatnonzero(balls.radii > 0), np.array(list(self._thin), dtype=np.int64)))
        self.leaves, self.others = leaves[at], others[at]
        self._rows, self._signs, self._domain = rows.take(at), signs[at], domain

    def largest(self, forms: FloatArray) -> FloatArray:
        """Return the largest values of forms (n, o, d + 1), each over its own meeting: (n, o)."""
        n, o, _ = forms.shape
        objectives = self._domain.scaled(forms).reshape(n * o, -1)
        best = largest_values(self._rows, np.repeat(np.arange(n), o), np.repeat(self._signs, o, axis=0), objectives)
        values = best.values.reshape(n, o)
        for at, rows in zip(range(n - len(self._thin), n), self._thin.values(), strict=True):
            if np.isinf(values[at]).any():  # too thin for floating point
                values[at] = [largest_over(rows, form, self._domain)[0] for form in forms[at]]
        return values

    def ranges(self, tree: ObliqueTree, leaves: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the smallest and the largest actions of leaves, (n, o) each, over the meetings: heads are monotone."""
        low, high = -self.largest(-_outputs(tree, leaves)), self.largest(_outputs(tree, leaves))
        return np.asarray(tree.head(low)), np.asarray(tree.head(high))


def _part_ways(tree: ObliqueTree, other: ObliqueTree) -> BoolArray:
    """Return whether leaves (n, m) of two trees lie on different sides of a test that is in both, number by number."""
    forms = np.concatenate((np.column_stack((tree.P, tree.v)), np.column_stack((other.P, other.v))))
    kinds = np.unique(forms, axis=0, return_inverse=True)[1].ravel() if len(forms) else np.zeros(0, dtype=np.int64)
    sides = []
    for each, of_node in ((tree, kinds[: tree.n_nodes]), (other, kinds[tree.n_nodes :])):
        paths = leaf_paths(each)
        outcomes = np.zeros((each.n_leaves, kinds.max(initial=-1) + 1), dtype=np.int32)
        leaf, place = np.nonzero(paths.nodes >= 0)
        outcomes[leaf, of_node[paths.nodes[leaf, place]]] = paths.signs[leaf, place]
        sides.append(outcomes)
    left, right = ([(side == sign).astype(np.int32) for side in sides] for sign in (-1, 1))
    return np.asarray(left[0] @ right[1].T + right[0] @ left[1].T > 0)


def _outputs(tree: ObliqueTree, leaves: IntArray) -> FloatArray:
    """Return the affine forms of leaves' outputs: (n, o, d + 1)."""
    forms: FloatArray = np.concatenate((tree.M, tree.c[:, :, None]), axis=2)[leaves]
    return forms


def _common_slope(head: Head, other: Head, n_outputs: int) -> FloatArray | None:
    """Return the steepest slope (n_outputs,) of two heads that are the same; None if they are not."""
    if head != other:
        return None
    if isinstance(head, Identity | ClipBox):
        return np.ones(n_outputs)
    if isinstance(head, TanhBox):
        return np.broadcast_to((head.high - head.low) / 2, (n_outputs,))
    return None
