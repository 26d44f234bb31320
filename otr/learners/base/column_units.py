"""Units in which scikit-learn's splitter distinguishes values: columns are shifted and scaled for it, trees put back.

It rounds inputs to float32, takes values nearer than 1e-7 for equal, and splits no node whose impurity is below 2e-16.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import FloatArray, IntArray
from otr.core.tree import ObliqueTree

# A range of at least this, and at least this share of the largest number, leaves 10,000 values apart.
_LEAST_RANGE = 2.0**-10
_LARGEST = 2.0**100  # whose square float64 holds; float32 ends at 2**128
_CONSTANT = 1e-12  # range, compared with the largest number of a column, that rounding alone may make


@dataclass(frozen=True)
class Units:
    """The change of columns to ``(x - shift) * 2**exponent``, exact in float64; none for columns of ordinary size.

    Attributes:
        shift: (d,), a column's least value where its range is small compared with its numbers, else 0.
        exponent: (d,), of the range to [1, 2) where that is small or numbers are huge, else 0.
    """

    shift: FloatArray
    exponent: IntArray

    @classmethod
    def of(cls, values: NDArray[Any], *, jointly: bool = False) -> Units:
        """Return the units for values (n, d); with `jointly` the range that counts is the widest column's, for all."""
        low, high = (edge(axis=0).astype(np.float64) for edge in (values.min, values.max))
        size = np.maximum(np.abs(low), np.abs(high))
        half = high / 2 - low / 2  # the range itself may overflow
        half = np.where(half > _CONSTANT / 2 * size, half, 0.0)
        if jointly:
            half = np.full(half.shape, half.max())
        shift = np.where((half > 0) & (half < _LEAST_RANGE / 2 * size), low, 0.0)
        size = np.where(shift == 0, size, 0.0)
        if jointly:
            size = np.full(size.shape, size.max())
        is_small, is_huge = (half > 0) & (half < _LEAST_RANGE / 2), np.maximum(half, size) > _LARGEST
        exponent = np.where(is_small | is_huge, -np.frexp(np.where(half > 0, half, size))[1], 0).astype(np.int64)
        return cls(shift, exponent)

    @property
    def is_ordinary(self) -> bool:
        """Whether nothing changes."""
        return not (self.shift.any() or self.exponent.any())

    def changed(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return values (n, d) in these units; of ordinary columns alone, the array itself."""
        return values if self.is_ordinary else np.ldexp(values.astype(np.float64) - self.shift, self.exponent)

    def restored(self, values: FloatArray) -> FloatArray:
        """Return values (n, d) for those in these units."""
        return values if self.is_ordinary else np.ldexp(values, -self.exponent) + self.shift

    def restored_tests(self, tree: ObliqueTree) -> ObliqueTree:
        """Return the tree with constant leaves that sends x where `tree` sends x in these units.

        Exact for a test ``x_f - t <= 0``: its threshold is rounded down, so that a value above it stays above it.
        """
        if self.is_ordinary or not len(tree.v):
            return tree
        P = np.ldexp(tree.P, self.exponent)
        v = tree.v - P @ self.shift
        is_axis = (tree.P == 1).any(axis=1) & (np.count_nonzero(tree.P, axis=1) == 1)
        column = tree.P[is_axis].argmax(axis=1)
        P[is_axis] = tree.P[is_axis]
        v[is_axis] = -_sum_from_below(np.ldexp(-tree.v[is_axis], -self.exponent[column]), self.shift[column])
        return tree.replace(P=P, v=v)


def _sum_from_below(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the largest float64 that is not above a + b (Knuth's two-sum finds the rounding error)."""
    total = a + b
    rest = total - a
    error = (a - (total - rest)) + (b - rest)
    return np.where(error < 0, np.nextafter(total, -np.inf), total)
