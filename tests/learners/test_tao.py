import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import sparse
from sklearn.datasets import load_breast_cancer

from otr.learners import CARTClassifier, TAOClassifier
from otr.learners.tao import _Alternation
from tests.learners.problems import halves, rotated_xor, strips


@given(
    seed=st.integers(0, 2**32 - 1),
    n_classes=st.integers(2, 4),
    init=st.sampled_from(["cart", "random"]),
    bits=st.booleans(),
    C=st.sampled_from([1e-2, 1.0, 1e6]),
    surrogate=st.sampled_from(["squared_hinge", "logistic"]),
)
@example(seed=46, n_classes=3, init="random", bits=False, C=0.01, surrogate="squared_hinge")  # a row on a boundary
@settings(max_examples=30)
def test_the_training_loss_never_rises(seed, n_classes, init, bits, C, surrogate):
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(120, 6))
    y = np.digitize(X[:, 0] * X[:, 1] + X[:, 2] + 0.3 * rng.normal(size=120), np.linspace(-1, 1, n_classes - 1))
    if bits:
        X = (X > 0.8).astype(float)
    model = TAOClassifier(max_depth=4, init=init, C=C, surrogate=surrogate, tol=-1.0, max_iter=5, random_state=0)
    model.fit(X, y)
    assert len(model.loss_path_) == model.n_iter_ + 1 == 6
    assert (np.diff(model.loss_path_) <= 0).all()
    assert model.score(X, y) == pytest.approx(1 - model.loss_path_[-1], abs=0.02)  # leaves' majorities come once more
    assert model.score(X, y) >= 1 - model.loss_path_[-1] - 1e-12


def test_the_loss_path_starts_at_the_initial_tree():
    X, y = rotated_xor(300)
    cart = CARTClassifier(max_depth=3, random_state=0).fit(X, y)
    model = TAOClassifier(max_depth=3, random_state=np.random.RandomState(0)).fit(X, y)
    start = CARTClassifier(max_depth=3, random_state=np.random.RandomState(0)).fit(X, y)
    assert model.loss_path_[0] == pytest.approx(1 - start.score(X, y), abs=1e-12)
    assert model.score(X, y) >= cart.score(X, y)


@pytest.mark.parametrize("make", [lambda s: strips(400, s), lambda s: halves(400, 5, s)])
@pytest.mark.parametrize("penalty", ["l1", "l2"])
def test_one_oblique_split_where_cart_needs_a_staircase(make, penalty):
    X, y, normal = make(0)
    fresh, truth, _ = make(1)
    model = TAOClassifier(max_depth=1, penalty=penalty, C=100.0, random_state=0).fit(X, y)
    P = model.tree_.P[0]
    assert model.score(fresh, truth) > 0.98
    assert abs(P @ normal) / np.linalg.norm(P) > 0.98


def test_rotated_xor_with_three_tests():
    X, y = rotated_xor(800)
    fresh, truth = rotated_xor(2000, seed=1)
    scores = [TAOClassifier(max_depth=2, C=100.0, init="random", random_state=s).fit(X, y) for s in range(10)]
    best = max(scores, key=lambda model: model.score(X, y))
    assert best.tree_.n_nodes <= 3
    assert best.score(fresh, truth) > 0.97
    assert CARTClassifier(max_depth=2, random_state=0).fit(X, y).score(fresh, truth) < 0.92


def test_multi_class_stripes():
    rng = np.random.default_rng(0)
    along = rng.integers(0, 4, 600)
    Z = np.column_stack((along + rng.uniform(-0.35, 0.35, 600), rng.normal(size=600) * 3))
    X = Z @ np.array([[0.8, 0.6], [-0.6, 0.8]])
    y = np.array(list("abcd"))[along]
    tao = TAOClassifier(max_depth=3, C=100.0, random_state=0).fit(X, y)
    assert tao.score(X, y) > 0.95
    assert tao.score(X, y) > CARTClassifier(max_depth=3, random_state=0).fit(X, y).score(X, y) + 0.2


def test_l1_leaves_inputs_out():
    X, y, _ = halves(300, 20)
    noisy = np.column_stack((X, np.random.default_rng(0).normal(size=(300, 40))))
    used = {}
    for C in (0.02, 1.0):
        tree = TAOClassifier(max_depth=1, penalty="l1", surrogate="logistic", C=C, random_state=0).fit(noisy, y).tree_
        used[C] = (tree.P != 0).sum()
    assert 0 < used[0.02] < used[1.0] < 60


def test_sparse_bits_give_what_dense_ones_do(monkeypatch):
    rng = np.random.default_rng(0)
    X = (rng.random((300, 40)) < 0.1).astype(float)
    y = (X[:, :10].sum(axis=1) > X[:, 10:20].sum(axis=1)).astype(int)
    kept_sparse = TAOClassifier(random_state=0).fit(X, y)
    monkeypatch.setattr("otr.learners.tao._SPARSE_BELOW", 0.0)
    dense = TAOClassifier(random_state=0).fit(X, y)
    assert np.array_equal(kept_sparse.predict(X), dense.predict(X))
    np.testing.assert_allclose(kept_sparse.tree_.P, dense.tree_.P, atol=1e-6)


def test_a_reduced_problem_is_the_one_of_the_paper(monkeypatch):
    """Rows that both subtrees answer rightly, or neither, are no part of a node's problem."""
    solved = []
    solve = _Alternation._solve

    def spy(self, rows, target):
        solved.append((rows, target, self.tree()))
        return solve(self, rows, target)

    monkeypatch.setattr(_Alternation, "_solve", spy)
    X, y = rotated_xor(200)
    TAOClassifier(max_depth=2, random_state=0, max_iter=1).fit(X, y)
    rows, target, tree = solved[-1]  # the root's, solved last, when all below it is settled
    assert not sparse.issparse(X)
    subtrees = [int(tree.children_left[0]), int(tree.children_right[0])]
    answers = np.array([[_walk(tree, child, x) for child in subtrees] for x in X])
    right = answers == y[:, None]
    assert np.array_equal(rows, np.flatnonzero(right[:, 0] != right[:, 1]))
    assert np.array_equal(target, right[rows, 1])


def _walk(tree, reference, x):
    while reference >= 0:
        side = tree.children_left if tree.P[reference] @ x + tree.v[reference] <= 0 else tree.children_right
        reference = int(side[reference])
    return tree.c[~reference, 0]


def test_leaves_may_answer_labels_alone():
    X, y = load_breast_cancer(return_X_y=True)
    shares, labels = (
        TAOClassifier(max_depth=3, random_state=0, leaf_values=kind).fit(X, y) for kind in ("shares", "labels")
    )
    assert (shares.predict(X) == labels.predict(X)).all()
    assert set(np.unique(labels.predict_proba(X))) == {0.0, 1.0} != set(np.unique(shares.predict_proba(X)))
    assert (labels.predict_proba(X).argmax(axis=1) == labels.predict(X)).all()
