"""Whether there is a ball inside each of thousands of polytopes, and where: many small linear programs at once.

The polytope of problem p is ``{x : s_i (a_i . x + b_i) >= 0}`` over the rows i with sign s_i = +1 or -1, a_i of unit
length. Its largest ball, of centre x and radius t <= `LARGEST_RADIUS`, solves

    max t   subject to   s_i (a_i . x + b_i) >= t,   t <= LARGEST_RADIUS

and its dual

    min sum_i mu_i s_i b_i + mu_0 LARGEST_RADIUS   subject to   sum_i mu_i s_i a_i = 0,  sum_i mu_i + mu_0 = 1,  mu >= 0

The simplex method is run on the dual, in d + 1 rows, for all problems side by side: a child in a tree of polytopes goes
on from its parent's basis. It stops as soon as the answer is known. What it answers is then checked from the rows
themselves, their rounding reckoned with: a point must be inside by more than that, and multipliers, a Farkas
certificate, must leave no state that matters. What cannot be told in floating point is answered as undecided; no answer
depends on the rounding of the pivots.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.core.clock import check_time
from otr.core.half_spaces import HalfSpaces, rounding_of_terms
from otr.geometry.simplex import FREE, LARGEST_RADIUS, MAX_PIVOTS, Bases, pivot

_ROUNDED = 1e-10  # value of a test, in units of its slope, that rounding may hide on a side that is left out
_SLACK = 8.0  # times the rounding of a sum, for that of its multipliers
_GOOD_SHARE = 0.2  # of the bound on the radius: a point with such a margin is good enough
_ROUNDING = 1e-13  # of a row's value, beside the size of the state, while pivoting
_TOUCHING = 1e-9  # radius of the largest ball in a polytope that may be a point, or none
_NO_RADIUS = 1e-12  # that the rounding of pivots may have left
_NO_MULTIPLIER = 1e-14  # that rounding may have left
_CHUNK_NUMBERS = 2**17  # of the inverses in work at a time; they should stay in the cache


@dataclass(frozen=True)
class Balls:
    """What `largest_balls` found.

    A radius of 0, where a polytope is not empty, says that it is undecided: the polytope is thinner than rounding
    tells.
    """

    is_empty: BoolArray  # (n,) whether it was shown that the polytope has no state that matters
    centres: FloatArray  # (n, d), inner points; of no meaning where the radius is 0
    radii: FloatArray  # (n,) of a ball around the centre that fits, hardly ever the largest; 0 where none was found
    bases: Bases  # to go on from; where a polytope is empty, the proof


def largest_balls(
    rows: HalfSpaces, group: IntArray, signs: NDArray[np.int8], bases: Bases, asked: int | None = None
) -> Balls:
    """Return whether each polytope is empty, and a ball inside those where one is found.

    A polytope is called empty where its rows, wrong by as much as rounding may have made them, leave no state or, with
    a row `asked` about, where but for rounding that row is nowhere above 0, and with it below 1e-10; on an open domain,
    times the size of the rows' terms.

    Polytope p has the rows of group[p] with signs[p] (m,), 1, -1, or 0 where it does without the row. It starts from
    its basis: `Bases.start`, or that of a polytope that had some of the rows with the same signs.
    """
    n, q = bases.rows.shape
    if not signs.shape[1]:  # no rows: any ball
        return Balls(np.zeros(n, dtype=np.bool_), bases.solution[:, :-1], np.full(n, LARGEST_RADIUS), bases)
    parts = []
    chunk = max(64, _CHUNK_NUMBERS // (q * q))
    for start in range(0, max(n, 1), chunk):
        check_time()
        part = slice(start, start + chunk)
        balls = _pivot_until_decided(rows, group[part], signs[part], bases.take(part), asked)
        parts.append(balls)
    if len(parts) == 1:
        return parts[0]
    return Balls(
        np.concatenate([part.is_empty for part in parts]),
        np.concatenate([part.centres for part in parts]),
        np.concatenate([part.radii for part in parts]),
        Bases.concatenate([part.bases for part in parts]),
    )


def _pivot_until_decided(
    rows: HalfSpaces, group: IntArray, signs: NDArray[np.int8], bases: Bases, asked: int | None
) -> Balls:
    """Solve one chunk; what stays undecided, or was decided on numbers that have drifted, is tried alone."""
    n, q = bases.rows.shape
    d = q - 1
    is_empty, centres, radii = np.zeros(n, dtype=np.bool_), np.zeros((n, d)), np.zeros(n)
    done = Bases.start(n, d)
    absent, signed = np.where(signs == 0, np.inf, 0.0), signs.astype(np.float64)
    problems, of_group = np.arange(n), group
    for _ in range(MAX_PIVOTS):
        margins = rows.values(of_group, bases.solution[:, :d])
        margins *= signed
        margins += absent
        tightest = margins.argmin(axis=1)
        margin = margins[np.arange(len(margins)), tightest]
        radius = bases.solution[:, d]
        rounding = rounding_at(bases.solution[:, :d])
        empty = _is_far_below(bases, asked)
        decided = empty | (margin > np.maximum(_GOOD_SHARE * radius, rounding)) | (margin > radius - rounding)
        if decided.any():
            these, left = problems[decided], np.flatnonzero(~decided)
            is_empty[these], centres[these] = empty[decided], bases.solution[decided, :d]
            radii[these] = np.where(empty, 0.0, np.clip(margin, 0.0, LARGEST_RADIUS))[decided]
            done.put(these, bases.take(decided))
            problems, of_group, signed, absent = problems[left], of_group[left], signed[left], absent[left]
            bases, tightest, margin = bases.take(left), tightest[left], margin[left]
        if not problems.size:
            break
        column = np.ones((len(problems), q))
        sign = signed[np.arange(len(problems)), tightest]
        np.multiply(rows.a[rows.of(of_group), tightest], -sign[:, None], out=column[:, :d])
        pivot(bases, column, margin - bases.solution[:, d], tightest, bases.multipliers)
    radii[_within_rounding(rows, group, signs, centres, radii)] = 0.0
    claimed = np.flatnonzero(is_empty)
    is_empty[claimed] = _leaves_nothing(rows, group[claimed], signs[claimed], done.take(claimed), asked)
    # A largest ball of almost no radius stays undecided; elsewhere rounding has spoilt the pivots.
    gone_wrong = np.abs(done.solution[:, d]) > _TOUCHING
    gone_wrong[problems] = True
    alone = np.flatnonzero(~is_empty & (radii == 0.0) & gone_wrong)
    if len(alone):
        solved = []
        for i, g in zip(alone.tolist(), rows.of(group)[alone].tolist(), strict=True):
            check_time()
            solved.append(_solve_alone(rows.a[g], rows.b[g], signs[i]))
        centres[alone], radii[alone] = np.stack([x for x, _, _ in solved]), [radius for _, radius, _ in solved]
        done.put(alone, Bases.concatenate([basis for _, _, basis in solved]))
        at = (rows, group[alone], signs[alone])
        radii[alone[_within_rounding(*at, centres[alone], radii[alone])]] = 0.0
        is_empty[alone] = (radii[alone] == 0.0) & _leaves_nothing(*at, done.take(alone), asked)
    return Balls(is_empty, centres, radii, done)


def rounding_at(X: FloatArray) -> FloatArray:
    """Return up to where the value of a row at each state (n, d) is rounding, for a start: (n,)."""
    rounding: FloatArray = _ROUNDING * (1e-2 + np.abs(X).max(axis=1, initial=0.0))
    return rounding


def _multiplier_of(bases: Bases, row: int | None) -> FloatArray:
    """Return the multiplier (n,) of one row in each basis; 0 where it has none."""
    multipliers: FloatArray = np.where(bases.rows == row, np.maximum(bases.multipliers, 0.0), 0.0).sum(axis=1)
    return multipliers


def _is_far_below(bases: Bases, asked: int | None) -> BoolArray:
    """Return whether bases look like a proof that there is no state that matters."""
    below = bases.solution[:, -1] < _ROUNDING
    at = np.flatnonzero(below)
    if at.size:
        radius = bases.solution[at, -1]
        multiplier = _multiplier_of(bases.take(at), asked)
        below[at] = (radius < _NO_RADIUS) & (radius + _ROUNDING < _ROUNDED * multiplier)
    return below


def _within_rounding(
    rows: HalfSpaces, group: IntArray, signs: NDArray[np.int8], centres: FloatArray, radii: FloatArray
) -> IntArray:
    """Return the problems whose centres may, by rounding, be on a wrong side of a row."""
    sizes = np.column_stack((np.abs(centres), np.ones(len(centres))))
    near = np.flatnonzero(radii <= sizes @ rows.rounding.max(axis=(0, 1), initial=0.0))
    if not near.size:
        return near
    margins = rows.values(group[near], centres[near]) * signs[near]
    rounding = np.einsum("nmd,nd->nm", rows.rounding[rows.of(group[near])], sizes[near])
    return np.asarray(near[((margins <= rounding) & (signs[near] != 0)).any(axis=1)])


def _leaves_nothing(
    rows: HalfSpaces, group: IntArray, signs: NDArray[np.int8], bases: Bases, asked: int | None
) -> BoolArray:
    """Return whether the multipliers of bases show that there is no state that matters, as `largest_balls` says."""
    at = np.where(bases.rows >= 0, bases.rows, 0).astype(np.int64)
    of_group = rows.of(group)[:, None]
    normals, sign = rows.a[of_group, at], np.take_along_axis(signs, at, axis=1)
    weights = np.where(bases.rows >= 0, bases.multipliers, 0.0)
    # Pivots leave more rounding in the multipliers than the rows have: one step of iterative refinement.
    missing = np.column_stack((np.einsum("nq,nqd->nd", weights * sign, normals), 1.0 - bases.multipliers.sum(axis=1)))
    weights += np.einsum("nqd,nd->nq", bases.inverse, missing)
    weights[(bases.rows < 0) | (weights < _NO_MULTIPLIER)] = 0.0
    signed = weights * sign
    multiplier = np.where(bases.rows == asked, weights, 0.0).sum(axis=1)
    errors = np.einsum("nq,nqd->nd", weights, rows.rounding[of_group, at])
    residual = np.abs(np.einsum("nq,nqd->nd", signed, normals))
    slopes = errors[:, :-1] + residual
    highest = np.einsum("nq,nq->n", signed, rows.b[of_group, at])
    total = highest + errors[:, -1] + slopes.sum(axis=1)
    # What is left over may be nothing but rounding, number by number.
    is_rounding = (highest <= _SLACK * errors[:, -1]) & (residual <= _SLACK * errors[:, :-1]).all(axis=1)
    nothing = (total < 0) | (is_rounding & (total < _ROUNDED * multiplier))
    nothing &= weights.sum(axis=1) > 0.5
    if rows.is_open.any():
        terms = errors[:, :-1] / rounding_of_terms(slopes.shape[1])
        small = slopes <= _ROUNDED * multiplier[:, None] * terms
        nothing &= small[:, rows.is_open].all(axis=1)
    return np.asarray(nothing)


def _solve_alone(a: FloatArray, b: FloatArray, signs: NDArray[np.int8]) -> tuple[FloatArray, float, Bases]:
    """Return one polytope's centre (d,), margin and basis, by HiGHS; the margin is 0 where it finds none.

    The rows a (m, d), b (m,) have the signs (m,).
    """
    from scipy.optimize import linprog

    used, d = np.flatnonzero(signs), a.shape[1]
    s = signs[used].astype(np.float64)
    constraints = np.column_stack((-s[:, None] * a[used], np.ones(len(used))))
    objective = np.append(np.zeros(d), -1.0)
    bounds = [(None, None)] * d + [(None, LARGEST_RADIUS)]
    solved = linprog(objective, A_ub=constraints, b_ub=s * b[used], bounds=bounds, method="highs")
    basis = Bases.start(1, d)
    if solved.status != 0:
        return np.zeros(d), 0.0, basis
    margin = float((s * (a[used] @ solved.x[:d] + b[used])).min(initial=LARGEST_RADIUS))
    if margin > 0:
        return solved.x[:d], margin, basis
    multipliers = -np.asarray(solved.ineqlin.marginals)
    largest = np.argsort(-multipliers, kind="stable")[: d + 1]
    basis.rows[0], basis.inverse[0] = FREE, 0.0
    basis.rows[0, : len(largest)] = used[largest]
    basis.inverse[0, : len(largest), d] = multipliers[largest]
    basis.solution[0] = solved.x
    return solved.x[:d], 0.0, basis
