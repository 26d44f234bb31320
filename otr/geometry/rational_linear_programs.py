"""Linear programs solved in rational arithmetic: a point of a polytope, or the multipliers that show there is none.

    max t   subject to   a_i . x + b_i >= w_i t   for every row i,   t <= cap

With w_i the size of a_i for the rows that must be above 0, and 0 for those that may be 0, a largest t above 0 comes
with a point of the polytope, well inside the former rows, and one of at most 0 with a proof that there is none. With a
single w_i = 1 the largest t is that row's largest value over the others. The dual simplex method runs on integers: the
inverse of the basis is kept as the matrix of its cofactors, which are integers, and its determinant (Edmonds 1967), so
that nothing is rounded or reduced.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from otr.core.clock import check_time
from otr.geometry.rational import Integers, Point

_BLAND = 10  # times as many pivots as places, before the rule that cannot go round in circles
_FREE, _CAP = -2, -1  # what is tight at a place of the basis, where it is no row: x_j = 0, t = cap


@dataclass(frozen=True)
class Optimum:
    """What a linear program came to.

    With t, ``sum_i multiplier_i (a_i . x + b_i - w_i t')`` is `t - t'` at all x and t'. Without it, ``sum_i
    multiplier_i (a_i . x + b_i)`` is one number below 0 for all x.
    """

    t: Fraction | None  # the largest; None where the rows with w = 0 alone leave no point
    point: Point | None  # where; None where there is none
    multipliers: dict[int, Fraction]  # by row, above 0


def inner_point(rows: Integers, strict: Sequence[bool]) -> Optimum:
    """Return a point with ``a_i . x + b_i >= 0``, above 0 in the strict rows (m,), for integer rows [a | b] (m, d + 1).

    With ``t > 0`` there is a point. Else the sum of the rows with the multipliers is the same at all x, and it is below
    0, or 0 with a strict row in it.
    """
    sizes = [max(map(abs, row[:-1]), default=0) or 1 for row in rows.tolist()]
    weights = [size if is_strict else 0 for size, is_strict in zip(sizes, strict, strict=True)]
    return _largest_t(rows, weights, Fraction(1))


def largest_value(rows: Integers, form: Sequence[int], cap: Fraction) -> Optimum:
    """Return the largest value t of an affine form where no row is below 0, or `cap` if it is above that.

    Rows (m, d + 1) and form (d + 1,) are integers. Below the cap, the form and the sum of the rows with their
    multipliers, without its own, is t at all x.
    """
    m = len(rows)
    found = _largest_t(np.concatenate((rows, np.array([list(form)], dtype=object))), [0] * m + [1], cap)
    return replace(found, multipliers={row: value for row, value in found.multipliers.items() if row < m})


def _largest_t(rows: Integers, weights: Sequence[int], cap: Fraction) -> Optimum:
    """Return the largest t, as at the head of this file; `weights` are the w_i."""
    d = rows.shape[1] - 1
    q = d + 1  # places of the basis, and unknowns (x, t): over them a row is [a | -w], its offset b
    normals, offsets = np.column_stack((rows[:, :d], [-weight for weight in weights])), rows[:, d]
    sizes = [max(map(abs, row)) or 1 for row in normals.tolist()]
    # The rows x_j = 0, which no multiplier may hold, and cap.numerator - cap.denominator t >= 0.
    places, beta = [_FREE] * d + [_CAP], np.array([0] * d + [cap.numerator], dtype=object)
    inverse, determinant = np.diag(np.array([cap.denominator] * d + [-1], dtype=object)), cap.denominator
    n_pivots = 0
    while True:
        check_time()
        solution = -(inverse @ beta)
        margins = normals @ solution + offsets * determinant
        entering = _entering(margins.tolist(), sizes, determinant, n_pivots > _BLAND * q)
        if entering is None:
            t = Fraction(int(solution[d]), determinant)
            point = tuple(Fraction(int(value), determinant) for value in solution[:d])
            return Optimum(t, point, _multipliers(places, [-value for value in inverse[d]], determinant))
        steps = normals[entering] @ inverse
        leaving = _leaving(places, steps.tolist(), [-value for value in inverse[d]])
        if leaving is None:
            ray = _multipliers([*places, entering], [*(-steps), determinant], determinant)
            return Optimum(None, None, ray)
        pivot, column = steps[leaving], inverse[:, leaving].copy()
        inverse = (inverse * pivot - np.outer(column, steps)) // determinant
        inverse[:, leaving] = column
        determinant = pivot
        if determinant < 0:
            inverse, determinant = -inverse, -determinant
        places[leaving], beta[leaving] = entering, offsets[entering]
        n_pivots += 1


def _entering(margins: list[int], sizes: list[int], determinant: int, lowest_index: bool) -> int | None:
    """Return a row that the solution violates: the one by most, or the first; None if there is none."""
    violated = [row for row, margin in enumerate(margins) if margin < 0]
    if not violated:
        return None
    if lowest_index:
        return violated[0]
    return min(violated, key=lambda row: Fraction(margins[row], sizes[row] * determinant))


def _multipliers(places: list[int], values: Sequence[int], determinant: int) -> dict[int, Fraction]:
    """Return the multipliers that are not 0, by row."""
    return {
        place: Fraction(int(value), determinant)
        for place, value in zip(places, values, strict=True)
        if place >= 0 and value != 0
    }


def _leaving(places: list[int], steps: list[int], multipliers: list[int]) -> int | None:
    """Return the place that a row enters at: a free one, or the first whose multiplier falls to 0; None if none does.

    `places` says what is tight at each; `steps` are the entering row as a sum of the tight ones. They and the
    multipliers of the tight rows are times the determinant.
    """
    best: int | None = None
    for place, step in enumerate(steps):
        if places[place] == _FREE and step != 0:
            return place
        if places[place] == _FREE or step <= 0:
            continue
        if best is None:
            best = place
            continue
        # multipliers / steps, the smallest; of equal ones the lowest row, as Bland's rule wants.
        ours, least = multipliers[place] * steps[best], multipliers[best] * step
        if ours < least or (ours == least and places[place] < places[best]):
            best = place
    return best
