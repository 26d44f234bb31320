"""scikit-learn's own checks, and the one promise of ours: an estimator answers as its tree."""

import warnings

import numpy as np
import pytest
from sklearn.base import clone, is_classifier
from sklearn.utils.estimator_checks import check_estimator

import otr
from otr import learners

# Grown node by node; the learners with a network or a linear model behind them are in test_estimators.py.
ESTIMATORS = [
    cls
    for cls in (getattr(learners, name) for name in learners.__all__)
    if isinstance(cls, type) and cls.__module__.rsplit(".", 1)[1] not in ("otr", "lcn", "linear")
]
CLASSIFIERS = [cls for cls in ESTIMATORS if cls.__name__.endswith("Classifier")]
REGRESSORS = [cls for cls in ESTIMATORS if cls.__name__.endswith("Regressor")]


def problem(estimator, n=200, d=5, n_classes=3, seed=0):
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n, d))
    score = X @ rng.normal(size=d) + X[:, 0] * X[:, 1]
    if is_classifier(estimator):
        y = np.digitize(score, np.quantile(score, np.linspace(0, 1, n_classes + 1)[1:-1]))
        return X, np.array(["ant", "bee", "cow", "dog"])[y]
    return X, score


RARE = "a tree without a limit on its leaves' weight fits rows of weight 0.0001 as it does those of weight 1000"
BATCHES = "its network learns from shuffled batches of rows, which are others where rows are repeated"
EXPECTED_TO_FAIL = {
    "CARTClassifier": {"check_class_weight_classifiers": RARE},
    "HHCARTClassifier": {"check_class_weight_classifiers": RARE},
    "AugTreeClassifier": {
        "check_class_weight_classifiers": RARE,
        "check_sample_weight_equivalence_on_dense_data": BATCHES,
    },
    "AugTreeRegressor": {"check_sample_weight_equivalence_on_dense_data": BATCHES},
    "LinearTreeRegressor": {
        "check_sample_weight_equivalence_on_dense_data": "at least 10 rows a leaf, whatever their weights"
    },
    "TAOClassifier": {
        "check_class_weight_classifiers": "the 0/1 loss fits rows of weight 0.0001 where that costs none of weight 1000"
    },
}


@pytest.mark.parametrize("cls", ESTIMATORS)
def test_check_estimator(cls):
    quick = {"mlp_max_iter": 20} if cls.__name__.startswith("AugTree") else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # checks that scikit-learn skips
        check_estimator(cls(**quick), expected_failed_checks=EXPECTED_TO_FAIL.get(cls.__name__))


@pytest.mark.parametrize("cls", CLASSIFIERS)
@pytest.mark.parametrize("n_classes", [2, 3])
def test_a_classifier_equals_its_tree(cls, n_classes):
    model = cls(random_state=0)
    X, y = problem(model, n_classes=n_classes)
    model.fit(X, y)
    fresh = np.random.default_rng(1).normal(size=(500, 5)) * 2
    assert isinstance(model.tree_, otr.ObliqueTree)
    assert np.array_equal(model.classes_[model.tree_.predict(fresh)], model.predict(fresh))
    shares = model.predict_proba(fresh)
    assert np.array_equal(model.tree_.forward(fresh), shares)
    assert np.array_equal(model.classes_[shares.argmax(axis=1)], model.predict(fresh))
    assert np.array_equal(model.tree_.c[model.apply(fresh)], shares)


@pytest.mark.parametrize("cls", [*CLASSIFIERS, learners.OTRClassifier, learners.LinearTreeClassifier])
@pytest.mark.parametrize(("label", "kinds"), [(None, "NoneType, str"), (2.5, "float, str")])
def test_labels_of_several_kinds_are_named(cls, label, kinds):
    with pytest.raises(TypeError, match=f"y has labels of several kinds: {kinds}; give all as one kind"):
        cls().fit(np.arange(6.0)[:, None], np.array(["a", "b", label] * 2, dtype=object))


@pytest.mark.parametrize("cls", CLASSIFIERS)
def test_leaf_shares_are_those_of_the_training_rows(cls):
    model = cls(random_state=0)
    X, y = problem(model)
    leaves = model.fit(X, y).apply(X)
    assert set(leaves) == set(range(model.tree_.n_leaves))
    for leaf in range(model.tree_.n_leaves):
        shares = (y[leaves == leaf][:, None] == model.classes_).mean(axis=0)
        assert model.tree_.c[leaf] == pytest.approx(shares, abs=1e-12)


@pytest.mark.parametrize("cls", REGRESSORS)
def test_a_regressor_equals_its_tree(cls):
    model = cls(random_state=0)
    X, y = problem(model)
    fresh = np.random.default_rng(1).normal(size=(500, 5)) * 2
    flat = model.fit(X, y).predict(fresh)
    assert flat.shape == (500,)
    assert np.array_equal(model.tree_.predict(fresh)[:, 0], flat)
    several = clone(model).fit(X, np.column_stack((y, -2 * y)))
    values = several.predict(fresh)
    assert np.array_equal(several.tree_.predict(fresh), values)
    assert values[:, 0] == pytest.approx(-values[:, 1] / 2, abs=1e-8)


@pytest.mark.parametrize("cls", ESTIMATORS)
def test_same_seed_same_tree(cls):
    X, y = problem(cls())
    trees = [cls(random_state=3).fit(X, y).tree_ for _ in range(2)]
    for name in ("children_left", "children_right", "P", "v", "M", "c"):
        assert np.array_equal(getattr(trees[0], name), getattr(trees[1], name))


@pytest.mark.parametrize("cls", ESTIMATORS)
@pytest.mark.parametrize("case", ["constant columns", "duplicate rows", "one row", "contradictions"])
def test_degenerate_input(cls, case):
    X, y = problem(cls())
    if case == "constant columns":
        X = np.column_stack((np.full(len(X), 7.0), X[:, :1], np.zeros(len(X))))
    elif case == "duplicate rows":
        X, y = np.tile(X[:10], (20, 1)), np.tile(y[:10], 20)
    elif case == "one row":
        X, y = X[:1], y[:1]
    else:
        X = np.ones_like(X)
    model = cls(random_state=0).fit(X, y)
    assert len(model.predict(X)) == len(X)
    if case == "constant columns" and not cls.__name__.startswith(("AugTree", "TAO")):  # theirs may act as offsets
        assert not model.tree_.P[:, [0, 2]].any()
    if case == "duplicate rows" and is_classifier(model):
        assert model.score(X, y) == 1.0
    if case in ("one row", "contradictions"):
        assert model.tree_.n_leaves == 1


@pytest.mark.parametrize("cls", ESTIMATORS)
def test_one_constant_target_makes_one_leaf(cls):
    X, _ = problem(cls())
    assert cls(random_state=0).fit(X, np.ones(len(X), dtype=int)).tree_.n_leaves == 1


@pytest.mark.parametrize("cls", ESTIMATORS)
@pytest.mark.parametrize("depth", [0, 1, 3])
def test_depth_is_limited(cls, depth):
    if depth == 0 and cls.__name__.startswith(("CART", "AugTree", "TAO")):
        pytest.skip("scikit-learn's trees have depth 1 at least")
    X, y = problem(cls())
    assert cls(max_depth=depth, random_state=0).fit(X, y).tree_.depth <= depth
