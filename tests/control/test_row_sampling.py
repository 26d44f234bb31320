import numpy as np
import pytest

from otr.control import draw_rows
from otr.control.dagger.iterate_selection import halving_plan, successive_halving


def test_rows_are_drawn_in_proportion_to_their_weight():
    weights = np.array([0.0, 1.0, 2.0, 5.0, 0.0])
    totals = np.zeros(5)
    for seed in range(4000):
        rows, counts = draw_rows(5, weights, 1000, np.random.default_rng(seed))
        assert counts.sum() == 5  # no more draws than rows
        totals[rows] += counts
    assert totals[[0, 4]].sum() == 0
    np.testing.assert_allclose(totals / totals.sum(), weights / 8, atol=0.012)  # 3.5 standard errors
    rows, counts = draw_rows(100, np.array([1e9, *np.ones(99)]), 30, np.random.default_rng(0))  # with replacement
    assert (rows.tolist(), counts.tolist()) == ([0], [30])
    rows, counts = draw_rows(2000, np.zeros(2000), 2000, np.random.default_rng(0))  # count as equal
    assert counts.sum() == 2000 and len(rows) == pytest.approx(2000 * (1 - np.exp(-1)), abs=80)
    rows, counts = draw_rows(1000, None, 400, np.random.default_rng(0))  # without weights, a row once at most
    assert (counts == 1).all() and len(np.unique(rows)) == 400 and np.array_equal(rows, np.sort(rows))
    assert rows.min() < 20 and rows.max() >= 980  # from everywhere
    assert draw_rows(7, None, 400, np.random.default_rng(0))[0].tolist() == list(range(7))


@pytest.mark.parametrize("n_candidates", [1, 2, 3, 51, 64])
def test_the_plan_halves_and_spends_what_it_may(n_candidates):
    plan = halving_plan(n_candidates, 75)
    assert sum(n for _, n in plan) == (75 if n_candidates > 1 else 0)
    left = n_candidates
    for n_left, _ in plan:
        assert n_left == max(2, (left + 1) // 2)
        left = n_left
    assert left <= 2
    assert [n for _, n in plan] == sorted(n for _, n in plan)
    assert n_candidates != 51 or plan == [(26, 2), (13, 5), (7, 9), (4, 20), (2, 39)]


def test_a_single_candidate_and_ties():
    assert successive_halving([[1.0]], 100, None)[0] == 0
    best, _ = successive_halving([[1.0], [2.0], [2.0]], 5, lambda stage, candidate, n: [2.0] * n)
    assert best == 1
    rng, noisy = np.random.default_rng(0), [[0.0]] * 5 + [[2.0]] + [[0.0]] * 10  # of 16 the sixth is better by 2
    best, _ = successive_halving(noisy, 80, lambda stage, c, n: list(rng.normal(2.0 * (c == 5), 1.0, n)))
    assert best == 5
    best, returns = successive_halving([[2.0], [1.0]], 5, lambda stage, candidate, n: [float(candidate)] * n)
    assert best == 1 and returns == [[2.0, 0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0, 1.0]]  # two play on, too
