"""Networks read from scikit-learn's estimators and skops files: against their predictions, and what is refused."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skops.io
from sklearn.base import BaseEstimator
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression, PoissonRegressor, Ridge, RidgeClassifier, SGDClassifier
from sklearn.model_selection import GridSearchCV
from sklearn.neural_network import MLPClassifier, MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MaxAbsScaler, MinMaxScaler, PolynomialFeatures, RobustScaler, StandardScaler
from sklearn.svm import SVC, LinearSVC
from sklearn.tree import DecisionTreeClassifier

import otr
from otr.core.smooth_network import SmoothNetwork
from otr.importers import read_policy

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
RNG = np.random.default_rng(0)
X = RNG.normal(size=(60, 4)) * [1, 10, 0.1, 2] + [5, 0, 1, 2]
TWO, THREE = (X[:, 0] > 5).astype(int), np.digitize(X[:, 1], [-3, 4])
TARGETS = np.stack((X.sum(axis=1), X[:, 0] * X[:, 1]), axis=1)


def mlp(kind: type = MLPClassifier, **options: Any) -> Any:
    options = {"learning_rate_init": 0.03, "max_iter": 30, **options}
    return kind(hidden_layer_sizes=(4, 3), random_state=1, **options)


READ = {
    "mlp": (mlp(), THREE),
    "mlp without units": (mlp(activation="identity"), THREE),
    "mlp of two classes behind a scaler": (make_pipeline(StandardScaler(), mlp()), TWO),
    "stochastic gradient": (mlp(MLPRegressor, solver="sgd", learning_rate_init=1e-4), TARGETS),
    "several scalers": (
        make_pipeline(StandardScaler(with_mean=False), MaxAbsScaler(), RobustScaler(), mlp(max_iter=300)),
        THREE,
    ),
    "range": (make_pipeline(None, MinMaxScaler((-1, 3)), "passthrough", mlp(MLPRegressor)), TARGETS[:, 0]),
    "mean alone": (make_pipeline(StandardScaler(with_std=False), LogisticRegression()), TWO),
    "logistic regression": (LogisticRegression(), THREE),
    "ridge": (Ridge(), TARGETS),
    "linear svm": (LinearSVC(), TWO),
    "sgd": (SGDClassifier(random_state=0), THREE),
    "discriminants": (LinearDiscriminantAnalysis(), THREE),
}


@pytest.mark.parametrize("name", READ)
def test_answers_are_the_estimators(tmp_path: Path, name: str) -> None:
    estimator, targets = READ[name]
    estimator.fit(X, targets)
    skops.io.dump(estimator, tmp_path / "policy.skops")
    expected = estimator.predict(X)
    widths = (4, 3) if "mlp" in repr(estimator).lower() and name != "mlp without units" else ()
    assert len(np.unique(expected, axis=0)) > 1
    for network in (
        otr.from_sklearn(estimator),
        otr.from_sklearn(tmp_path / "policy.skops"),
        read_policy(tmp_path / "policy.skops"),
    ):
        assert network.n_inputs == 4 and network.hidden_widths == widths
        answers = network.predict(X)
        np.testing.assert_allclose(answers, expected.reshape(answers.shape), atol=1e-9)


@pytest.mark.parametrize("targets", [TWO, THREE])
def test_labels_are_positions_among_the_classes(targets: np.ndarray) -> None:
    fitted = mlp().fit(X, np.array(["no", "yes", "maybe"])[targets])
    found = otr.map_network(otr.from_sklearn(fitted)).predict(X)
    np.testing.assert_array_equal(fitted.classes_[found], fitted.predict(X))


@pytest.mark.parametrize(("activation", "units"), [("tanh", "tanh"), ("logistic", "sigmoid")])
def test_smooth_units_are_an_oracle(tmp_path: Path, activation: str, units: str) -> None:
    estimator = make_pipeline(StandardScaler(), mlp(MLPRegressor, activation=activation)).fit(X, TARGETS)
    skops.io.dump(estimator, tmp_path / "policy.skops")
    oracle = read_policy(tmp_path / "policy.skops")
    assert isinstance(oracle, SmoothNetwork) and oracle.activation == units
    np.testing.assert_allclose(oracle.predict(X), estimator.predict(X), atol=1e-9)
    with pytest.raises(otr.InvalidNetworkError, match=f"the units are {units}; a tree needs ReLU"):
        otr.from_sklearn(tmp_path / "policy.skops")


class Reversed(LogisticRegression):
    def predict(self, X: Any) -> Any:
        return super().predict(X)[::-1]


@pytest.mark.parametrize(
    ("estimator", "targets", "message"),
    [
        (PoissonRegressor(), TWO, "predicts differently from its coefficients: .* a link function"),
        (SVC(kernel="linear"), THREE, "one classifier for each pair of classes, cannot be mapped"),
        (Reversed(), TWO, "predicts differently from its coefficients"),
        (make_pipeline(MinMaxScaler(clip=True), Ridge()), TARGETS, "clips the states, which no layer does"),
        (make_pipeline(PolynomialFeatures(), Ridge()), TARGETS, r"has the step PolynomialFeatures\(\); StandardScaler"),
        (make_pipeline(StandardScaler()), None, r"expected a fitted .* got StandardScaler\(\); one of another kind"),
        (GridSearchCV(Ridge(), {"alpha": [1.0, 2.0]}), TARGETS, r"got GridSearchCV\(.*; one of another kind cannot"),
        (RidgeClassifier(), np.column_stack((TWO, TWO)) == TWO[0], "predicts several labels at once"),
        (mlp(), X > 0, "one classifier for each label"),
        (mlp(MLPRegressor, loss="poisson"), np.abs(TARGETS[:, 0]), "squared_error"),
        (DecisionTreeClassifier(), TWO, r"DecisionTreeClassifier\(\); .*otr.learners.from_sklearn_tree"),
    ],
)
def test_what_is_refused(estimator: Any, targets: np.ndarray | None, message: str) -> None:
    with pytest.raises(otr.InvalidNetworkError, match=message):
        otr.from_sklearn(estimator.fit(X, targets))


@pytest.mark.parametrize("given", [Ridge(), make_pipeline(StandardScaler(), mlp())])
def test_what_is_not_fitted(given: Any) -> None:
    with pytest.raises(otr.InvalidNetworkError, match="call fit first"):
        otr.from_sklearn(given)
    with pytest.raises(otr.InvalidNetworkError, match="got None; it is no estimator"):
        otr.from_sklearn(None)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_one_class_is_always_predicted() -> None:
    estimator = mlp().fit(X, np.full(len(X), 3))
    network = otr.from_sklearn(estimator)
    states = 100 * np.random.default_rng(1).normal(size=(200, X.shape[1]))
    assert not network.predict(states).any() and (network.forward(states) == -1.0).all()
    np.testing.assert_array_equal(network.weights[0], estimator.coefs_[0].T)


class Foreign(BaseEstimator):
    """A type that skops does not know."""

    ran = False

    def __setstate__(self, state: Any) -> None:
        type(self).ran = True


def test_types_that_skops_does_not_trust_are_named(tmp_path: Path) -> None:
    path = tmp_path / "policy.skops"
    for estimator, message in (
        (make_pipeline(Foreign(), LogisticRegression()), r"test_sklearn_estimator.Foreign, which skops does not trust"),
        (DecisionTreeClassifier(max_depth=1).fit(X, TWO), r"from_sklearn_tree\(tree\)"),
        (RandomForestClassifier(2, max_depth=1).fit(X, TWO), "holds sklearn.tree._tree.Tree|got RandomForest"),
    ):
        skops.io.dump(estimator, path)
        with pytest.raises(otr.InvalidNetworkError, match=message):
            otr.from_sklearn(path)
    assert not Foreign.ran


def test_classes_that_are_no_actions(tmp_path: Path) -> None:
    path = tmp_path / "policy.skops"
    skops.io.dump(LogisticRegression().fit(X, np.where(TWO, "right", "left")), path)
    with pytest.raises(otr.InvalidNetworkError, match=r"are \['left', 'right'\], expected the actions' numbers 0, 1"):
        read_policy(path)
    assert otr.from_sklearn(path).head == otr.Sign()


def test_what_is_no_skops_file(tmp_path: Path) -> None:
    with pytest.raises(otr.ArtefactError, match=r"does not exist; give the path of a file that skops.io.dump wrote"):
        otr.from_sklearn(tmp_path / "nosuch.skops")
    path = tmp_path / "policy.skops"
    skops.io.dump(Ridge().fit(X, TARGETS), path)
    content = path.read_bytes()
    for length in (0, 100, len(content) // 2, len(content) - 30):
        path.write_bytes(content[:length])
        with pytest.raises(otr.ArtefactError):
            otr.from_sklearn(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("schema.json", "{}")
    with pytest.raises(otr.ArtefactError, match="no skops file that can be read"):
        otr.from_sklearn(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("schema.json", bytes(2**26 + 1))
    with pytest.raises(otr.ArtefactError, match="nothing was unpacked"):
        otr.from_sklearn(path)
