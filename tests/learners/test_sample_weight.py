"""A row of weight 2 counts as two rows, and one of weight 0 as none."""

import numpy as np
import pytest

from otr.learners import (
    CARTClassifier,
    CARTRegressor,
    LCNClassifier,
    LCNRegressor,
    LinearTreeClassifier,
    LinearTreeRegressor,
    OTRClassifier,
    OTRRegressor,
)
from otr.learners.distillation import Teacher

RNG = np.random.default_rng(0)
X = RNG.normal(size=(30, 3)) * [1, 5, 0.1] + 2
SCORE = X[:, 0] - X[:, 1] / 5 + 5 * X[:, 2] * X[:, 0] + 9 * RNG.normal(size=30)
WEIGHTS = RNG.integers(0, 4, size=30)
NETWORK = {"epochs": 40, "batch_size": 128, "random_state": 0}  # all rows are one mini-batch, repeated or not


@pytest.mark.parametrize(
    ("model", "tolerance"),
    [
        (CARTClassifier(max_depth=1, random_state=0), 1e-12),
        (CARTRegressor(max_depth=1, random_state=0), 1e-12),
        (LinearTreeClassifier(), 2e-3),  # by lbfgs
        (LinearTreeRegressor(), 1e-9),
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
    # scikit-learn's trees put a threshold between neighbours, be the weight of one 0.
    weights = np.maximum(WEIGHTS, 1) if "CART" in type(model).__name__ else WEIGHTS
    weighted = model.fit(X, y, weights).tree_.forward(X)
    repeated = model.fit(np.repeat(X, weights, axis=0), np.repeat(y, weights)).tree_.forward(X)
    alike = model.fit(X, y).tree_.forward(X)
    size = np.abs(repeated).max()
    np.testing.assert_allclose(weighted, repeated, rtol=0, atol=tolerance * size)
    assert np.abs(alike - repeated).max() > 10 * tolerance * size  # the weights matter


def test_ones_change_nothing():
    for model in (OTRClassifier((4,), epochs=3, random_state=0), LinearTreeClassifier()):
        plain, ones = (model.fit(X, SCORE > 0, w).decision_function(X) for w in (None, np.ones(30)))
        np.testing.assert_allclose(ones, plain, atol=1e-6)


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
    with pytest.raises(ValueError, match=message):
        OTRClassifier(epochs=1).fit(X, SCORE > 0, weights)


def test_a_teacher_has_rows_of_its_own():
    with pytest.raises(ValueError, match="leave out teacher or sample_weight"):
        OTRClassifier(teacher=Teacher()).fit(X, SCORE > 0, WEIGHTS)
