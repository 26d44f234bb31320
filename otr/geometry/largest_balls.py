"""Whether there is a ball inside each of thousands of polytopes, and where: many small linear programs at once.

The polytope of problem p is ``{x : s_i (a_i . x + b_i) >= 0}`` over the rows i with sign s_i = +1 or -1, a_i of unit
length. Its largest ball, of centre x and radius t <= `LARGEST_RADIUS`, solves

    max t   subject to   s_i (a_i . x + b_i) >= t,   t <= LARGEST_RADIUS

and its dual

    min sum_i mu_i s_i b_i + mu_0 LARGEST_RADIUS   subject to   sum_i mu_i s_i a_i = 0,  sum_i mu_i + mu_0 = 1,  mu >= 0

The simplex method is run on the dual, in d + 1 rows, for all problems side by side: a child in a tree of polytopes goes
on from its parent's basis. It stops as soon as the answer is known. What it answers is then checked from the rows
themselves, their rounding reckoned with: a point must be inside by more than that, and multipliers, a Farkas
certificate, must leave no state that matters. What floating point cannot decide is answered as undecided; no answer
depends on the rounding of the pivots.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from otr.clock import check_time
from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.core.half_spaces import HalfSpaces, rounding_of_terms
from otr.geometry.balls_in_box import BoxBases, BoxSimplex, highest_in_box, opposite_rows
from otr.geometry.simplex import FREE, LARGEST_RADIUS, MAX_PIVOTS, Bases, pivot

_ROUNDED = 1e-10  # value of a test, in units of its slope, that rounding may hide on a side that is left out
_SLACK = 8.0  # times the rounding of a sum, for that of its multipliers
_GOOD_SHARE = 0.2  # of the bound on the radius: a point with such a margin is good enough
_ROUNDING = 1e-13  # of a row's value, relative to the size of the state, while pivoting
_TOUCHING = 1e-9  # radius of the largest ball in a polytope that may be a point, or none
_NO_RADIUS = 1e-12  # that the rounding of pivots may have left
_NO_MULTIPLIER = 1e-14  # that rounding may have left
_CHUNK_NUMBERS = 2**17  # of the inverses in work at a time; they should stay in the cache

AnyBases = Bases | BoxBases


@dataclass(frozen=True)
class Balls:
    """What `largest_balls` found.

    A radius of 0, where a polytope is not empty, says that it is undecided: the polytope is too thin for
    floating point.
    """

    is_empty: BoolArray  # (n,) whether it was shown that the polytope has no state that matters
    centres: FloatArray  # (n, d), inner points; of no meaning where the radius is 0
    radii: FloatArray  # (n,) of a ball around the centre that fits, hardly ever the largest; 0 where none was found
    bases: AnyBases  # to go on from; where a polytope is empty, the proof


def largest_balls(
    rows: HalfSpaces,
    group: IntArray,
    signs: NDArray[np.int8],
    bases: AnyBases | None = None,
    asked: int | None = None,
) -> Balls:
    """Return whether each polytope is empty, and a ball inside those where one is found.

    A polytope is called empty where its rows, wrong by as much as rounding may have made them, leave no state or, with
    a row `asked` about, where but for rounding that row is nowhere above 0, and with it below 1e-10; on an open domain,
    times the size of the rows' terms.

    Polytope p has the rows of group[p] with signs[p] (m,), 1, -1, or 0 where it does without the row. It starts from
    its basis: none, or that of a polytope that had some of the rows with the same signs.
    """
    n, d = len(group), rows.a.shape[2]
    if rows.in_box:
        return _balls_in_box(rows, group, signs, cast(BoxBases, bases or BoxBases.start(n)), asked)
    bases, q = cast(Bases, bases or Bases.start(n, d)), d + 1
    if not signs.shape[1]:  # no rows: any ball
        return Balls(np.zeros(n, dtype=np.bool_), bases.solution[:, :-1], np.full(n, LARGEST_RADIUS), bases)
    parts = []
    chunk = max(64, _CHUNK_NUMBERS // (q * q))
    for start in range(0, max(n, 1), chunk):
        check_time()
        part = slice(start, start + chunk)
        balls = _pivot_until_decided(rows, group[part], signs[part], bases.take(part), asked)
        parts.append(balls)
    return _of_chunks(parts)


def joined(parts: list[AnyBases]) -> AnyBases:
    """Return the bases of several lists of problems, all of one kind, as one."""
    if isinstance(parts[0], BoxBases):
        return BoxBases.concatenate(cast(list[BoxBases], parts))
    return Bases.concatenate(cast(list[Bases], parts))


def _of_chunks(parts: list[Balls]) -> Balls:
    if len(parts) == 1:
        return parts[0]
    return Balls(
        np.concatenate([part.is_empty for part in parts]),
        np.concatenate([part.centres for part in parts]),
        np.concatenate([part.radii for part in parts]),
        joined([part.bases for part in parts]),
    )


def _balls_in_box(
    rows: HalfSpaces, group: IntArray, signs: NDArray[np.int8], bases: BoxBases, asked: int | None
) -> Balls:
    """Return what `largest_balls` does, of polytopes in a box whose sides are no rows."""
    n, d = len(group), rows.a.shape[2]
    if not signs.shape[1]:
        return Balls(np.zeros(n, dtype=np.bool_), np.zeros((n, d)), np.full(n, LARGEST_RADIUS), bases)
    chunk = max(16, _CHUNK_NUMBERS * 4 // (signs.shape[1] * d))
    parts = []
    for start in range(0, max(n, 1), chunk):
        check_time()
        part = slice(start, start + chunk)
        parts.append(_in_box_until_decided(rows, group[part], signs[part], bases.take(part), asked))
    return _of_chunks(parts)


def _in_box_until_decided(
    rows: HalfSpaces, group: IntArray, signs: NDArray[np.int8], bases: BoxBases, asked: int | None
) -> Balls:
    """Solve one chunk; what stays undecided is tried alone."""
    n = len(group)
    is_empty, centres, radii = np.zeros(n, dtype=np.bool_), np.zeros((n, rows.a.shape[2])), np.zeros(n)
    done = bases.of_rows(signs.shape[1]).copied()
    problems = np.arange(n)
    if asked is not None:  # about a test that is a row already, often
        done.multipliers[:] = opposite_rows(rows, group, signs, asked)
        is_empty = _leaves_nothing_in_box(rows, group, signs, done.multipliers, asked)
        problems = np.flatnonzero(~is_empty)
    simplex = BoxSimplex(rows, group[problems], signs[problems], bases.take(problems))
    for _ in range(MAX_PIVOTS if problems.size else 0):
        margin, bound, rounding = simplex.margins(), simplex.bounds, rounding_at(simplex.states)
        of_asked = simplex.multipliers[:, asked] if asked is not None else np.zeros(len(problems))
        empty = (bound < _NO_RADIUS) & (bound + _ROUNDING < _ROUNDED * of_asked)
        decided = empty | (margin > np.maximum(_GOOD_SHARE * bound, rounding)) | (margin > bound - rounding)
        these = problems[decided]
        is_empty[these], centres[these] = empty[decided], simplex.states[decided]
        radii[these] = np.where(empty, 0.0, np.clip(margin, 0.0, LARGEST_RADIUS))[decided]
        done.put(these, simplex.bases().take(decided))
        left = np.flatnonzero(~decided)
        problems = problems[left]
        if not left.size:
            break
        simplex.take(left)
        stuck = simplex.step()
        problems = problems[~stuck]
        if not problems.size:
            break
        simplex.take(np.flatnonzero(~stuck))
    radii[_within_rounding(rows, group, signs, centres, radii)] = 0.0
    is_empty &= _leaves_nothing_in_box(rows, group, signs, done.multipliers, asked)
    for i in np.flatnonzero(~is_empty & (radii == 0.0)).tolist():
        check_time()
        g = rows.of(group[i : i + 1])
        solution, multipliers = _solved_alone(rows.a[g[0]], rows.b[g[0]], signs[i], rows.is_open)
        if solution is None:
            continue
        s = signs[i].astype(np.float64)
        centres[i], done.multipliers[i] = solution[:-1], multipliers
        radii[i] = max(0.0, np.where(s == 0, np.inf, s * (rows.a[g[0]] @ centres[i] + rows.b[g[0]])).min())
        at = (rows, group[i : i + 1], signs[i : i + 1])
        radii[i] *= not len(_within_rounding(*at, centres[i : i + 1], radii[i : i + 1]))
        is_empty[i] = radii[i] == 0 and _leaves_nothing_in_box(*at, done.multipliers[i : i + 1], asked)[0]
    return Balls(is_empty, centres, radii, done)


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


def farthest(rows: HalfSpaces, group: IntArray, signs: NDArray[np.int8], bases: AnyBases, asked: int) -> FloatArray:
    """Return a bound (n,), but for rounding, on the value of a row in each polytope, by the multipliers of bases.

    It is in the units that the row had before it was made of unit length, and infinite where they do not bound it.
    """
    of_group, at = rows.of(group), np.where(bases.rows >= 0, bases.rows, 0).astype(np.int64)
    weights = np.where(bases.rows >= 0, np.maximum(bases.multipliers, 0.0), 0.0)
    signed = weights * np.take_along_axis(signs, at, axis=1)
    slopes = np.abs(np.einsum("nq,nqd->nd", signed, rows.a[of_group[:, None], at]))
    slopes[:, rows.is_open] = np.where(slopes[:, rows.is_open] > 0, np.inf, 0.0)
    highest = np.einsum("nq,nq->n", signed, rows.b[of_group[:, None], at]) + slopes.sum(axis=1)
    of_asked = np.where(bases.rows == asked, weights, 0.0).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(of_asked > 0, highest / of_asked, np.inf) * rows.lengths[of_group, asked])


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


def _leaves_nothing_in_box(
    rows: HalfSpaces, group: IntArray, signs: NDArray[np.int8], multipliers: FloatArray, asked: int | None
) -> BoolArray:
    """Return whether multipliers (n, m) of rows show that there is no state that matters in the box."""
    weights = np.where(multipliers < _NO_MULTIPLIER, 0.0, multipliers)
    of_asked = weights[:, asked] if asked is not None else np.zeros(len(weights))
    highest, rounding, slopes, of_slopes = highest_in_box(rows, group, signs, weights)
    total = highest + rounding
    nothing = (total < 0) | ((highest <= _SLACK * rounding) & (total < _ROUNDED * of_asked))
    nothing &= weights.sum(axis=1) > 0.5
    allowed = _ROUNDED * of_asked[:, None] * of_slopes / rounding_of_terms(rows.a.shape[2])
    return np.asarray(nothing & (slopes + of_slopes <= allowed).all(axis=1))


def _solved_alone(
    a: FloatArray, b: FloatArray, signs: NDArray[np.int8], is_open: BoolArray | None = None
) -> tuple[FloatArray | None, FloatArray]:
    """Return one polytope's centre and radius (d + 1,), by HiGHS, None if it fails, and the multipliers (m,).

    The rows a (m, d), b (m,) have the signs (m,); inputs that are not open are in [-1, 1], None is all open.
    """
    from scipy.optimize import linprog

    used, d = np.flatnonzero(signs), a.shape[1]
    s = signs[used].astype(np.float64)
    constraints = np.column_stack((-s[:, None] * a[used], np.ones(len(used))))
    objective = np.append(np.zeros(d), -1.0)
    open_inputs = [True] * d if is_open is None else is_open.tolist()
    bounds = [(None, None) if each else (-1.0, 1.0) for each in open_inputs] + [(None, LARGEST_RADIUS)]
    solved = linprog(objective, A_ub=constraints, b_ub=s * b[used], bounds=bounds, method="highs")
    multipliers = np.zeros(len(signs))
    if solved.status != 0:
        return None, multipliers
    multipliers[used] = -np.asarray(solved.ineqlin.marginals)
    return np.asarray(solved.x), multipliers


def _solve_alone(a: FloatArray, b: FloatArray, signs: NDArray[np.int8]) -> tuple[FloatArray, float, Bases]:
    """Return one polytope's centre (d,), margin and basis, by HiGHS; the margin is 0 where it finds none.

    The rows a (m, d), b (m,) have the signs (m,).
    """
    used, d = np.flatnonzero(signs), a.shape[1]
    solution, multipliers = _solved_alone(a, b, signs)
    basis = Bases.start(1, d)
    if solution is None:
        return np.zeros(d), 0.0, basis
    margin = float((signs[used] * (a[used] @ solution[:d] + b[used])).min(initial=LARGEST_RADIUS))
    if margin > 0:
        return solution[:d], margin, basis
    largest = used[np.argsort(-multipliers[used], kind="stable")[: d + 1]]
    basis.rows[0], basis.inverse[0] = FREE, 0.0
    basis.rows[0, : len(largest)] = largest
    basis.inverse[0, : len(largest), d] = multipliers[largest]
    basis.solution[0] = solution
    return solution[:d], 0.0, basis
