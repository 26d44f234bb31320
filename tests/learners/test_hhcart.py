from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.tree import DecisionTreeClassifier, DecisionTreeRegressor

from otr.learners import CARTClassifier, HHCARTClassifier, HHCARTRegressor
from otr.learners.growing.eigenvector import dominant_direction
from otr.learners.growing.splits import best_bit_split, best_split
from otr.learners.hhcart import householder_normal
from tests.learners.problems import halves, strips


def random_state():
    return np.random.RandomState(0)


@pytest.mark.parametrize("shape", [(400, 150), (150, 400), (500, 10), (10, 500), (300, 1), (1, 3)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_direction_is_the_covariances_dominant_eigenvector(shape, dtype):
    rng = np.random.default_rng(0)
    X = (rng.normal(size=shape) + 3.0).astype(dtype)
    X += np.outer(rng.normal(size=shape[0]), rng.normal(size=shape[1])).astype(dtype) * 2
    eigenvalue, q = dominant_direction(X, random_state())
    if shape[0] == 1:
        assert eigenvalue == 0
        return
    values, vectors = np.linalg.eigh(np.atleast_2d(np.cov(X.astype(float).T, bias=True)))
    assert eigenvalue == pytest.approx(values[-1], rel=1e-4)
    assert abs(q @ vectors[:, -1]) == pytest.approx(1, abs=1e-4)
    assert np.linalg.norm(q) == pytest.approx(1, abs=1e-12)
    assert q[np.abs(q).argmax()] > 0


def test_the_direction_does_not_depend_on_the_mean():
    X = np.random.default_rng(0).normal(size=(300, 3)) * [1.0, 5.0, 2.0]
    centred, far = dominant_direction(X, random_state()), dominant_direction(X + 1e6, random_state())
    assert far[0] == pytest.approx(centred[0], rel=1e-6)
    np.testing.assert_allclose(far[1], centred[1], atol=1e-6)


def test_no_direction_in_constant_data():
    assert dominant_direction(np.full((200, 200), 0.1), random_state())[0] == 0
    assert dominant_direction(np.full((3, 2), 0.1), random_state())[0] == 0


@given(seed=st.integers(0, 2**32 - 1), d=st.integers(2, 6))
def test_the_reflection_takes_q_to_the_first_axis(seed, d):
    q = np.random.default_rng(seed).normal(size=d)
    q /= np.linalg.norm(q)
    u = householder_normal(q)
    distances = [np.linalg.norm(sign * q - axis) for axis in np.eye(d) for sign in (1, -1)]
    assert (u is None) == (min(distances) < 0.05)
    if u is not None:
        assert q - 2 * u * (u @ q) == pytest.approx(np.eye(1, d)[0], abs=1e-12)


@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(2, 40),
    n_values=st.integers(1, 6),
    min_leaf=st.integers(1, 4),
    reflected=st.booleans(),
    one_hot=st.booleans(),
)
def test_the_split_is_the_best_of_all(seed, n, n_values, min_leaf, reflected, one_hot):
    rng = np.random.default_rng(seed)
    X = rng.integers(0, n_values, (n, 3)).astype(float)
    Y = np.eye(3)[rng.integers(0, 3, n)] if one_hot else rng.normal(size=(n, 2))
    normal, Z = None, X
    if reflected:
        normal = np.array([2.0, -1.0, 2.0]) / 3
        Z = X - 2 * np.outer(X @ normal, normal)

    def impurity(part):
        return ((part - part.mean(axis=0)) ** 2).sum()

    def gain(left):
        return impurity(Y) - impurity(Y[left]) - impurity(Y[~left])

    gains = []
    for j in range(3):
        values = np.unique(Z[:, j])
        for low, high in pairwise(values):
            left = Z[:, j] <= low
            if high - low > 1e-9 and min(left.sum(), (~left).sum()) >= min_leaf:
                gains.append(gain(left))
    split = best_split(X, Y, normal=normal, min_samples_leaf=min_leaf, random_state=random_state())
    assert (split is None) == (not gains)
    if split is not None:
        assert split.gain == pytest.approx(max(gains), rel=1e-9, abs=1e-9)
        assert gain(Z[:, split.column] <= split.threshold) == pytest.approx(split.gain, rel=1e-9, abs=1e-9)


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 40), min_leaf=st.integers(1, 4), one_hot=st.booleans())
def test_bits_need_no_sort(seed, n, min_leaf, one_hot):
    rng = np.random.default_rng(seed)
    X = (rng.random((n, 5)) < rng.random(5)).astype(np.float32)
    Y = np.eye(3)[rng.integers(0, 3, n)] if one_hot else rng.normal(size=(n, 2))
    fast, slow = (
        search(X, Y, min_samples_leaf=min_leaf, random_state=random_state()) for search in (best_bit_split, best_split)
    )
    assert (fast is None) == (slow is None)
    if fast is not None:
        assert (fast.column, fast.threshold) == (slow.column, slow.threshold)
        assert fast.gain == pytest.approx(slow.gain, rel=1e-9, abs=1e-9)


def test_blocks_and_threads_change_nothing(monkeypatch):
    X, y, _ = halves(300, 6)
    whole = HHCARTClassifier(random_state=0).fit(X, y).tree_
    monkeypatch.setattr("otr.learners.growing.splits._BLOCK_ENTRIES", 600)
    in_blocks = HHCARTClassifier(random_state=0, n_jobs=2).fit(X, y).tree_
    assert np.array_equal(whole.P, in_blocks.P)
    assert np.array_equal(whole.v, in_blocks.v)


def test_without_a_reflection_it_is_cart():
    # The classes' dominant eigenvectors lie along an axis, where HHCART makes no reflection.
    rng = np.random.default_rng(0)
    X = rng.normal(size=(200, 3)) * [9.0, 1.0, 1.0]
    y = (X[:, 1] + X[:, 2] > 0).astype(int)
    ours, cart = HHCARTClassifier(max_depth=1).fit(X, y), DecisionTreeClassifier(max_depth=1).fit(X, y)
    assert np.array_equal(ours.predict(X), cart.predict(X))
    ours, cart = HHCARTRegressor(max_depth=1).fit(X, y), DecisionTreeRegressor(max_depth=1).fit(X, y)
    assert ours.predict(X) == pytest.approx(cart.predict(X))


@pytest.mark.parametrize(("make", "d"), [(strips, 2), (halves, 2), (halves, 5)])
def test_one_oblique_split_where_cart_needs_a_staircase(make, d):
    arguments = (400,) if make is strips else (400, d)
    X, y, normal = make(*arguments)
    fresh, truth, _ = make(*arguments, seed=1)
    hhcart, cart = (cls(max_depth=1, random_state=0).fit(X, y) for cls in (HHCARTClassifier, CARTClassifier))
    assert hhcart.score(fresh, truth) > 0.97
    assert cart.score(fresh, truth) < 0.95
    P = hhcart.tree_.P[0]
    assert abs(P @ normal) / np.linalg.norm(P) == pytest.approx(1, abs=0.02)


def test_regression_on_an_oblique_step():
    X, y, _ = strips(400)
    model = HHCARTRegressor(max_depth=1).fit(X, np.where(y == 1, 5.0, -1.0))
    assert sorted(model.tree_.c[:, 0]) == pytest.approx([-1.0, 5.0], abs=1e-9)


def test_leaf_limits():
    X, y, _ = halves(300, 3)
    model = HHCARTClassifier(min_samples_leaf=20, random_state=0).fit(X, y)
    assert np.bincount(model.apply(X)).min() >= 20
    assert HHCARTClassifier(min_samples_split=301).fit(X, y).tree_.n_leaves == 1
