from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.linear_model import Ridge

from otr.learners import CARTRegressor, LinearTreeRegressor
from otr.learners.model_tree import _best_split, _midpoint


def hinge(n, seed=0):
    """Two planes that meet nowhere: 2 x0 + 1 where x1 <= 0.3, else -x0 + x2 - 4."""
    X = np.random.default_rng(seed).normal(size=(n, 3))
    return X, np.where(X[:, 1] <= 0.3, 2 * X[:, 0] + 1, X[:, 2] - X[:, 0] - 4)


def test_two_planes_are_found_exactly():
    X, y = hinge(2000)
    tree = LinearTreeRegressor(alpha=0.0, max_depth=4).fit(X, y).tree_
    assert tree.n_leaves == 2
    assert tree.P.tolist() == [[0.0, 1.0, 0.0]]
    below, above = X[X[:, 1] <= 0.3, 1].max(), X[X[:, 1] > 0.3, 1].min()
    assert below < -tree.v[0] < above  # the one gap of 1,999 where the planes part
    np.testing.assert_allclose(tree.M[:, 0], [[2, 0, 0], [-1, 0, 1]], atol=1e-9)
    np.testing.assert_allclose(tree.c[:, 0], [1, -4], atol=1e-9)


def test_a_linear_function_is_one_leaf():
    X = np.random.default_rng(0).normal(size=(300, 4)) * [1, 100, 1e-4, 1] + 50
    y = X @ [1.0, -2.0, 3e3, 0.0] + 7
    assert LinearTreeRegressor(alpha=0.0).fit(X, y).tree_.n_leaves == 1
    model = LinearTreeRegressor().fit(X, y)
    assert model.tree_.n_leaves == 1
    assert model.score(X, y) > 0.999


@given(seed=st.integers(0, 2**32 - 1), alpha=st.sampled_from([0.0, 0.1, 10.0]), n_outputs=st.integers(1, 3))
def test_depth_0_is_ridge_regression_on_standardised_inputs(seed, alpha, n_outputs):
    rng = np.random.default_rng(seed)
    X, Y = rng.normal(size=(60, 4)) * [1, 10, 0.1, 3] + 5, rng.normal(size=(60, n_outputs)) * 3 + 1
    Z = (X - X.mean(axis=0)) / X.std(axis=0)
    expected = Ridge(alpha=alpha).fit(Z, Y).predict(Z).reshape(Y.shape)
    model = LinearTreeRegressor(max_depth=0, alpha=alpha).fit(X, Y)
    np.testing.assert_allclose(model.predict(X), expected, atol=1e-8)


@given(seed=st.integers(0, 2**32 - 1), alpha=st.sampled_from([0.01, 1.0]), n_values=st.sampled_from([3, 1000]))
def test_the_split_is_the_best_of_all(seed, alpha, n_values):
    rng = np.random.default_rng(seed)
    X, Y = rng.integers(0, n_values, (30, 2)) / n_values, rng.normal(size=(30, 2))

    def objective(rows):
        A = X[rows] - X[rows].mean(axis=0)
        B = Y[rows] - Y[rows].mean(axis=0)
        W = np.linalg.solve(A.T @ A + alpha * np.eye(2), A.T @ B)
        return ((B - A @ W) ** 2).sum() + alpha * (W**2).sum()

    options = LinearTreeRegressor(alpha=alpha, min_samples_leaf=4, max_bins=64)
    gains = {}
    for column in range(2):
        order = X[:, column].argsort(kind="stable")
        for n_left in range(4, 27):
            if X[order[n_left], column] > X[order[n_left - 1], column]:
                sides = objective(order[:n_left]) + objective(order[n_left:])
                gains[column, n_left] = objective(np.arange(30)) - sides
    split = _best_split(X, X, Y, np.arange(2), options)
    assert split.gain == pytest.approx(max(gains.values()), abs=1e-6)
    assert gains[split.column, split.n_left] == pytest.approx(split.gain, abs=1e-6)


def test_few_bins_come_close():
    X, y = hinge(5000)
    y = y + 0.1 * np.random.default_rng(1).normal(size=5000)
    fresh, truth = hinge(5000, seed=2)
    for max_bins in (4, 8, 64):
        model = LinearTreeRegressor(max_depth=3, max_bins=max_bins).fit(X, y)
        assert model.score(fresh, truth) > 0.97
    assert CARTRegressor(max_depth=3).fit(X, y).score(fresh, truth) < 0.95


def test_leaves_are_large_enough_and_collinear_inputs_do_no_harm():
    X, y = hinge(400)
    X = np.column_stack((X, X[:, 0], np.ones(400)))
    model = LinearTreeRegressor(alpha=0.0, min_samples_leaf=25).fit(X, y)
    assert np.bincount(model.apply(X)).min() >= 25
    assert np.abs(model.tree_.M).max() < 10
    assert model.score(X, y) > 0.99


def test_neighbouring_floats_are_parted():
    x = 1.0 + np.finfo(float).eps * np.arange(3)  # the middle of one pair is rounded up, that of the other down
    for low, high in pairwise(x):
        assert low < high
        assert low <= _midpoint(np.array([high, low, high, low]), 2) < high


def test_max_features_draws_by_random_state():
    X, y = hinge(400)
    first, again, other = (LinearTreeRegressor(max_features=1, random_state=s).fit(X, y).tree_.P for s in (0, 0, 5))
    assert np.array_equal(first, again)
    assert first.shape != other.shape or not np.array_equal(first, other)
