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
from math import lcm

import numpy as np

from otr.clock import check_time
from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.geometry.rational import Integers, Point, integers

_FLAT = 1e-300  # length of a row that has none
_NEGLIGIBLE = 1e-13  # of the largest multiplier
_BLAND = 10  # times as many pivots as places, before the rule that cannot go round in circles
_FREE, _CAP = -2, -1  # what is tight at a place of the basis, where it is no row: x_j = 0, t = cap


@dataclass(frozen=True)
class Optimum:
    """The result of a linear program.

    With t, ``sum_i multiplier_i (a_i . x + b_i - w_i t')`` is `t - t'` at all x and t'. Without it, ``sum_i
    multiplier_i (a_i . x + b_i)`` is one number below 0 for all x.
    """

    t: Fraction | None  # the largest; None where the rows with w = 0 alone leave no point
    point: Point | None  # where; None where there is none
    multipliers: dict[int, Fraction]  # by row, above 0


@dataclass(frozen=True)
class ExactBox:
    """Limits of inputs, apart from the rows of a program, which then has few numbers that are not at a limit."""

    low: FloatArray  # (d,), of which both are finite, or both are not
    high: FloatArray


def inner_point(rows: Integers, strict: Sequence[bool], box: ExactBox | None = None) -> Optimum:
    """Return a point with ``a_i . x + b_i >= 0``, above 0 in the strict rows (m,), for integer rows [a | b] (m, d + 1).

    With ``t > 0`` there is a point. Else the sum of the rows with the multipliers is the same at all x, and it is below
    0, or 0 with a strict row in it; with a box, it is at most that at all x in it.
    """
    sizes = [max(map(abs, row[:-1]), default=0) or 1 for row in rows.tolist()]
    weights = [size if is_strict else 0 for size, is_strict in zip(sizes, strict, strict=True)]
    return _largest_t(rows, weights, Fraction(1)) if box is None else _in_box(rows, weights, Fraction(1), box)


def largest_value(rows: Integers, form: Sequence[int], cap: Fraction, box: ExactBox | None = None) -> Optimum:
    """Return the largest value t of an affine form where no row is below 0, or `cap` if it is above that.

    Rows (m, d + 1) and form (d + 1,) are integers. Below the cap, the form and the sum of the rows with their
    multipliers, without its own, is t at all x; with a box, at most t at all x in it.
    """
    m = len(rows)
    both, weights = np.concatenate((rows, np.array([list(form)], dtype=object))), [0] * m + [1]
    found = _largest_t(both, weights, cap) if box is None else _in_box(both, weights, cap, box)
    return replace(found, multipliers={row: value for row, value in found.multipliers.items() if row < m})


def _in_box(rows: Integers, weights: Sequence[int], cap: Fraction, box: ExactBox) -> Optimum:
    """Return the largest t in a box of many inputs: all but few are held at a limit, where the multipliers want them.

    HiGHS proposes which; where the multipliers of the exact solution would have others go to the other limit, the worst
    of these are set free, and the program is solved again.
    """
    bounded = np.isfinite(box.low)
    limits, power = integers(np.where(bounded, np.stack((box.low, box.high)), 0.0))
    free, is_high = _proposed(rows, weights, cap, box)
    unit = 2**power
    while True:
        check_time()
        held = np.flatnonzero(~free)
        at = np.where(is_high, limits[1], limits[0])
        offsets = rows[:, -1] * unit + rows[:, held] @ at[held]
        loose = np.flatnonzero(free)
        sides = _sides(np.flatnonzero(bounded[loose]), len(loose), limits[:, loose], unit)
        fewer = np.concatenate((np.column_stack((rows[:, loose] * unit, offsets)), sides))
        found = _largest_t(fewer, [*(weight * unit for weight in weights), *[0] * len(sides)], cap)
        multipliers = {row: value * unit for row, value in found.multipliers.items() if row < len(rows)}
        scale = lcm(*(value.denominator for value in multipliers.values()))
        slopes = sum((rows[row, :-1] * int(value * scale) for row, value in multipliers.items()), 0 * rows[0, :-1])
        gains = np.where(is_high, -slopes, slopes) * (limits[1] - limits[0])
        wrong = [j for j in held.tolist() if gains[j] > 0]
        if not wrong:
            point = [Fraction(int(value), unit) for value in at]
            for j, value in zip(loose.tolist(), found.point or (), strict=False):
                point[j] = value
            return Optimum(found.t, None if found.point is None else tuple(point), multipliers)
        free[sorted(wrong, key=gains.__getitem__)[-len(rows) :]] = True


def _sides(inputs: IntArray, d: int, limits: Integers, unit: int) -> Integers:
    """Return the sides of some of d inputs as rows (m, d + 1), of limits (2, d) in parts of a unit."""
    rows = np.zeros((2 * len(inputs), d + 1), dtype=np.int64).astype(object)
    each = np.arange(len(inputs))
    rows[each, inputs], rows[len(inputs) + each, inputs] = unit, -unit
    rows[:, -1] = np.concatenate((-limits[0, inputs], limits[1, inputs]))
    return rows


def _proposed(rows: Integers, weights: Sequence[int], cap: Fraction, box: ExactBox) -> tuple[BoolArray, BoolArray]:
    """Return which inputs are not at a limit where t is largest, and of the others which are at the higher one."""
    from scipy.optimize import linprog

    slopes, offsets, sizes = _in_half_widths(rows, box)
    unit = max((size // weight for size, weight in zip(sizes, weights, strict=True) if weight), default=1) or 1
    w = np.array([weight * unit / size for size, weight in zip(sizes, weights, strict=True)])
    bounded, is_wide = np.isfinite(box.low), box.low < box.high
    farthest = float(_half_widths(box)[1].max(initial=0.0)) or 1.0
    lengths = abs(slopes).max(axis=1, initial=0.0)
    lengths = np.where(lengths > 0, lengths, 1.0)
    bounds = [(-limit, limit) for limit in np.where(bounded, is_wide, np.inf).tolist()]
    objective, tops = np.append(np.zeros(len(bounds)), -1.0), [(None, float(cap / unit) / farthest)]
    rows_of_z = np.column_stack((-slopes, w * farthest)) / lengths[:, None]
    solved = linprog(objective, A_ub=rows_of_z, b_ub=offsets / lengths, bounds=bounds + tops, method="highs")
    z = np.full(len(bounds), -1.0) if solved.x is None else solved.x[:-1]
    return (abs(z) < 1) & is_wide | ~bounded, z >= 1


def _in_half_widths(rows: Integers, box: ExactBox) -> tuple[FloatArray, FloatArray, list[int]]:
    """Return rows' slopes (m, d) and offsets (m,) in half widths of a box from its middle, each over its row's size.

    So a small box is no smaller than a solver's tolerances.
    """
    sizes = [max(map(abs, row)) or 1 for row in rows.tolist()]
    a = np.array([[value / size for value in row] for row, size in zip(rows.tolist(), sizes, strict=True)])
    a = a.reshape(rows.shape)
    middle, half = _half_widths(box)
    return a[:, :-1] * half, a[:, -1] + a[:, :-1] @ middle, sizes


def _half_widths(box: ExactBox) -> tuple[FloatArray, FloatArray]:
    """Return the middle (d,) and the half widths of a box, 1 where there is none."""
    low, high = np.where(np.isfinite(box.low), (box.low, box.high), 0.0)
    half = np.where(low < high, (high - low) / 2, 1.0)
    return low + (high - low) / 2, half


def near_largest(rows: Integers, forms: Integers, box: ExactBox) -> tuple[FloatArray, list[dict[int, float]]] | None:
    """Return where forms (k, d + 1) are largest in a box where no row is below 0, and what bounds them, or None.

    These are states (k, d) and multipliers of rows, found by HiGHS in floating point, all programs as one: the sum of
    a form and the rows with its multipliers is nowhere in the box much above the form's largest value.
    """
    from scipy.optimize import linprog
    from scipy.sparse import eye_array, kron

    k, m = len(forms), len(rows)
    slopes, offsets, sizes = _in_half_widths(rows, box)
    objectives, _, of_forms = _in_half_widths(forms, box)
    lengths, of_objectives = (np.maximum(np.linalg.norm(each, axis=1), _FLAT) for each in (slopes, objectives))
    limits = np.where(np.isfinite(box.low), box.low < box.high, np.inf)
    solved = linprog(
        -(objectives / of_objectives[:, None]).ravel(),
        A_ub=kron(eye_array(k), -slopes / lengths[:, None], format="csr"),
        b_ub=np.tile(offsets / lengths, k),
        bounds=np.tile(np.column_stack((-limits, limits)), (k, 1)),
        method="highs",
    )
    if solved.status != 0:
        return None
    found = np.maximum(-solved.ineqlin.marginals.reshape(k, m), 0.0) * of_objectives[:, None] / lengths
    middle, half = _half_widths(box)
    return solved.x.reshape(k, -1) * half + middle, [
        {row: value * (size / sizes[row]) for row, value in enumerate(weights) if value > _NEGLIGIBLE * max(weights)}
        for weights, size in zip(found.tolist(), of_forms, strict=True)
    ]


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
