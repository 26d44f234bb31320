"""How far apart two trees' actions can be on a box: a bound, by linear programs over pairs of leaves."""

from __future__ import annotations

import numpy as np

from otr.core.arrays import FloatArray, IntArray
from otr.core.domain import Box, Domain, as_domain
from otr.core.half_spaces import HalfSpaces
from otr.core.tree import ObliqueTree
from otr.geometry.largest_balls import largest_balls
from otr.geometry.largest_values import largest_values
from otr.geometry.regions import leaf_rows
from otr.geometry.simplex import Bases
from otr.proof.head_bounds import require_decided

_THIN = 1e-10  # radius; `largest_balls` finds a fifth of the largest, at least


def largest_difference(tree: ObliqueTree, other: ObliqueTree, box: Box | Domain) -> float:
    """Return a bound on the difference of any action of two trees over a box; it is taken where both heads are affine.

    For each pair of leaves whose regions meet, an action's difference is at most that of its ranges there and, under
    one and the same clip or tanh, at most the outputs' own difference times the head's steepest slope. Meetings that
    hold no ball of radius 1e-9, in the box's scale, may be left out: a test that is moved by rounding alone makes such
    slivers. On a box so small beside its distance from 0 that rounding hides how wide they are, they count. Of trees
    with labels the bound is 1 where a region exists in which they differ, else 0.

    Raises:
        ValueError: the box is unbounded, the trees do not fit each other, or no test of a tree decides its labels.
    """
    require_decided(tree)
    require_decided(other)
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
    rows, signs, leaves, others = _meetings(tree, other, domain)
    if tree.labels is not None and other.labels is not None:
        return float((tree.labels[leaves] != other.labels[others]).any())
    ranges = [_ranges(rows, signs, domain, each, at) for each, at in ((tree, leaves), (other, others))]
    (low, high), (other_low, other_high) = ranges
    apart = np.maximum(high - other_low, other_high - low)
    slope = tree.head.slopes(tree.n_outputs) if tree.head == other.head else None
    if slope is not None:
        between = tree.leaf_forms[leaves] - other.leaf_forms[others]
        widest = np.maximum(_largest(rows, signs, domain, between), _largest(rows, signs, domain, -between))
        apart = np.minimum(apart, slope * widest)
    return float(apart.max(initial=0.0))


def _meetings(
    tree: ObliqueTree, other: ObliqueTree, domain: Domain
) -> tuple[HalfSpaces, np.ndarray, IntArray, IntArray]:
    """Return rows and signs of the meetings of leaves that count, and the leaves that meet."""
    n, m = tree.n_leaves, other.n_leaves
    leaves, others = np.repeat(np.arange(n), m), np.tile(np.arange(m), n)
    rows, signs = leaf_rows(tree, domain, leaves)
    more, more_signs = leaf_rows(other, domain, others)
    n_sides = domain.rows().n_rows
    rows = rows.followed_by(more.take(slice(None), slice(n_sides, None)))
    signs = np.concatenate((signs, more_signs[:, n_sides:]), axis=1)
    balls = largest_balls(rows, np.arange(n * m), signs, Bases.start(n * m, tree.n_inputs))
    # Where rounding hides how wide a meeting is, it counts.
    is_hidden = ~balls.is_empty & (balls.radii == 0) & (rows.rounding.sum(axis=2).max(axis=1) > _THIN)
    at = np.flatnonzero((balls.radii > _THIN) | is_hidden)
    return rows.take(at), signs[at], leaves[at], others[at]


def _largest(rows: HalfSpaces, signs: np.ndarray, domain: Domain, forms: FloatArray) -> FloatArray:
    """Return the largest values of forms (n, o, d + 1), each over its own polytope: (n, o)."""
    n, o, _ = forms.shape
    each = np.repeat(np.arange(n), o)
    best = largest_values(
        rows, each, np.repeat(signs, o, axis=0), domain.scaled(forms).reshape(n * o, domain.n_inputs + 1)
    )
    return best.values.reshape(n, o)


def _ranges(
    rows: HalfSpaces, signs: np.ndarray, domain: Domain, tree: ObliqueTree, leaves: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return the smallest and the largest actions of leaves, (n, o) each, over polytopes: heads are monotone."""
    forms = tree.leaf_forms[leaves]
    low, high = -_largest(rows, signs, domain, -forms), _largest(rows, signs, domain, forms)
    return np.asarray(tree.head(low)), np.asarray(tree.head(high))
