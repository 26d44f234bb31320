"""Largest balls and largest values against HiGHS, warm starts included."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

import otr.geometry.largest_balls as balls_module
import otr.geometry.largest_values as values_module
from otr.core.domain import as_domain
from otr.core.half_spaces import HalfSpaces
from otr.geometry.largest_balls import Balls, largest_balls
from otr.geometry.largest_values import largest_values
from otr.geometry.simplex import FREE, LARGEST_RADIUS, Bases

CLOSE = 1e-9


def radius_by_highs(a: np.ndarray, b: np.ndarray, signs: np.ndarray) -> float:
    used = signs != 0
    s, d = signs[used].astype(float), a.shape[1]
    solved = linprog(
        np.append(np.zeros(d), -1.0),
        A_ub=np.column_stack((-s[:, None] * a[used], np.ones(used.sum()))),
        b_ub=s * b[used],
        bounds=[(None, None)] * d + [(None, LARGEST_RADIUS)],
    )
    assert solved.status == 0
    return float(solved.x[d])


def random_rows(rng: np.random.Generator, n_groups: int, m: int, d: int, degenerate: bool) -> HalfSpaces:
    if degenerate:  # few directions and offsets: duplicates, parallels, many rows through one point
        a, b = rng.integers(-1, 2, (n_groups, m, d)).astype(float), rng.integers(-1, 2, (n_groups, m)).astype(float)
        a[(a == 0).all(axis=2), 0] = 1.0
    else:
        a, b = rng.normal(size=(n_groups, m, d)), rng.normal(size=(n_groups, m))
    length = np.linalg.norm(a, axis=2)
    rounding = np.full((n_groups, m, d + 1), 1e-15)
    return HalfSpaces(a / length[..., None], b / length, length, rounding, np.zeros(d, dtype=bool))


def assert_balls_are_right(rows: HalfSpaces, group: np.ndarray, signs: np.ndarray, balls: Balls) -> None:
    for p, g in enumerate(np.zeros_like(group) if len(rows.a) == 1 else group):
        largest = radius_by_highs(rows.a[g], rows.b[g], signs[p])
        used = signs[p] != 0
        if balls.is_empty[p]:
            assert largest <= CLOSE
            basis, multipliers = balls.bases.rows[p], balls.bases.multipliers[p]
            of_rows = basis >= 0
            assert used[basis[of_rows]].all()
            assert (multipliers > -1e-9).all() and multipliers.sum() == pytest.approx(1)
            weights = multipliers[of_rows] * signs[p, basis[of_rows]]
            np.testing.assert_allclose(weights @ rows.a[g, basis[of_rows]], 0, atol=1e-8)
            assert weights @ rows.b[g, basis[of_rows]] < 0
            assert (np.abs(multipliers[basis == FREE]) < 1e-9).all()
        elif balls.radii[p] == 0:  # undecided: the largest ball is a point
            assert abs(largest) <= CLOSE
        else:
            margins = signs[p, used] * (rows.a[g, used] @ balls.centres[p] + rows.b[g, used])
            assert 0 < balls.radii[p] <= min(margins.min(initial=LARGEST_RADIUS), largest) + 1e-9


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(0, 12), st.booleans(), st.booleans())
def test_equals_highs(seed: int, d: int, m: int, degenerate: bool, in_groups: bool) -> None:
    rng = np.random.default_rng(seed)
    n = 12
    rows = random_rows(rng, n if in_groups else 1, m, d, degenerate)
    group, signs = np.arange(n) if in_groups else np.zeros(n, dtype=int), rng.integers(-1, 2, (n, m)).astype(np.int8)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(balls_module, "_solve_alone", lambda *_: pytest.fail("HiGHS was asked"))
        balls = largest_balls(rows, group, signs, Bases.start(n, d))
    assert_balls_are_right(rows, group, signs, balls)


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 10), st.booleans())
def test_goes_on_from_the_bases_of_fewer_rows(seed: int, d: int, m: int, degenerate: bool) -> None:
    rng = np.random.default_rng(seed)
    n = 10
    rows, group = random_rows(rng, 1, m, d, degenerate), np.zeros(n, dtype=int)
    signs = rng.choice([-1, 1], (n, m)).astype(np.int8)
    bases = Bases.start(n, d)
    for used in range(1, m + 1):
        fewer = rows.take(slice(None), slice(used))
        balls = largest_balls(fewer, group, signs[:, :used], bases)
        assert_balls_are_right(fewer, group, signs[:, :used], balls)
        go_on = np.flatnonzero(balls.radii > 0)
        signs, group, bases = signs[go_on], group[go_on], balls.bases.take(go_on)


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_what_the_simplex_method_leaves_is_solved_by_highs(seed: int, degenerate: bool) -> None:
    rng = np.random.default_rng(seed)
    rows, group = random_rows(rng, 1, 7, 3, degenerate), np.zeros(6, dtype=int)
    signs = rng.choice([-1, 1], (6, 7)).astype(np.int8)
    solved, solve_alone = [], balls_module._solve_alone
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(balls_module, "MAX_PIVOTS", 1)
        patch.setattr(balls_module, "_solve_alone", lambda *each: solved.append(each) or solve_alone(*each))
        balls = largest_balls(rows, group, signs, Bases.start(6, 3))
    assert solved
    assert_balls_are_right(rows, group, signs, balls)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(balls_module, "_CHUNK_NUMBERS", 1)
        assert_balls_are_right(rows, group, signs, largest_balls(rows, group, signs, Bases.start(6, 3)))


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(0, 10), st.booleans(), st.booleans())
def test_largest_values_equal_highs(seed: int, d: int, m: int, degenerate: bool, alone: bool) -> None:
    rng = np.random.default_rng(seed)
    n = 8
    rows = as_domain((-1.0, 1.0), d).rows().followed_by(random_rows(rng, 1, m, d, degenerate))
    signs = np.concatenate((np.ones((n, 2 * d)), rng.integers(-1, 2, (n, m))), axis=1).astype(np.int8)
    objectives = rng.integers(-2, 3, (n, d + 1)).astype(float) if degenerate else rng.normal(size=(n, d + 1))
    with pytest.MonkeyPatch.context() as patch:
        if alone:
            patch.setattr(values_module, "MAX_PIVOTS", 1)
        best = largest_values(rows, np.zeros(n, dtype=int), signs, objectives)
    for p in range(n):
        used = signs[p] != 0
        s = signs[p, used].astype(float)
        solved = linprog(-objectives[p, :d], -s[:, None] * rows.a[0, used], s * rows.b[0, used], bounds=(None, None))
        if solved.status == 2:
            assert best.values[p] == -np.inf
            continue
        assert best.values[p] == pytest.approx(-solved.fun + objectives[p, d], abs=1e-8)
        assert (best.multipliers[p] > -1e-9).all()
        # f . x + f0 = value - sum mu h
        weights = best.multipliers[p] * signs[p, best.rows[p]]
        np.testing.assert_allclose(-weights @ rows.a[0, best.rows[p]], objectives[p, :d], atol=1e-8)
        assert weights @ rows.b[0, best.rows[p]] + objectives[p, d] == pytest.approx(best.values[p], abs=1e-8)
