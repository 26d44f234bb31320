"""What a tree in fixed point adds to the error of its rounded coefficients: bounds in rational arithmetic.

An input x_j of a box comes as the integer q_j, and the integers are those of the tree `FixedPointTree.to_tree` at
``q / t``, with t of `dyadic_scales`. Its outputs are then rounded by the shift, and by the head.
"""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.domain import Domain
from otr.core.fixed_point.tree import FixedPointTree
from otr.core.head import Head
from otr.core.heads import TanhBox
from otr.core.tree import ObliqueTree
from otr.fixed_point.tanh_table import table_error
from otr.geometry.rational import Integers, common_integers, integers
from otr.proof.exact_rows import Bounds, rounded_up

_DIVISION = Fraction(1, 2**51)  # relative, by which x / scale may be off in float64


def input_roundings(fixed: FixedPointTree, box: Domain) -> list[Fraction]:
    """Return bounds on |x_j - q_j / t_j| over a box, clamped inputs included: (d,)."""
    bounds = []
    for j, (scale, t) in enumerate(zip(fixed.input_scales, fixed.dyadic_scales()[0], strict=True)):
        low, high = int(fixed.input_low[j]), int(fixed.input_high[j])
        largest = max(abs(low), abs(high))
        nearest = scale / 2 + largest * abs(scale - 1 / t)
        if float(scale) != scale or math.frexp(scale)[0] != 0.5:
            nearest += (largest + 1) * scale * _DIVISION
        ends, (first, last) = (low / t, high / t), map(Fraction, (box.low[j], box.high[j]))
        farthest = max(last - ends[0], ends[1] - first)  # of any state and any integer
        bounds.append(min(max(nearest, ends[0] - first, last - ends[1]), farthest))
    return bounds


def wider_box(box: Domain, roundings: list[Fraction]) -> Domain:
    """Return the box with all that its states are rounded to."""
    sides = (zip(side.tolist(), roundings, strict=True) for side in (-box.low, box.high))
    low, high = ([rounded_up(Fraction(x) + step) for x, step in side] for side in sides)
    return Domain([-x for x in low], high)


def head_slopes(fixed: FixedPointTree) -> list[Fraction]:
    """Return by how much an answer changes, at most, when its output does, (o,): half the range of a TanhBox, else 1.

    Labels are answered, too: then it is about outputs.
    """
    if not isinstance(fixed.head, TanhBox):
        return [Fraction(1)] * fixed.n_outputs
    return [width / 2 for width in answer_ranges(fixed.head, fixed.n_outputs) or ()]


def output_roundings(fixed: FixedPointTree) -> list[Fraction]:
    """Return bounds on what the shift and the answer's unit add, (o,), in answers."""
    if fixed.labels is not None:
        return [Fraction(0)] * fixed.n_outputs
    slopes, near = head_slopes(fixed), fixed.dyadic_scales()[1]
    units, limits = fixed.leaf_scales, fixed.output_limits
    real = None if limits is None else fixed.head.limits(fixed.n_outputs)
    bounds = []
    for k, (slope, unit, t) in enumerate(zip(slopes, units, near, strict=True)):
        added = t / 2 if fixed.shifts[:, k].any() else Fraction(0)
        largest = 2 ** (fixed.accumulator_bits - 1 - int(fixed.shifts[:, k].min()))
        if limits is not None and real is not None:
            ends = [int(side[k]) for side in limits]
            largest = max(map(abs, ends))
            added += max(abs(end * t - Fraction(side[k])) for end, side in zip(ends, real, strict=True))
        bounds.append(slope * (added + largest * abs(unit - t)))
    return bounds


def table_errors(fixed: FixedPointTree) -> list[Fraction]:
    """Return bounds on what the table of a TanhBox adds, (o,), in answers; 0 under another head."""
    if fixed.table is None:
        return [Fraction(0)] * fixed.n_outputs
    pairs = zip(head_slopes(fixed), fixed.output_scales, strict=True)
    return [scale * table_error(fixed.table, k, half / scale) for k, (half, scale) in enumerate(pairs)]


def answer_ranges(head: Head, n_outputs: int) -> list[Fraction] | None:
    """Return the widths of the actions' ranges, (o,); None without limits."""
    limits = head.limits(n_outputs)
    pairs = None if limits is None else np.transpose(limits).tolist()
    return None if pairs is None else [Fraction(high) - Fraction(low) for low, high in pairs]


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
    steps, margins = np.array(input_roundings(fixed, box), dtype=object), []
    exact, rounded, power = _integers(tree.test_forms, fixed.to_tree().test_forms)
    sizes = zip(*(_sizes(each.test_forms, box) for each in (tree, fixed.to_tree())), strict=True)
    ratios = [ours / theirs if ours and theirs else 1.0 for ours, theirs in sizes]
    bounds = Bounds(box, power)
    for ours, theirs, ratio in zip(exact, rounded, ratios, strict=True):
        over, under = ratio.as_integer_ratio()
        apart = _largest(bounds, ours * under - theirs * over) / under
        margins.append(apart + Fraction(ratio) * (abs(theirs[:-1]) @ steps) / 2**power)
    return margins


def leaf_differences(fixed: FixedPointTree, tree: ObliqueTree, box: Domain) -> tuple[list[Fraction], list[Fraction]]:
    """Return by how much a leaf's maps differ, and rounded inputs change its value, where the sum is largest: (o,)."""
    exact, rounded, power = _integers(tree.leaf_forms, fixed.to_tree().leaf_forms)
    bounds, steps = Bounds(box, power), np.array(input_roundings(fixed, box), dtype=object)
    apart = np.array([[_largest(bounds, form) for form in forms] for forms in exact - rounded], dtype=object)
    changed = abs(rounded[..., :-1]) @ steps / 2**power
    worst, outputs = (apart + changed).argmax(axis=0), np.arange(fixed.n_outputs)
    return apart[worst, outputs].tolist(), changed[worst, outputs].tolist()


def _integers(exact: FloatArray, rounded: FloatArray) -> tuple[Integers, Integers, int]:
    """Return forms as integers over one power of two, and that power."""
    parts = integers(exact), integers(rounded)
    power = max(own for _, own in parts)
    ours, theirs = common_integers(parts, power)
    return ours, theirs, power


def _largest(bounds: Bounds, form: Integers) -> Fraction:
    """Return the largest absolute value of a form (d + 1,) over a box."""
    return max(bounds.highest(form), bounds.highest(-form))


def _sizes(forms: FloatArray, box: Domain) -> list[float]:
    """Return how far forms' values are from those in the middle, or a constant's size: the same on all machines."""
    terms = np.abs(forms[:, :-1]) * ((box.high - box.low) / 2)
    return [math.fsum(row) or abs(v) for row, v in zip(terms.tolist(), forms[:, -1].tolist(), strict=True)]
