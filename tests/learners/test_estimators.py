"""The estimators: scikit-learn's contract, trees equal to networks, standardising, several labels."""

import subprocess
import sys

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.datasets import load_breast_cancer, load_diabetes
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LogisticRegression, Ridge
from sklearn.metrics import roc_auc_score
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import parametrize_with_checks

import otr
from otr.learners import (
    LCNClassifier,
    LCNRegressor,
    LinearTreeClassifier,
    LinearTreeRegressor,
    OTRClassifier,
    OTRRegressor,
)
from otr.learners.networks.batched_mlp import MlpSettings
from otr.learners.networks.batched_training import Schedule
from otr.learners.networks.labels_and_seeds import train_many

QUICK_LCN = {"depth": 3, "epochs": 20, "learning_rate": 0.2}
CLASSIFIERS = [OTRClassifier(epochs=30), LCNClassifier(**QUICK_LCN)]
CLASSIFIERS += [LinearTreeClassifier(max_depth=depth, min_samples_leaf=1) for depth in (0, 3)]
REGRESSORS = [OTRRegressor(epochs=30), LCNRegressor(**QUICK_LCN)]


def not_to_the_last_digit(estimator):
    """Networks train in float32; their weights are compared in tests/learners/test_sample_weight.py."""
    of_network = hasattr(estimator, "epochs")
    if getattr(estimator, "max_depth", 0):
        return {"check_class_weight_classifiers": "a leaf of rows of weight 0.0001 alone answers their class"}
    return {"check_sample_weight_equivalence_on_dense_data": "equal to 1e-6, not 1e-7"} if of_network else {}


@parametrize_with_checks([*CLASSIFIERS, *REGRESSORS], expected_failed_checks=not_to_the_last_digit)
def test_scikit_learns_contract(estimator, check):
    check(estimator)


def test_torch_is_loaded_only_by_those_who_need_it():
    code = (
        "import otr.learners, sys; assert 'torch' not in sys.modules and 'sklearn' not in sys.modules; "
        "from otr.learners import LinearTreeClassifier; assert 'torch' not in sys.modules; "
        "from otr.learners import OTRClassifier; assert 'torch' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("dense", [False, "input", "all"])
@pytest.mark.parametrize("standardize", [False, True])
def test_tree_equals_network(dense, standardize):
    X, y = load_breast_cancer(return_X_y=True)
    X = X if standardize else (X - X.mean(axis=0)) / X.std(axis=0)
    model = OTRClassifier((4, 3), dense=dense, standardize=standardize, negative_slope=0.05, random_state=0).fit(X, y)
    assert isinstance(model.tree_, otr.ObliqueTree)
    assert model.tree_.depth == 8
    difference = np.abs(model.tree_.forward(X) - model.network_.forward(X))
    assert difference.max() < 1e-9 * max(1.0, np.abs(model.network_.forward(X)).max())
    assert (model.predict(X) == y).mean() > 0.95
    np.testing.assert_array_equal(model.predict(X), model.network_.predict(X))


def test_large_trees_are_held_as_patterns_and_compute_the_same():
    X, y = load_breast_cancer(return_X_y=True)
    small = OTRClassifier((4, 3), random_state=0, max_leaves=256).fit(X, y)
    large = OTRClassifier((4, 3), random_state=0, max_leaves=255).fit(X, y)
    assert isinstance(large.tree_, otr.PatternTree)
    np.testing.assert_allclose(small.predict_proba(X), large.predict_proba(X), atol=1e-12)
    [pruned], [other] = small.prune(X), large.prune(X)
    assert pruned.n_leaves == other.n_leaves < 256
    np.testing.assert_allclose(pruned.forward(X), small.network_.forward(X), atol=1e-6)


@pytest.mark.parametrize("model", CLASSIFIERS)
def test_several_labels_with_missing_ones(model, fingerprints):
    X, Y = fingerprints
    model = clone(model).set_params(**({"random_state": 0} if "random_state" in model.get_params() else {}))
    if isinstance(model, LCNClassifier):  # it learns slowly from 300 rows
        model.set_params(depth=4, batch_size=16, decay_every=20)
    model.fit(X, Y)
    probabilities = model.predict_proba(X)
    assert probabilities.shape == model.predict(X).shape == (300, 3)
    np.testing.assert_array_equal(probabilities > 0.5, model.predict(X))
    for label in range(3):
        there = ~np.isnan(Y[:, label])
        assert roc_auc_score(Y[there, label], probabilities[there, label]) > 0.85
    assert len(model.trees_) == 3
    with pytest.raises(AttributeError, match="there are 3 trees, one for each label; see trees_"):
        _ = model.tree_
    with pytest.raises(ValueError, match="multi-label targets are 0, 1 and NaN"):
        model.fit(X, Y + 1)
    with pytest.raises(ValueError, match="label 2 of y is missing in all rows"):
        model.fit(X, np.column_stack([Y[:, :2], np.full(len(Y), np.nan)]))


def test_estimator_is_the_batched_trainer(fingerprints):
    X, Y = fingerprints
    model = OTRClassifier((6,), epochs=5, decay_every=10, input_dropout=0.3, random_state=4)
    model.fit(X, Y, validation=(X[:80], Y[:80]))
    settings = MlpSettings(hidden=(6,), input_dropout=0.3, schedule=Schedule(epochs=5))
    result = train_many(X, Y, [4], settings, X_valid=X[:80], Y_valid=Y[:80])
    for label in range(3):
        for mine, other in zip(model.networks_[label].weights, result.networks[label][0].weights, strict=True):
            np.testing.assert_array_equal(mine, other)
    np.testing.assert_array_equal(model.best_epochs_, result.epochs[:, 0])
    np.testing.assert_array_equal(model.validation_scores_, result.scores[:, 0])


@pytest.mark.parametrize("model", REGRESSORS)
def test_regression_in_the_targets_own_units(model):
    X, y = load_diabetes(return_X_y=True)
    model = clone(model).set_params(**({"random_state": 0} if "random_state" in model.get_params() else {}))
    fitted = model.fit(X[:300], y[:300])
    assert fitted.score(X[300:], y[300:]) > 0.3
    two = clone(model).fit(X[:300], np.column_stack((y, -2 * y + 5))[:300])
    answers = two.predict(X[300:])
    assert answers.shape == (142, 2)
    np.testing.assert_allclose(answers[:, 0], fitted.predict(X[300:]), atol=0.5)
    np.testing.assert_allclose(two.trees_[1].forward(X[300:])[:, 0], answers[:, 1])


def test_depth_0_is_scikit_learns_model(fingerprints):
    X, Y = fingerprints
    y = np.nan_to_num(Y[:, 0])
    tree = LinearTreeClassifier(C=0.1, max_depth=0).fit(X, y).tree_
    assert (tree.depth, tree.n_leaves) == (0, 1)
    expected = LogisticRegression(C=0.1, max_iter=1000).fit(X, y).decision_function(X)
    np.testing.assert_allclose(tree.forward(X)[:, 0], expected, atol=1e-12)
    X, y = load_diabetes(return_X_y=True)
    Z = StandardScaler().fit_transform(X)
    fitted = LinearTreeRegressor(alpha=2.0, max_depth=0).fit(X, y)
    np.testing.assert_allclose(fitted.predict(X), Ridge(alpha=2.0).fit(Z, y).predict(Z))


def test_a_linear_tree_has_a_classifier_in_every_leaf():
    """Of two slopes that a test divides; one leaf lacks a class, another has one alone."""
    rng = np.random.default_rng(0)
    X = rng.normal(size=(600, 3))
    y = np.where(X[:, 0] > 0.3, X[:, 1] > 0, X[:, 1] < 0).astype(int)
    model = LinearTreeClassifier(C=10.0, max_depth=1).fit(X, y)
    (column,) = np.flatnonzero(model.tree_.P[0])
    assert model.tree_.n_leaves == 2 and column == 0 and model.tree_.v[0] == pytest.approx(-0.3, abs=0.05)
    assert model.tree_.M[0, 0, 1] < -1 < 1 < model.tree_.M[1, 0, 1]
    assert model.score(X, y) > 0.97 > 0.7 > LinearTreeClassifier(max_depth=0).fit(X, y).score(X, y)
    y = np.select([X[:, 0] > 1, X[:, 0] > -1], [2, y], 3)
    three = LinearTreeClassifier(C=10.0, max_depth=2).fit(X, y)
    assert three.score(X, y) > 0.93 and three.predict_proba(X).shape == (600, 4)


def test_validation_is_checked(fingerprints):
    X, Y = fingerprints
    y = np.array(["no", "yes"])[np.nan_to_num(Y[:, 0]).astype(int)]
    with pytest.raises(ValueError, match="validation has the class 'perhaps', which y does not have"):
        OTRClassifier().fit(X, y, validation=(X[:1], ["perhaps"]))
    with pytest.raises(ValueError, match="validation has 2 rows of X and 1 of y"):
        OTRClassifier().fit(X, y, validation=(X[:2], y[:1]))
    for validation in ((X[:2], y[:2], [1.0, 0.0]), X[:2]):
        with pytest.raises(ValueError, match="validation is no pair"):
            OTRClassifier().fit(X, y, validation=validation)
    with pytest.raises(ValueError, match="seeds is empty"):
        OTRClassifier().fit_seeds(X, y, [])
    with pytest.raises(NotFittedError):
        OTRClassifier().prune(X)
    with pytest.raises(ValueError, match="a tree of 2\\*\\*13 leaves; the limit max_leaves is 4096"):
        LCNClassifier(13).fit(X, y)


def test_same_seed_same_trees(fingerprints):
    X, Y = fingerprints
    for model in (OTRClassifier(random_state=3, epochs=3), LCNClassifier(random_state=3, epochs=3)):
        one, two, other = (clone(model).set_params(random_state=seed).fit(X, Y) for seed in (3, 3, 4))
        np.testing.assert_array_equal(one.decision_function(X), two.decision_function(X))
        assert np.abs(one.decision_function(X) - other.decision_function(X)).max() > 0.01


def test_fit_seeds_leaves_the_estimator_as_it_is() -> None:
    X = np.random.default_rng(0).normal(size=(60, 3))
    words, others = np.where(X[:, 0] > 0, "a", "b"), np.where(X[:, 1] > 0, "c", "d")
    model = OTRClassifier((2,), epochs=2, random_state=0).fit(X, words)
    before = model.predict(X)
    (other,) = model.fit_seeds(X, others, [1])
    assert set(other.classes_) == {"c", "d"}
    np.testing.assert_array_equal(model.predict(X), before)
    new = OTRClassifier((2,), epochs=2)
    new.fit_seeds(X, words, [1])
    with pytest.raises(NotFittedError):
        new.predict(X)


def test_targets_of_validation_rows_have_as_many_columns() -> None:
    X = np.random.default_rng(0).normal(size=(60, 3))
    with pytest.raises(ValueError, match="y of validation has 1 columns, and y has 2"):
        OTRRegressor((2,), epochs=2).fit(X, X[:, :2], validation=(X, X[:, :1]))
    with pytest.raises(ValueError, match="y of validation has 3 columns, and y has 2"):
        OTRRegressor((2,), epochs=2).fit(X, X[:, :2], validation=(X, X))


@pytest.mark.parametrize("scale", [1e-13, 1e-11, 1e11])
def test_units_do_not_matter(scale: float) -> None:
    rng = np.random.default_rng(0)
    X = rng.normal(size=(100, 3))
    y = X[:, 0] * 2 + np.abs(X[:, 1])
    for model in (OTRRegressor(random_state=0, epochs=20), LCNRegressor(3, random_state=0, epochs=20)):
        assert model.fit(X, y * scale).score(X, y * scale) == pytest.approx(model.fit(X, y).score(X, y), abs=1e-6)
    for model in (OTRRegressor(random_state=0, epochs=20), LinearTreeRegressor()):
        assert model.fit(X * scale, y).score(X * scale, y) == pytest.approx(model.fit(X, y).score(X, y), abs=1e-6)


def test_a_constant_target_is_learnt_exactly() -> None:
    rng = np.random.default_rng(0)
    X = rng.normal(size=(100, 3))
    Y = np.column_stack((X[:, 0], np.full(100, 1e-6)))
    for model in (OTRRegressor(random_state=0, epochs=5), LCNRegressor(3, random_state=0, epochs=5)):
        np.testing.assert_allclose(model.fit(X, Y).predict(X)[:, 1], 1e-6, rtol=1e-12)


@pytest.mark.parametrize("hidden", [0, 4])
def test_lcn_of_one_neuron(hidden: int) -> None:
    rng = np.random.default_rng(0)
    X = rng.normal(size=(200, 3))
    y = np.sign(X[:, 0])
    model = LCNRegressor(1, hidden=hidden, epochs=20, random_state=0).fit(X, y)
    assert model.tree_.n_leaves == 2 and model.score(X, y) > 0.2
    assert LCNClassifier(1, epochs=200, random_state=0).fit(X, y).score(X, y) > 0.8
