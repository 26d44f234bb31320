"""Trees rounded to integers: scales, coefficients of a given word, and shifts, such that no sum overflows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
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
_EXACT = 52  # bits of sums that are float64 numbers, too, whatever power of two they are multiplied by


class Words(NamedTuple):
    """What rows are rounded for: the largest |q| and the middle of each input, bits, and the largest sum."""

    reach: FloatArray
    middle: IntArray
    bits: int
    capacity: float

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
    if input_scales is None:
        # About half of the bits of a sum of d terms are for the inputs, and half for the coefficients.
        word = min(bits, (accumulator_bits + 3 - tree.n_inputs.bit_length()) // 2)
        reach = np.maximum(abs(domain.low), abs(domain.high)).tolist()
        inputs = [Fraction(largest or 1.0) / (2 ** (word - 1) - 1) for largest in reach]
    else:
        inputs = _given(input_scales, tree.n_inputs, "input_scales")
    low, high = (
        np.array([round(Fraction(x) / scale) for x, scale in zip(side.tolist(), inputs, strict=True)], dtype=np.int64)
        for side in (domain.low, domain.high)
    )
    outputs = None if output_scales is None else _given(output_scales, tree.n_outputs, "output_scales")
    is_dyadic = all(scale.numerator.bit_count() == scale.denominator.bit_count() == 1 for scale in outputs or ())
    capacity = 2.0 ** min(accumulator_bits - 1, _EXACT if is_dyadic else _EXACT - 18) - 1
    words = Words(np.maximum(abs(low), abs(high)).astype(np.float64), (low + high) // 2, bits, capacity)
    if words.rounding >= capacity:
        raise InvalidTreeError(
            f"test 0: the rounding of its row alone may reach {words.rounding:.0f}, and a sum is to stay below "
            f"{capacity:.0f}: give accumulator_bits=64, or fewer bits"
        )
    steps = np.array([float(scale) for scale in inputs])
    W, v = tree.P * steps, np.asarray(tree.v)
    P, thresholds = words.rounded(W, v, words.scale(W, v))
    leaves = _leaves(tree, domain, steps, words, outputs)
    return FixedPointTree(
        tree.children_left,
        tree.children_right,
        P,
        thresholds,
        leaves.M,
        leaves.c,
        leaves.shifts,
        low,
        high,
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


class _Leaves(NamedTuple):
    M: IntArray
    c: IntArray
    shifts: IntArray
    scales: tuple[Fraction, ...]
    table: TanhTable | None = None


def _leaves(
    tree: ObliqueTree, domain: Domain, steps: FloatArray, words: Words, given: list[Fraction] | None
) -> _Leaves:
    """Return the leaves' rows, whose shifts are the largest for their word, in the finest units that these allow."""
    o = tree.n_outputs
    if tree.labels is not None:
        none = np.zeros(tree.c.shape, dtype=np.int64)
        return _Leaves(np.zeros(tree.M.shape, dtype=np.int64), none, none, (Fraction(1),) * o)
    W, c = tree.M * steps, tree.c
    units = given if given is not None and not isinstance(tree.head, TanhBox) else None
    if units is None:
        units = _finest(words, W, c, _default_units(tree, domain, words.bits), tree.head)
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
    powers = np.exp2(shifts) / np.array([float(unit) for unit in units])
    M, offsets = words.rounded(W, c, powers)
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
    sizes = np.array([float(unit) for unit in units])
    scale = words.scale(W, np.abs(c) + sizes / 2)  # half a unit is added before the shift
    shifts = np.floor(np.log2(scale * sizes))
    return np.asarray(np.minimum(shifts, math.floor(math.log2(words.capacity)) - 1).astype(np.int64))


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
    if isinstance(tree.head, TanhBox):
        return [Fraction(1, 2**bits)] * tree.n_outputs
    limits = tree.head.limits(tree.n_outputs)
    if limits is None:
        reached = output_range(tree.replace(head=Identity()), domain)
        limits = reached.low, reached.high
    units = [_power_of_two(reach, bits) for reach in np.abs(limits).max(axis=0).tolist()]
    return [max(units)] * len(units) if tree.head.gives_labels else units
