"""Weights of classes: scikit-learn's, for every classifier and every label."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.base import clone, is_classifier
from sklearn.utils.class_weight import compute_class_weight, compute_sample_weight

from otr import learners
from otr.learners import LinearTreeClassifier, OTRClassifier, TAOClassifier
from otr.learners.base.weights import class_weighted

CLASSIFIERS = [cls for cls in (getattr(learners, name) for name in learners.__all__) if isinstance(cls, type)]
CLASSIFIERS, REGRESSORS = ([cls for cls in CLASSIFIERS if is_classifier(cls()) == wanted] for wanted in (True, False))
RNG = np.random.default_rng(0)
X = RNG.normal(size=(60, 3))
Y = np.array(["common", "rare", "some"])[np.digitize(X[:, 0] + X[:, 1] * X[:, 2] + RNG.normal(size=60), [0.7, 1.2])]
BY_NAME = {"common": 0.5, "rare": 3.0}


def small(cls, **parameters):
    """The classifier, quick to fit; inputs as they are, since class weights have no part in standardising."""
    quick = {"epochs": 5, "mlp_max_iter": 5, "max_depth": 3, "standardize": False, "random_state": 0}
    return cls().set_params(**{k: v for k, v in quick.items() if k in cls().get_params()} | parameters)


@pytest.mark.parametrize("cls", CLASSIFIERS)
@pytest.mark.parametrize("class_weight", ["balanced", BY_NAME])
def test_class_weights_are_the_weights_of_their_rows(cls, class_weight):
    model = small(cls, class_weight=class_weight).fit(X, Y)
    by_rows = small(cls).fit(X, Y, compute_sample_weight(class_weight, Y))
    np.testing.assert_array_equal(model.predict_proba(X), by_rows.predict_proba(X))
    assert np.abs(model.predict_proba(X) - small(cls).fit(X, Y).predict_proba(X)).max() > 1e-3
    assert clone(model).class_weight == class_weight


def test_only_classifiers_have_them():
    assert len(REGRESSORS) == 6
    assert not any("class_weight" in cls().get_params() for cls in REGRESSORS)


@given(seed=st.integers(0, 2**32 - 1), n_classes=st.integers(1, 4))
def test_balanced_is_scikit_learns(seed, n_classes):
    rng = np.random.default_rng(seed)
    y = np.concatenate((np.arange(n_classes), rng.integers(0, n_classes, 10)))
    weights = rng.integers(1, 4, len(y))
    classes = np.unique(y)
    plain, weighted = (class_weighted(w, "balanced", y) for w in (None, weights * 1.0))
    np.testing.assert_allclose(plain, compute_class_weight("balanced", classes=classes, y=y)[y])
    expected = compute_class_weight("balanced", classes=classes, y=y, sample_weight=weights)[y] * weights
    np.testing.assert_allclose(weighted, expected)
    repeated = class_weighted(None, "balanced", np.repeat(y, weights))
    np.testing.assert_allclose(np.bincount(y, weighted), np.bincount(np.repeat(y, weights), repeated))
    np.testing.assert_allclose(np.bincount(y, weighted), weights.sum() / n_classes)  # the same for all


def test_classes_are_named_as_they_are():
    for names in (["1", "2"], [1, 2], [0.5, 1.5], [True, False]):
        y = np.array([names[0], names[1], names[1]])
        assert class_weighted(None, {names[0]: 5}, y).tolist() == [5.0, 1.0, 1.0]
    assert class_weighted(None, {"a": 5, "b": 2, "not here": 1}, np.array(["a", "b"])).tolist() == [5.0, 2.0]


@pytest.mark.parametrize("cls", [LinearTreeClassifier, OTRClassifier])
@pytest.mark.parametrize("class_weight", ["balanced", {1: 5.0}])
def test_every_label_has_its_own_balance(cls, class_weight):
    labels = np.column_stack((Y == "rare", Y == "some")).astype(float)
    labels[::4, 1] = np.nan
    depth = {"max_depth": 0} if cls is LinearTreeClassifier else {}
    model = small(cls, class_weight=class_weight, **depth).fit(X, labels)
    for label in range(2):
        present = ~np.isnan(labels[:, label])
        weights = np.zeros(60)
        weights[present] = compute_sample_weight(class_weight, labels[present, label])
        alone = small(cls, **depth).fit(X[present], labels[present, label], weights[present])
        if cls is LinearTreeClassifier:  # networks share mini-batches with the rows that lack a label
            np.testing.assert_allclose(model.decision_function(X)[:, label], alone.decision_function(X), atol=1e-6)
    plain = small(cls, **depth).fit(X, labels)
    assert (model.predict_proba(X) > plain.predict_proba(X)).mean() > 0.9  # both labels are rare


@pytest.mark.parametrize(
    ("class_weight", "message"),
    [
        (
            {"comon": 2.0},
            r"class_weight names 'comon', which is no class; the classes are \['common', 'rare', 'some'\]",
        ),
        ({"rare": 0}, r"class_weight of 'rare' is 0.0; give a number above 0, or leave out the class's rows"),
        ({"rare": np.nan}, r"class_weight of 'rare' is nan; give a number above 0"),
        ("balance", r"The 'class_weight' parameter of .* must be an instance of 'dict'.*{'balanced'}.* Got 'balance'"),
    ],
)
def test_what_is_no_class_weight(class_weight, message):
    for cls in (OTRClassifier, LinearTreeClassifier, TAOClassifier):
        with pytest.raises(ValueError, match=message):
            small(cls, class_weight=class_weight).fit(X, Y)
