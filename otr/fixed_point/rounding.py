"""Trees rounded to integers: scales, coefficients of a given word, and shifts, such that no sum overflows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from itertools import product
from typing import NamedTuple

import numpy as np

from otr.core.arrays import FloatArray, IntArray
from otr.core.domain import Box, Domain, as_domain
from otr.core.fixed_point.tanh_table import TanhTable
from otr.core.fixed_point.tree import HEADS_OF_INTEGERS, FixedPointTree
from otr.core.head import Head, no_entry
from otr.core.heads import Identity, TanhBox
from otr.core.pattern_tree import PatternTree
from otr.core.tree import ObliqueTree, require_tree
from otr.errors import InvalidTreeError
from otr.fixed_point.parts import answer_ranges
from otr.fixed_point.tanh_table import tanh_table
from otr.proof.properties import output_range

Scales = Sequence[float | Fraction | str]
_MOST_NUMBERS = 2**23  # that the search for the inputs' words rounds
_EXACT = 52  # bits of sums that are float64 numbers, too, whatever power of two they are multiplied by


class Words(NamedTuple):
    """What rows are rounded for: the inputs' ends, scales and widths, bits, and the largest sum."""

    low: IntArray
    high: IntArray
    steps: FloatArray  # what 1 of each input stands for
    widths: FloatArray  # of the box, in steps
    bits: int
    capacity: float

    @property
    def reach(self) -> FloatArray:
        """The largest |q| of each input."""
        return np.maximum(abs(self.low), abs(self.high)).astype(np.float64)

    @property
    def middle(self) -> IntArray:
        """The middle of each input."""
        return np.asarray((self.low + self.high) // 2)

    @property
    def rounding(self) -> float:
        """The most by which rounded rows reach farther than the numbers that they are of."""
        return float(self.reach.sum() + abs(self.middle).sum()) / 2 + 2

    def scale(self, W: FloatArray, c: FloatArray) -> FloatArray:
        """Return the largest numbers (...) by which rows W (..., d), c (...) may be multiplied and rounded."""
        largest, sums = np.abs(W).max(axis=-1, initial=0.0), np.abs(c) + np.abs(W) @ self.reach
        with np.errstate(divide="ignore"):
            by_word, by_sum = (2.0 ** (self.bits - 1) - 1) / largest, (self.capacity - self.rounding) / sums
        return np.asarray(np.minimum(np.minimum(by_word, by_sum), 2.0**1000))

    def rounded(self, W: FloatArray, c: FloatArray, scale: FloatArray) -> tuple[IntArray, IntArray]:
        """Return rows times their scales in integers; the offset makes up in the middle for the coefficients."""
        rows = np.rint(W * scale[..., None])
        offsets = np.rint((c + W @ self.middle) * scale - rows @ self.middle)
        return rows.astype(np.int64), offsets.astype(np.int64)

    def errors(self, W: FloatArray, scale: FloatArray) -> FloatArray:
        """Return by how much rounded rows, of rounded inputs, are off at most (...)."""
        rows = np.rint(W * scale[..., None]) / scale[..., None]
        return np.asarray(np.abs(rows - W) @ (self.widths / 2) + np.abs(rows) @ np.minimum(self.widths, 0.5))


def round_tree(
    tree: ObliqueTree | PatternTree,
    box: Domain | Box,
    bits: int,
    *,
    input_scales: Scales | None = None,
    output_scales: Scales | None = None,
    accumulator_bits: int = 32,
) -> FixedPointTree:
    """Return a tree in fixed point; arguments and errors are those of `to_fixed_point`."""
    tree = tree.to_tree() if isinstance(tree, PatternTree) else tree
    require_tree(tree)
    domain = as_domain(box, tree.n_inputs)
    domain.require_bounded()
    if not isinstance(tree.head, HEADS_OF_INTEGERS):
        raise no_entry(tree.head, "to_fixed_point")
    if not 2 <= bits <= 24:
        raise ValueError(f"bits is {bits}, expected 2 to 24")
    outputs = None if output_scales is None else _given(output_scales, tree.n_outputs, "output_scales")
    is_dyadic = all(scale.numerator.bit_count() == scale.denominator.bit_count() == 1 for scale in outputs or ())
    capacity = 2.0 ** min(accumulator_bits - 1, _EXACT if is_dyadic else _EXACT - 18) - 1
    is_given = outputs is not None and not isinstance(tree.head, TanhBox) and tree.labels is None
    units = outputs if outputs is not None and is_given else _default_units(tree, domain, bits)
    if input_scales is None:
        inputs = _input_scales(tree, domain, bits, accumulator_bits, capacity, units)
    else:
        inputs = _given(input_scales, tree.n_inputs, "input_scales")
    words = _words(inputs, domain, bits, capacity)
    if words.rounding >= capacity:
        raise InvalidTreeError(
            f"test 0: the rounding of its row alone may reach {words.rounding:.0f}, and a sum is to stay below "
            f"{capacity:.0f}: give accumulator_bits=64, or fewer bits"
        )
    W, v = tree.P * words.steps, np.asarray(tree.v)
    P, thresholds = words.rounded(W, v, words.scale(W, v))
    leaves = _leaves(tree, words, units, outputs)
    return FixedPointTree(
        tree.children_left,
        tree.children_right,
        P,
        thresholds,
        leaves.M,
        leaves.c,
        leaves.shifts,
        words.low,
        words.high,
        tuple(inputs),
        leaves.scales,
        bits,
        accumulator_bits,
        labels=tree.labels,
        head=tree.head,
        table=leaves.table,
        feature_names=tree.feature_names,
        output_names=tree.output_names,
    )


def _words(inputs: Sequence[Fraction], domain: Domain, bits: int, capacity: float) -> Words:
    """Return the words of inputs with some scales."""
    sides = ([Fraction(x) for x in side.tolist()] for side in (domain.low, domain.high))
    low, high = ([round(x / scale) for x, scale in zip(side, inputs, strict=True)] for side in sides)
    ends, steps = np.array((low, high), dtype=np.int64), _sizes(inputs)
    return Words(ends[0], ends[1], steps, (domain.high - domain.low) / steps, bits, capacity)


def _input_scales(
    tree: ObliqueTree, domain: Domain, bits: int, accumulator_bits: int, capacity: float, units: Sequence[Fraction]
) -> list[Fraction]:
    """Return what 1 of each input stands for: words of 2 to `bits` bits, not all of the same length.

    A longer word rounds its input less and, as its coefficient is smaller, that one more. All words start with about
    half of the bits of a sum; one is changed at a time while the largest error of a leaf, cubed, times the largest
    distance from a test becomes smaller.
    """
    reach = [Fraction(largest or 1.0) for largest in np.maximum(abs(domain.low), abs(domain.high)).tolist()]
    sizes = np.maximum(np.sqrt((tree.P**2).sum(axis=1)), 1e-300)
    n_left = _MOST_NUMBERS // (tree.P.size + tree.M.size)

    def scales(lengths: Sequence[int]) -> list[Fraction]:
        return [largest / (2 ** (length - 1) - 1) for largest, length in zip(reach, lengths, strict=True)]

    def cost(lengths: Sequence[int]) -> float:
        words, of_leaves = _words(scales(lengths), domain, bits, capacity), 0.0
        if words.rounding >= capacity:
            return math.inf
        W, M = tree.P * words.steps, tree.M * words.steps
        distance = (words.errors(W, words.scale(W, tree.v)) / sizes).max(initial=0.0)
        if tree.labels is None:
            errors = words.errors(M, np.exp2(_shifts(words, M, tree.c, units)) / _sizes(units))
            of_leaves = (errors.max(axis=0) / _sizes(units)).max()
        return float((of_leaves or 1.0) ** 3 * (distance or 1.0))

    best, improves = [min(bits, (accumulator_bits + 3 - tree.n_inputs.bit_length()) // 2)] * tree.n_inputs, True
    least = cost(best)
    while improves:
        improves = False
        for i, change in product(range(tree.n_inputs), (1, -1, -2)):
            tried = [*best[:i], best[i] + change, *best[i + 1 :]]
            if n_left > 0 and 2 <= tried[i] <= bits and (found := cost(tried)) < 0.999 * least:
                best, least, improves = tried, found, True
            n_left -= 1
    return scales(best)


class _Leaves(NamedTuple):
    M: IntArray
    c: IntArray
    shifts: IntArray
    scales: tuple[Fraction, ...]
    table: TanhTable | None = None


def _leaves(tree: ObliqueTree, words: Words, units: list[Fraction], given: list[Fraction] | None) -> _Leaves:
    """Return the leaves' rows, whose shifts are the largest for their word, in the finest units that these allow."""
    o = tree.n_outputs
    if tree.labels is not None:
        none = np.zeros(tree.c.shape, dtype=np.int64)
        return _Leaves(np.zeros(tree.M.shape, dtype=np.int64), none, none, tuple(units))
    W, c = tree.M * words.steps, tree.c
    if given is None or isinstance(tree.head, TanhBox):
        units = _finest(words, W, c, units, tree.head)
    scale = words.scale(W, c)
    shifts = _shifts(words, W, c, units)
    if shifts.size and shifts.min() < 0:
        leaf, output = np.argwhere(shifts == shifts.min())[0].tolist()
        needed, largest = 1 / float(units[output]), float(scale[leaf, output])
        raise InvalidTreeError(
            f"leaf {leaf}, output {output}: in units of {units[output]} its row is to be multiplied by {needed:.6g}, "
            f"and with {words.bits} bits and sums below {words.capacity:.0f} by {largest:.6g} at most: give a coarser "
            "output scale, more bits or accumulator_bits=64"
        )
    M, offsets = words.rounded(W, c, np.exp2(shifts) / _sizes(units))
    if not isinstance(tree.head, TanhBox):
        return _Leaves(M, offsets, shifts, tuple(units))
    halves = [width / 2 for width in answer_ranges(tree.head, o) or ()]
    scales = given if given is not None else [half / (2 ** (words.bits - 1) - 1) for half in halves]
    amplitudes = tuple(half / scale for half, scale in zip(halves, scales, strict=True))
    if max(amplitudes) >= 2 ** (words.bits - 1) or units[0] > 1:
        raise InvalidTreeError(
            f"tanh in integers: an action has {float(max(amplitudes)):.6g} units on each side of its middle, and a "
            f"word of {words.bits} bits holds {2 ** (words.bits - 1) - 1}; leaf rows need units of {units[0]}: "
            "give a coarser output scale, more bits or accumulator_bits=64"
        )
    unit_bits = units[0].denominator.bit_length() - 1
    return _Leaves(M, offsets, shifts, tuple(scales), tanh_table(amplitudes, unit_bits, words.bits))


def _shifts(words: Words, W: FloatArray, c: FloatArray, units: Sequence[Fraction]) -> IntArray:
    """Return by how many bits the rows' sums may be finer than the units, (n_leaves, o); below 0 if none are."""
    sizes = _sizes(units)
    scale = words.scale(W, np.abs(c) + sizes / 2)  # half a unit is added before the shift
    shifts = np.floor(np.log2(scale * sizes))
    return np.asarray(np.minimum(shifts, math.floor(math.log2(words.capacity)) - 1).astype(np.int64))


def _sizes(units: Sequence[Fraction]) -> FloatArray:
    return np.array([float(unit) for unit in units])


def _finest(words: Words, W: FloatArray, c: FloatArray, units: list[Fraction], head: Head) -> list[Fraction]:
    """Return units that are coarser where rows would not fit their words; for labels and tables all of them are."""
    while (least := _shifts(words, W, c, units).min(axis=0, initial=0)).min(initial=0) < 0:
        if isinstance(head, TanhBox) or head.gives_labels:
            least = np.full(len(least), least.min())
        units = [unit * 2 ** -int(shift) if shift < 0 else unit for unit, shift in zip(units, least, strict=True)]
    return units


def _power_of_two(reach: float, bits: int) -> Fraction:
    """Return the smallest power of two of which a word holds the multiple that is nearest to a number."""
    exponent = math.frexp(reach)[1] - bits if reach else 0
    while round(Fraction(reach) / Fraction(2) ** exponent) >= 2 ** (bits - 1):
        exponent += 1
    return Fraction(2) ** exponent


def _given(scales: Scales, n: int, name: str) -> list[Fraction]:
    given = [Fraction(scale) for scale in np.ravel(np.array(scales, dtype=object)).tolist()]
    if len(given) != n or min(given) <= 0:
        raise ValueError(f"{name} is {scales}, expected {n} numbers above 0")
    return given


def _default_units(tree: ObliqueTree, domain: Domain, bits: int) -> list[Fraction]:
    """Return what 1 of a leaf's integer is to stand for, (o,), where no row needs a coarser unit."""
    if tree.labels is not None:
        return [Fraction(1)] * tree.n_outputs
    if isinstance(tree.head, TanhBox):
        return [Fraction(1, 2**bits)] * tree.n_outputs
    limits = tree.head.limits(tree.n_outputs)
    if limits is None:
        reached = output_range(tree.replace(head=Identity()), domain)
        limits = reached.low, reached.high
    units = [_power_of_two(reach, bits) for reach in np.abs(limits).max(axis=0).tolist()]
    return [max(units)] * len(units) if tree.head.gives_labels else units
