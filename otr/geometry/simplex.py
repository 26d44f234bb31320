"""The simplex method for many small linear programs side by side: bases, and one pivot of all of them.

It is run on the duals: a basis stays feasible when a row is added to its problem, so a problem goes on from the basis
of one with fewer rows and needs few pivots.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import BoolArray, FloatArray, IntArray

LARGEST_RADIUS = 1.0  # of a ball, so that unbounded polytopes have one
FREE = -1  # in a basis: the place of a coordinate that no row has fixed yet
MAX_PIVOTS = 200  # afterwards HiGHS takes over
_CAP = -2  # in a basis: the row t <= LARGEST_RADIUS
_SMALLEST_PIVOT = 1e-9


@dataclass(frozen=True)
class Bases:
    """The current bases of the simplex method in n problems; q = d + 1."""

    rows: NDArray[np.int16]  # (n, q), the row at each place, `FREE` or the radius's own
    inverse: FloatArray  # (n, q, q), of the matrix whose columns are (-s a, 1); its last column is the multipliers mu
    solution: FloatArray  # (n, q), centre and radius (x, t) of the basis

    @classmethod
    def start(cls, n: int, d: int) -> Bases:
        """Return the basis of polytopes without rows: a ball of the largest radius around 0."""
        rows = np.full((n, d + 1), FREE, dtype=np.int16)
        rows[:, d] = _CAP
        solution = np.zeros((n, d + 1))
        solution[:, d] = LARGEST_RADIUS
        return cls(rows, np.tile(np.eye(d + 1), (n, 1, 1)), solution)

    def take(self, problems: Any) -> Bases:
        """Return the bases of some problems."""
        return Bases(self.rows[problems], self.inverse[problems], self.solution[problems])

    @classmethod
    def concatenate(cls, parts: list[Bases]) -> Bases:
        """Return the bases of several lists of problems as one."""
        return cls(
            *(np.concatenate([getattr(part, name) for part in parts]) for name in ("rows", "inverse", "solution"))
        )

    def put(self, problems: IntArray, bases: Bases) -> None:
        """Write `bases` in the place of some problems'."""
        self.rows[problems], self.inverse[problems] = bases.rows, bases.inverse
        self.solution[problems] = bases.solution

    @property
    def multipliers(self) -> FloatArray:
        """The multipliers mu (n, q) of the rows in the basis; they sum to 1."""
        return self.inverse[:, :, -1]


def pivot(
    bases: Bases, column: FloatArray, value: FloatArray, entering: IntArray, multipliers: FloatArray
) -> tuple[BoolArray, FloatArray]:
    """Let the rows `entering` (n,) into the n bases, in place.

    A row's normal, turned outwards, is `column` (n, q), its value at the present solution, below 0, `value` (n,); the
    multipliers (n, q) are of the rows in the basis. Return (n,) whether no place can be left, as the polytope is empty
    or next to it: such a basis keeps its rows and is of no more use. Also (n, q), the normals as sums of those in
    the basis.
    """
    basis, inverse, solution = bases.rows, bases.inverse, bases.solution
    each = np.arange(len(basis))
    direction = np.matmul(inverse, column[:, :, None])[:, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.maximum(multipliers, 0.0) / direction
    free = basis == FREE
    ratio[free | (direction <= _SMALLEST_PIVOT)] = np.inf
    # A free place holds a multiplier of zero that must stay zero: it leaves first, the largest pivot before others.
    leaves_free = free & (np.abs(direction) > _SMALLEST_PIVOT)
    ratio[leaves_free] = -np.abs(direction[leaves_free])
    leaving = ratio.argmin(axis=1)
    stuck: BoolArray = np.isinf(ratio[each, leaving])
    with np.errstate(divide="ignore", invalid="ignore"):
        row = inverse[each, leaving] / direction[each, leaving, None]
    row[stuck] = 0.0
    inverse -= direction[:, :, None] * row[:, None, :]
    inverse[each, leaving] = row
    solution += value[:, None] * row
    basis[each[~stuck], leaving[~stuck]] = entering[~stuck]
    return stuck, direction
