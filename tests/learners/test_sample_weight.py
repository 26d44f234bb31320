"""A row of weight 2 counts as two rows, and one of weight 0 as none."""

import numpy as np
import pytest
from sklearn.base import clone

from otr.learners import (
    AugTreeClassifier,
    AugTreeRegressor,
    CARTClassifier,
    CARTRegressor,
    HHCARTClassifier,
    HHCARTRegressor,
    LCNClassifier,
    LCNRegressor,
    LinearTreeClassifier,
    LinearTreeRegressor,
    OTRClassifier,
    OTRRegressor,
    TAOClassifier,
)
from otr.learners.distillation import Teacher
from otr.learners.growing.eigenvector import dominant_direction
from otr.learners.growing.splits import best_bit_split, best_split

RNG = np.random.default_rng(0)
X = RNG.normal(size=(30, 3)) * [1, 5, 0.1] + 2
SCORE = X[:, 0] - X[:, 1] / 5 + 5 * X[:, 2] * X[:, 0] + 9 * RNG.normal(size=30)
WEIGHTS = RNG.integers(0, 4, size=30)
AUGTREE = {"hidden_layer_sizes": (3,), "mlp_max_iter": 20, "random_state": 0}
NETWORK = {"epochs": 40, "batch_size": 128, "random_state": 0}  # all rows are one mini-batch, repeated or not


@pytest.mark.parametrize(
    ("model", "tolerance"),
    [
        (CARTClassifier(max_depth=1, random_state=0), 1e-12),
        (CARTRegressor(max_depth=1, random_state=0), 1e-12),
        (HHCARTClassifier(max_depth=2, random_state=0), 1e-12),
        (HHCARTRegressor(max_depth=2, random_state=0), 1e-12),
        (TAOClassifier(max_depth=2, random_state=0), 1e-12),  # shares of the same rows, by tests of liblinear
        (TAOClassifier(max_depth=2, penalty="l1", surrogate="logistic", random_state=0), 1e-12),
        (AugTreeClassifier(max_depth=2, **AUGTREE), 1e-12),
        (AugTreeRegressor(max_depth=1, **AUGTREE), 1e-9),
        (AugTreeRegressor(max_depth=1, leaves="linear", min_samples_leaf=1, **AUGTREE), 1e-6),
        (LinearTreeRegressor(max_depth=2, min_samples_leaf=1), 1e-9),
        (LinearTreeRegressor(max_depth=0), 1e-9),
        (LinearTreeClassifier(max_depth=0), 2e-3),  # by lbfgs
        (LinearTreeClassifier(max_depth=1, min_samples_leaf=1), 2e-3),
        (OTRClassifier((4,), **NETWORK), 1e-4),  # in float32
        (OTRRegressor((4,), **NETWORK), 1e-4),
        (LCNClassifier(3, **NETWORK), 1e-4),
        (LCNRegressor(3, **NETWORK), 1e-4),
    ],
)
@pytest.mark.parametrize("n_classes", [2, 3])
def test_weights_are_rows_repeated(model, tolerance, n_classes):
    y = SCORE
    if type(model).__name__.endswith("Classifier"):
        y = np.digitize(SCORE, np.quantile(SCORE, np.linspace(0, 1, n_classes + 1)[1:-1]))
    weighted = model.fit(X, y, WEIGHTS).tree_.forward(X)
    repeated = model.fit(np.repeat(X, WEIGHTS, axis=0), np.repeat(y, WEIGHTS)).tree_.forward(X)
    alike = model.fit(X, y).tree_.forward(X)
    size = np.abs(repeated).max()
    np.testing.assert_allclose(weighted, repeated, rtol=0, atol=tolerance * size)
    assert np.abs(alike - repeated).max() > 10 * tolerance * size  # the weights matter


@pytest.mark.parametrize("cls", [CARTClassifier, HHCARTClassifier, TAOClassifier, LinearTreeClassifier, OTRClassifier])
def test_rows_of_weight_0_are_left_out(cls):
    y, weights = np.digitize(SCORE, [0, 5]), (SCORE < 5).astype(float)
    known = {"random_state": 0, "epochs": 3, "batch_size": 4}
    model = cls().set_params(**{key: known[key] for key in known if key in cls().get_params()}).fit(X, y, weights)
    left_out = clone(model).fit(X[SCORE < 5], y[SCORE < 5])
    np.testing.assert_allclose(model.tree_.P, left_out.tree_.P, atol=1e-6)
    np.testing.assert_allclose(model.tree_.v, left_out.tree_.v, atol=1e-6)
    np.testing.assert_array_equal(model.predict(X), left_out.predict(X))
    assert model.classes_.tolist() == [0, 1]  # a class whose rows are all left out is none


@pytest.mark.parametrize(("search", "n_values"), [(best_split, 2), (best_bit_split, 2), (best_split, 1000)])
def test_the_best_split_of_weighted_rows_is_that_of_repeated_ones(search, n_values):
    rng = np.random.default_rng(0)
    rows, Y, weights = rng.integers(0, n_values, (20, 4)) / 1.0, rng.normal(size=(20, 2)), rng.integers(1, 4, 20)
    again, Y_again = np.repeat(rows, weights, axis=0), np.repeat(Y, weights, axis=0)
    weighted = search(rows, Y, weights=weights * 1.0, random_state=np.random.RandomState(0))
    repeated = search(again, Y_again, random_state=np.random.RandomState(0))
    assert weighted.gain == pytest.approx(repeated.gain, rel=1e-9)
    assert (weighted.column, weighted.threshold) == (repeated.column, repeated.threshold)


@pytest.mark.parametrize("d", [3, 200])  # by a Gram matrix, and by Lanczos
def test_the_covariance_of_weighted_rows_is_that_of_repeated_ones(d):
    rng = np.random.default_rng(0)
    rows, weights = rng.normal(size=(200, d)) * np.geomspace(1, 5, d) + 3, rng.integers(1, 4, 200)
    weighted = dominant_direction(rows, np.random.RandomState(0), weights * 1.0)
    repeated = dominant_direction(np.repeat(rows, weights, axis=0), np.random.RandomState(0))
    alike = dominant_direction(rows, np.random.RandomState(0))
    assert weighted[0] == pytest.approx(repeated[0], rel=1e-6)
    assert weighted[0] != pytest.approx(alike[0], rel=1e-3)
    np.testing.assert_allclose(weighted[1], repeated[1], atol=1e-3)


def test_taos_weighted_error_never_rises():
    y, weights = np.digitize(SCORE, [0, 5]), np.random.default_rng(1).exponential(size=30)
    model = TAOClassifier(max_depth=3, init="random", tol=-1.0, max_iter=5, random_state=0).fit(X, y, weights)
    assert (np.diff(model.loss_path_) <= 1e-12).all()
    assert model.loss_path_[-1] == pytest.approx(weights[model.predict(X) != y].sum() / weights.sum())


def test_thresholds_of_model_trees_lie_at_quantiles_of_weighted_rows():
    rng = np.random.default_rng(0)
    rows, weights = rng.normal(size=(300, 2)), rng.integers(0, 4, 300)
    y = np.where(rows[:, 0] > 1.2, 5 * rows[:, 1], rows[:, 1]) + 0.1 * rng.normal(size=300)
    model = LinearTreeRegressor(max_depth=3, min_samples_leaf=1, max_bins=6)
    weighted = model.fit(rows, y, weights).predict(rows)
    repeated = model.fit(np.repeat(rows, weights, axis=0), np.repeat(y, weights)).predict(rows)
    np.testing.assert_allclose(weighted, repeated, atol=1e-9)


def test_weights_of_labels_some_of_which_are_missing():
    Y = np.column_stack((SCORE > 4, X[:, 1] > 2)).astype(float)
    Y[::4, 1] = np.nan
    model = OTRClassifier((4,), **NETWORK)
    weighted = model.fit(X, Y, WEIGHTS).decision_function(X)
    repeated = model.fit(np.repeat(X, WEIGHTS, axis=0), np.repeat(Y, WEIGHTS, axis=0)).decision_function(X)
    np.testing.assert_allclose(weighted, repeated, atol=1e-4 * np.abs(repeated).max())
    (seeded,) = model.fit_seeds(X, Y, [0], sample_weight=WEIGHTS)
    np.testing.assert_allclose(seeded.decision_function(X), weighted, atol=1e-6)


@pytest.mark.parametrize(
    ("weights", "message"),
    [(-np.ones(30), "[Nn]egative"), (np.zeros(30), "at least one non-zero"), (np.ones(3), "shape")],
)
def test_what_is_no_weight(weights, message):
    for model in (OTRClassifier(epochs=1), TAOClassifier(), HHCARTClassifier()):
        with pytest.raises(ValueError, match=message):
            model.fit(X, SCORE > 0, weights)


def test_a_teacher_has_rows_of_its_own():
    with pytest.raises(ValueError, match="leave out the teacher, or sample_weight and class_weight"):
        OTRClassifier(teacher=Teacher()).fit(X, SCORE > 0, WEIGHTS)
    with pytest.raises(ValueError, match="leave out the teacher, or sample_weight and class_weight"):
        OTRClassifier(teacher=Teacher(), class_weight="balanced").fit(X, SCORE > 0)
