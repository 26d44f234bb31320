"""Half-spaces with their rounding: the rows that polytopes are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from otr.core.arrays import BoolArray, FloatArray, IntArray

_UNIT = 2.0**-52  # of rounding
_TERMS = 8  # of a sum, besides two for each input: how often, at least, a number may have been rounded


@dataclass(frozen=True)
class HalfSpaces:
    """The rows that polytopes are made of, in groups; a polytope takes the rows of one group, with its own signs."""

    a: FloatArray  # (n_groups, m, d), each row of unit length, or 0
    b: FloatArray  # (n_groups, m)
    lengths: FloatArray  # (n_groups, m), of the rows before they were made of unit length
    rounding: FloatArray  # (n_groups, m, d + 1), the largest error of each number of a row [a | b]
    is_open: BoolArray  # (d,) whether an input has no limits
    in_box: bool = False  # whether the limits of the others, [-1, 1], bound every polytope without being rows

    @property
    def n_rows(self) -> int:
        """Number of rows m in a group."""
        return int(self.b.shape[1])

    def take(self, groups: IntArray | slice, rows: slice = slice(None)) -> HalfSpaces:
        """Return some groups, with some of their rows."""
        a, b, lengths, rounding = (part[groups, rows] for part in (self.a, self.b, self.lengths, self.rounding))
        return HalfSpaces(a, b, lengths, rounding, self.is_open, self.in_box)

    def followed_by(self, other: HalfSpaces) -> HalfSpaces:
        """Return the groups, which are as many, with the rows of both; a single group is repeated."""
        n = max(len(self.b), len(other.b))
        parts = [part if len(part.b) == n else part.take(np.zeros(n, dtype=np.int64)) for part in (self, other)]
        names = ("a", "b", "lengths", "rounding")
        a, b, lengths, rounding = (np.concatenate([getattr(part, name) for part in parts], axis=1) for name in names)
        return HalfSpaces(a, b, lengths, rounding, self.is_open, self.in_box)

    def of(self, group: IntArray) -> IntArray:
        """Return groups (n,) as indices into `a` and `b`: with a single one, every polytope is of that."""
        return np.zeros_like(group) if len(self.a) == 1 else group

    def values(self, group: IntArray, X: FloatArray) -> FloatArray:
        """Return ``a . x + b`` for every state X (n, d) and row of its group: (n, m)."""
        if len(self.a) == 1:
            values: FloatArray = X @ self.a[0].T
            values += self.b[0]
            return values
        values = np.einsum("nmd,nd->nm", self.a[group], X)
        values += self.b[group]
        return values


def rounding_of_terms(n_inputs: int) -> float:
    """Return the largest error of a sum over so many inputs, as a share of the size of its terms."""
    return _UNIT * (_TERMS + 2 * n_inputs)
