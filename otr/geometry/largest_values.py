"""The largest values of affine functions over many polytopes at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from otr.clock import check_time
from otr.core.arrays import FloatArray, IntArray
from otr.core.half_spaces import HalfSpaces
from otr.errors import OtrError
from otr.geometry.simplex import MAX_PIVOTS, Bases, pivot

_CHUNK_NUMBERS = 2**20  # of the bases and rows in work at a time
_FEASIBLE = 1e-11  # what a row may be violated by


@dataclass(frozen=True)
class LargestValues:
    """What `largest_values` found: an objective is its value less the sum of the rows with these multipliers."""

    values: FloatArray  # (n,), -inf where the polytope is empty
    states: FloatArray  # (n, d) where they are taken; of no meaning where there are none
    rows: NDArray[np.int16]  # (n, d), the rows that bind there
    multipliers: FloatArray  # (n, d), each at least 0


def largest_values(rows: HalfSpaces, group: IntArray, signs: NDArray[np.int8], objectives: FloatArray) -> LargestValues:
    """Return the largest value of an affine function over each polytope, by the dual simplex method side by side.

    The first 2 d rows are the sides of a bounded domain, as `Domain.rows` gives them; `group` and `signs` are as in
    `largest_balls`; the objectives (n, d + 1) are affine forms [f | f0] in scaled coordinates.
    """
    d = objectives.shape[1] - 1
    size = max(64, _CHUNK_NUMBERS // max(1, d * (d + rows.n_rows)))
    parts = [slice(start, start + size) for start in range(0, max(len(objectives), 1), size)]
    found = [_of_a_chunk(rows, group[part], signs[part], objectives[part]) for part in parts]
    names = ("values", "states", "rows", "multipliers")
    return LargestValues(*(np.concatenate([getattr(each, name) for each in found]) for name in names))


def _of_a_chunk(rows: HalfSpaces, group: IntArray, signs: NDArray[np.int8], objectives: FloatArray) -> LargestValues:
    """Return what `largest_values` does, of few polytopes."""
    n, d = len(objectives), objectives.shape[1] - 1
    f, f0 = objectives[:, :d], objectives[:, d]
    # The corner of the box where the objective is largest is feasible in the dual.
    upper = f > 0
    normals = np.where(upper, 1.0, -1.0)
    bases = Bases(
        (np.arange(d) + d * upper).astype(np.int16), normals[:, :, None] * np.eye(d), normals.astype(np.float64)
    )
    found = LargestValues(np.full(n, -np.inf), np.zeros((n, d)), np.zeros((n, d), np.int16), np.zeros((n, d)))
    problems, absent, signed = np.arange(n), np.where(signs == 0, np.inf, 0.0), signs.astype(np.float64)
    whole, undecided = (rows.of(group), signed, f), list[int]()
    for _ in range(MAX_PIVOTS):
        check_time()
        margins = rows.values(group, bases.solution) * signed + absent
        tightest = margins.argmin(axis=1)
        margin = margins[np.arange(len(margins)), tightest]
        multipliers = np.einsum("nij,nj->ni", bases.inverse, f)
        done = margin >= -_FEASIBLE
        these = problems[done]
        found.values[these] = np.einsum("nd,nd->n", f[done], bases.solution[done]) + f0[done]
        found.states[these], found.rows[these] = bases.solution[done], bases.rows[done]
        found.multipliers[these] = multipliers[done]
        left = np.flatnonzero(~done)
        problems, group, signed, absent = problems[left], group[left], signed[left], absent[left]
        f, f0 = f[left], f0[left]
        if not left.size:
            break
        bases, tightest, margin = bases.take(left), tightest[left], margin[left]
        column = -signed[np.arange(len(left)), tightest][:, None] * rows.a[rows.of(group), tightest]
        stuck, direction = pivot(bases, column, margin, tightest, multipliers[left])
        ended = np.flatnonzero(stuck)
        if ended.size:  # a place that is too small to be left still counts, by as much as its row may be above 0
            at = (rows.of(group)[ended, None], bases.rows[ended].astype(np.int64))
            spans = np.abs(rows.a[at]).sum(axis=2) + np.abs(rows.b[at])
            most = margin[ended] + np.einsum("nd,nd->n", np.maximum(direction[ended], 0.0), spans)
            undecided += problems[ended[most >= 0]].tolist()
        go_on = np.flatnonzero(~stuck)
        problems, group, signed, absent = problems[go_on], group[go_on], signed[go_on], absent[go_on]
        f, f0, bases = f[go_on], f0[go_on], bases.take(go_on)
        if not go_on.size:
            break
    for problem in (*undecided, *problems.tolist()):
        check_time()
        of_group, signed, f = (each[problem] for each in whole)
        optimum = _largest_value_alone(rows.a[of_group], rows.b[of_group], signed, f)
        if optimum is not None:
            found.states[problem], found.rows[problem], found.multipliers[problem] = optimum
            found.values[problem] = f @ found.states[problem] + objectives[problem, d]
    return found


def _largest_value_alone(
    a: FloatArray, b: FloatArray, signs: FloatArray, f: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray] | None:
    """Return the state, rows and multipliers of the largest f . x over one polytope, by HiGHS; None if it is empty."""
    from scipy.optimize import linprog

    used, d = np.flatnonzero(signs), len(f)
    s = signs[used]
    solved = linprog(-f, A_ub=-s[:, None] * a[used], b_ub=s * b[used], bounds=[(None, None)] * d, method="highs")
    if solved.status == 2:
        return None
    if solved.status != 0:
        raise OtrError(
            f"HiGHS could not solve a linear program of {len(used)} rows in {d} dimensions: {solved.message}"
        )
    multipliers = -np.asarray(solved.ineqlin.marginals)
    binding = np.argsort(-multipliers, kind="stable")[:d]
    return np.asarray(solved.x), used[binding], multipliers[binding]
