"""How far apart two trees' actions can be on a box: a bound, by linear programs over pairs of leaves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.core.domain import Box, Domain, as_domain
from otr.core.half_spaces import HalfSpaces
from otr.core.tree import ObliqueTree
from otr.geometry.largest_balls import largest_balls
from otr.geometry.largest_values import largest_values
from otr.geometry.regions import leaf_paths, leaf_rows
from otr.proof.exact_cells import decide
from otr.proof.exact_rows import TreeOnDomain
from otr.proof.head_bounds import require_decided

_THIN = 1e-10  # radius of a ball, below which exact arithmetic says whether a meeting has a state
_ROUNDING = 4 * 2.0**-52  # relative, by which the numbers of one test may differ in two trees


def largest_difference(tree: ObliqueTree, other: ObliqueTree, box: Box | Domain) -> float:
    """Return a bound on the difference of any action of two trees over a box; it is taken where both heads are affine.

    For each pair of leaves whose regions meet, an action's difference is at most that of its ranges there and, under
    one and the same clip or tanh, at most the outputs' own difference times the head's steepest slope. Two tests are
    one where their numbers, divided by the largest coefficient, are the same to four units in the last place, or where
    one is the other reversed: states on which only their rounding, or the boundary itself, decides are left out. No
    other state of the box is. Of trees with labels the bound is 1 where there is a state in which they differ, else 0.

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
    leaves, others = np.nonzero(~_contradict(tree, other))
    n_meetings = len(leaves)
    rows, signs = leaf_rows(tree, domain, leaves)
    more, more_signs = leaf_rows(other, domain, others)
    n_sides = domain.rows().n_rows
    rows = rows.followed_by(more.take(slice(None), slice(n_sides, None)))
    signs = np.concatenate((signs, more_signs[:, n_sides:]), axis=1)
    balls = largest_balls(rows, np.arange(n_meetings), signs)
    counts = ~balls.is_empty
    thin = np.flatnonzero(counts & (balls.radii <= _THIN))
    if thin.size:
        ours, theirs = TreeOnDomain(tree, domain), TreeOnDomain(other, domain)
        for i in thin.tolist():
            of_others = {f"other {name}": row for name, row in theirs.rows_of_leaf(others[i]).items()}
            counts[i] = isinstance(decide(ours.rows_of_leaf(leaves[i]) | of_others, tree.n_inputs), tuple)
    at = np.flatnonzero(counts)
    return rows.take(at), signs[at], leaves[at], others[at]


def _contradict(tree: ObliqueTree, other: ObliqueTree) -> BoolArray:
    """Return which leaves (n, m) are on different sides of a test that both trees have."""
    sides, other_sides = _sides(tree), _sides(other)
    same = _same_tests(tree, other)
    # What a leaf of the tree says of the other's tests: that its states are above, or below.
    above = (sides > 0) @ (same > 0) | (sides < 0) @ (same < 0)
    below = (sides < 0) @ (same > 0) | (sides > 0) @ (same < 0)
    return np.asarray(above @ (other_sides < 0).T | below @ (other_sides > 0).T)


def _sides(tree: ObliqueTree) -> NDArray[np.int8]:
    """Return the side of each test that each leaf is on, (n_leaves, n_nodes); 0 where its path has not the test."""
    nodes, signs = leaf_paths(tree)
    sides = np.zeros((tree.n_leaves, tree.n_nodes + 1), dtype=np.int8)
    np.put_along_axis(sides, nodes, signs, axis=1)
    return sides[:, :-1]


def _same_tests(tree: ObliqueTree, other: ObliqueTree) -> NDArray[np.int8]:
    """Return which tests are the same but for rounding: (n, m), 1, or -1 where one is the other reversed."""
    sizes = (np.abs(each.P).max(axis=1, initial=0.0)[:, None] for each in (tree, other))
    with np.errstate(over="ignore", invalid="ignore"):
        ours, theirs = (
            each.test_forms / np.where(size > 0, size, np.nan) for each, size in zip((tree, other), sizes, strict=True)
        )
        same = np.zeros((len(ours), len(theirs)), dtype=np.int8)
        for sign in (1, -1):
            apart = np.abs(ours[:, None] - sign * theirs)
            same[(apart <= _ROUNDING * np.abs(ours)[:, None]).all(axis=2)] = sign
    return same


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
