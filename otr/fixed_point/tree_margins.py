"""A rounded tree beside the tree that it was made from: by how much tests and leaves differ over a box."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from otr.core.domain import Domain
from otr.core.fixed_point_tree import FixedPointTree
from otr.core.tree import ObliqueTree
from otr.fixed_point.parts import input_roundings
from otr.fixed_point.slopes import Fractions, fractions, interval_product


def test_margins(fixed: FixedPointTree, tree: ObliqueTree, box: Domain) -> list[Fraction]:
    """Return the least |P x + v| of each test, (n_nodes,), above which integers and real numbers go the same way.

    A test is the same when multiplied by a positive number: that is the ratio of the sizes of their terms.

    Raises:
        ValueError: the trees have not the same nodes.
    """
    same = (fixed.n_nodes, fixed.n_inputs) == (tree.n_nodes, tree.n_inputs)
    for name in ("children_left", "children_right", "labels"):
        same = same and np.array_equal(getattr(fixed, name), getattr(tree, name))
    if not same:
        raise ValueError("the tree is not the one that was rounded: they differ in nodes or labels; give that one")
    roundings, margins = input_roundings(fixed, box), []
    for exact, rounded in zip(fractions(tree.test_forms), fractions(fixed.to_tree().test_forms), strict=True):
        sizes = [_size(form, box) for form in (exact, rounded)]
        ratio = sizes[0] / sizes[1] if all(sizes) else Fraction(1)
        margins.append(_largest(exact - ratio * rounded, box) + ratio * (abs(rounded[:-1]) @ np.array(roundings)))
    return margins


def leaf_differences(fixed: FixedPointTree, tree: ObliqueTree, box: Domain) -> tuple[list[Fraction], list[Fraction]]:
    """Return by how much the maps of a leaf differ, and the rounded one changes by the inputs' rounding: (o,) each."""
    steps = np.array(input_roundings(fixed, box), dtype=object)
    exact, rounded = (fractions(each.leaf_forms) for each in (tree, fixed.to_tree()))
    apart = [max(_largest(form, box) for form in exact[:, k] - rounded[:, k]) for k in range(fixed.n_outputs)]
    return apart, list((abs(rounded[..., :-1]) @ steps).max(axis=0))


def _largest(form: Fractions, box: Domain) -> Fraction:
    """Return the largest |p x + v| over a box of a form (d + 1,)."""
    ends = interval_product(form[:-1], fractions(box.low), fractions(box.high))
    return Fraction(max(abs(end + form[-1]) for end in ends))


def _size(form: Fractions, box: Domain) -> Fraction:
    """Return the sum of |p_j| times half the width of input j: how far a test's value is from that in the middle."""
    size = Fraction(abs(form[:-1]) @ (fractions(box.high) - fractions(box.low)) / 2)
    return size or abs(Fraction(form[-1]))
