import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.exceptions import NotFittedError
from sklearn.tree import DecisionTreeClassifier, DecisionTreeRegressor, ExtraTreeRegressor

from otr.learners import CARTClassifier, CARTRegressor, from_sklearn_tree


@given(
    seed=st.integers(0, 2**32 - 1),
    max_depth=st.none() | st.integers(1, 5),
    max_leaf_nodes=st.none() | st.integers(2, 20),
    bits=st.booleans(),
)
def test_the_tree_answers_as_scikit_learns(seed, max_depth, max_leaf_nodes, bits):
    rng = np.random.default_rng(seed)
    X, fresh = rng.normal(size=(2, 80, 4)).astype(np.float32)
    if bits:
        X, fresh = (X > 0).astype(float), (fresh > 0).astype(float)
    y = rng.integers(0, 3, 80)
    options = {"max_depth": max_depth, "max_leaf_nodes": max_leaf_nodes, "random_state": 0}
    classifier = DecisionTreeClassifier(**options).fit(X, y)
    tree = from_sklearn_tree(classifier)
    assert tree.n_leaves == classifier.get_n_leaves()
    assert tree.depth == classifier.get_depth()
    for states in (X, fresh):
        assert np.array_equal(classifier.classes_[tree.predict(states)], classifier.predict(states))
        assert np.array_equal(tree.forward(states), classifier.predict_proba(states))
    regressor = DecisionTreeRegressor(**options).fit(X, np.column_stack((y, X[:, 0])))
    assert np.array_equal(from_sklearn_tree(regressor).predict(fresh), regressor.predict(fresh))


def test_a_state_on_a_threshold_goes_left_in_both():
    model = DecisionTreeRegressor().fit([[0.0], [1.0]], [10.0, 20.0])
    tree = from_sklearn_tree(model)
    assert tree.P.tolist() == [[1.0]]
    assert tree.v.tolist() == [-0.5]
    on_both_sides = [[0.5], [np.nextafter(np.float32(0.5), np.float32(1))]]
    assert tree.predict(on_both_sides).tolist() == [[10.0], [20.0]]
    assert model.predict(on_both_sides).tolist() == [10.0, 20.0]


def test_a_test_for_missing_values_alone_sends_every_state_one_way():
    rng = np.random.default_rng(0)
    X, fresh = rng.normal(size=(2, 200, 3)).astype(np.float32)
    X[rng.random(200) < 0.3, 1] = np.nan
    y = X[:, 0] + 3.0 * np.isnan(X[:, 1])
    model = DecisionTreeRegressor(max_depth=4, random_state=0).fit(X, y)
    assert np.isinf(model.tree_.threshold[0])
    tree = from_sklearn_tree(model)
    assert (tree.n_leaves, tree.depth) == (model.get_n_leaves(), model.get_depth())
    assert np.array_equal(tree.predict(fresh)[:, 0], model.predict(fresh))


def test_other_trees_and_errors():
    X, y = np.random.default_rng(0).normal(size=(2, 50, 2))
    extra = ExtraTreeRegressor(random_state=0).fit(X, y)
    assert np.array_equal(from_sklearn_tree(extra).predict(X), extra.predict(X))
    with pytest.raises(TypeError, match="int, expected a DecisionTree"):
        from_sklearn_tree(3)
    with pytest.raises(NotFittedError):
        from_sklearn_tree(DecisionTreeRegressor())
    with pytest.raises(ValueError, match="has 2 outputs"):
        from_sklearn_tree(DecisionTreeClassifier().fit(X, (y > 0).astype(int)))


@pytest.mark.parametrize(
    ("ours", "theirs"), [(CARTClassifier, DecisionTreeClassifier), (CARTRegressor, DecisionTreeRegressor)]
)
def test_estimators_are_scikit_learns(ours, theirs):
    rng = np.random.default_rng(0)
    X = rng.integers(0, 2, (300, 20)).astype(float)
    y, weight = rng.integers(0, 3, 300), rng.integers(1, 4, 300)
    options = {"max_depth": 5, "min_samples_leaf": 2, "ccp_alpha": 1e-3, "random_state": 1}
    expected = theirs(**options).fit(X, y, weight).predict(X)
    assert np.array_equal(ours(**options).fit(X, y, weight).predict(X), expected)
