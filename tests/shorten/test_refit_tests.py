"""Tests refitted by sparse linear discriminant analysis: what they keep, read and round."""

import numpy as np
import pytest

import otr
from otr.shorten.refit_tests import _lasso, _threshold, refit_tests

RNG = np.random.default_rng(0)
X = RNG.normal(size=(4000, 6))
X[:, 5] = X[:, 5] > 0.5  # a contact
# The first two tests hardly depend on most of what they read; the third is true of a contact alone.
P = [[0.6, 0.01, 0, 0, 0.02, 0], [0.01, 0.45, 0.01, 1.02, 0.02, 0.01], [0.002, 0.01, 0, 0.01, 0.01, -2.0]]
TREE = otr.ObliqueTree(
    [1, ~0, ~2], [2, ~1, ~3], P, [-0.06, 0.02, 1.0], np.zeros((4, 4, 6)), np.eye(4), labels=[2, 1, 0, 3],
    head=otr.Argmax(),
)  # fmt: skip


def test_what_hardly_matters_is_gone_and_the_bound_is_kept():
    simplified = refit_tests(TREE, X, agreement=0.95)
    np.testing.assert_array_equal((simplified.tree.P != 0).sum(axis=1), [1, 2, 1])
    assert [test.change for test in simplified.tests] == ["refitted"] * 3
    assert [test.n_coefficients for test in simplified.tests] == [1, 2, 1]
    assert simplified.tree.P[1, 3] == 1.0 and simplified.tree.P[1, 1] == pytest.approx(0.45, abs=0.2)
    for test in simplified.tests:
        reached = X[TREE.decision_path(X).toarray()[:, test.node] > 0]
        before, after = (tree.P[test.node] @ reached.T + tree.v[test.node] > 0 for tree in (TREE, simplified.tree))
        share = min((before == after)[before].mean(), (before == after)[~before].mean())
        assert test.agreement == share >= 0.95
        assert (test.n_left, test.n_right) == (np.count_nonzero(~before), np.count_nonzero(before))
    for name in ("children_left", "children_right", "M", "c", "labels"):
        np.testing.assert_array_equal(getattr(simplified.tree, name), getattr(TREE, name))
    assert simplified.tree.head == TREE.head
    counts = [np.count_nonzero(refit_tests(TREE, X, agreement=bound).tree.P[1]) for bound in (0.7, 0.9, 0.995)]
    assert counts == sorted(counts) and counts[0] == 1 < counts[-1]  # a tighter bound reads more inputs


def test_what_is_rounded_or_kept():
    tree = refit_tests(TREE, X, digits=2).tree
    assert all(value == float(f"{value:.1e}") for value in [*tree.P.ravel(), *tree.v])
    np.testing.assert_array_equal(np.abs(tree.P).max(axis=1), 1.0)
    simplified = refit_tests(TREE, X, nodes=[1])  # the others are rounded alone
    assert [test.change for test in simplified.tests] == ["rounded", "refitted", "rounded"]
    np.testing.assert_array_equal(simplified.tree.P[0], P[0])
    simplified = refit_tests(TREE, X[X @ P[0] - 0.06 <= 0])  # reached on one side only
    assert [test.change for test in simplified.tests] == ["kept", "refitted", "kept"]
    np.testing.assert_array_equal(simplified.tree.P[2], P[2])
    leaf = otr.ObliqueTree([], [], np.zeros((0, 6)), [], np.zeros((1, 1, 6)), [[1.0]])
    assert refit_tests(leaf, X).tests == ()
    # Rounded to a digit the threshold is 1, below all of the states.
    tree = otr.ObliqueTree([~0], [~1], [[1.0]], [-1.2345], np.zeros((2, 1, 1)), [[0.0], [1.0]])
    for digits, change in ((1, "kept"), (6, "rounded")):
        (test,) = refit_tests(tree, np.linspace(1.2, 1.26, 200)[:, None], agreement=1.0, digits=digits).tests
        assert test.change == change and test.agreement == 1.0
    # The threshold is in the widest of the best gaps.
    assert _threshold(np.array([0.0, 1.0, 4.0, 5.0]), np.array([False, False, True, True])) == 2.5
    values, right = np.array([0.0, 1.0, 2.0, 3.0, 6.0]), np.array([False, True, False, True, True])
    assert _threshold(values, right) == 2.5  # keeps both lefts and two of three rights


def test_the_lasso_meets_its_optimality_conditions():
    A = RNG.normal(size=(200, 6))
    A = (A - A.mean(axis=0)) / A.std(axis=0)
    gram, target = A.T @ A / 200, A.T @ (A[:, 0] - 0.5 * A[:, 3] + RNG.normal(size=200)) / 200
    w = _lasso(gram, target, 0.2, np.zeros(6), np.arange(6))
    gradient = gram @ w - target
    assert 0 < np.count_nonzero(w) < 6
    np.testing.assert_allclose(gradient[w != 0], -0.2 * np.sign(w[w != 0]), atol=1e-8)
    assert (np.abs(gradient[w == 0]) <= 0.2).all()


@pytest.mark.parametrize(
    ("words", "message"),
    [({"agreement": 0.0}, "agreement"), ({"agreement": 1.1}, "agreement"), ({"digits": 0}, "digits"),
     ({"nodes": [3]}, "nodes are")],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(words, message):
    with pytest.raises(ValueError, match=message):
        refit_tests(TREE, X, **words)
    for number in (np.nan, np.inf):
        with pytest.raises(ValueError, match="not finite"):
            refit_tests(TREE, np.full_like(X, number))
