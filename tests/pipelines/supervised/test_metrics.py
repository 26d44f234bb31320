import numpy as np
import pytest
from sklearn.metrics import mean_poisson_deviance, roc_auc_score

import otr
from otr.learners import CARTClassifier, OTRClassifier, OTRRegressor
from pipelines.datasets.load import load_dataset
from pipelines.errors import ConfigError
from pipelines.supervised.config import OtrConfig
from pipelines.supervised.learners import check_learner
from pipelines.supervised.metrics import gain, metric_of, outputs_of, score


@pytest.mark.parametrize("name, metric", [("breast_cancer", "auc"), ("digits", "accuracy"), ("diabetes", "rmse")])
def test_metric_follows_from_the_labels(name, metric):
    assert metric_of(load_dataset(name)) == metric


def test_scores_are_those_of_scikit_learn():
    X, y = load_dataset("breast_cancer").labelled("train")
    model = CARTClassifier(max_depth=3, random_state=0).fit(X, y)
    outputs = outputs_of(model.tree_, X)
    assert score("auc", outputs, y) == pytest.approx(roc_auc_score(y, model.predict_proba(X)[:, 1]))
    assert np.isnan(score("auc", outputs[y == 1], y[y == 1]))
    digits, labels = load_dataset("digits").labelled("train")
    model = CARTClassifier(max_depth=4, random_state=0).fit(digits, labels)
    assert score("accuracy", outputs_of(model.tree_, digits), labels) == pytest.approx(model.score(digits, labels))
    assert score("rmse", np.array([1.0, 4.0]), np.array([1.0, 1.0])) == pytest.approx(np.sqrt(4.5))


def test_the_accuracy_is_that_of_what_a_pruned_tree_answers():
    data = load_dataset("digits")
    (X, y), (X_test, y_test) = data.labelled("train"), data.labelled("test")
    whole = OTRClassifier((6,), random_state=0).fit(X, y).tree_
    tree = otr.prune_unreached(whole, X)
    own = float(np.mean(tree.predict(X_test) == y_test))
    assert score("accuracy", outputs_of(tree, X_test), y_test) == own
    assert own != np.mean(tree.forward(X_test).argmax(axis=1) == y_test)  # tests between classes are pruned, too


def test_counts_are_scored_by_their_deviance():
    rng = np.random.default_rng(0)
    X = rng.normal(size=(200, 2))
    y = rng.poisson(np.exp(X[:, 0])).astype(float)
    model = OTRRegressor((2,), loss="poisson", random_state=0).fit(X, y)
    outputs = outputs_of(model.tree_, X)
    np.testing.assert_allclose(outputs, model.predict(X))
    assert score("deviance", outputs, y) == pytest.approx(mean_poisson_deviance(y, np.maximum(outputs, 1e-3)))
    assert np.isfinite(score("deviance", np.zeros(200), y)) and gain("deviance", 2.0) == -2.0
    with pytest.raises(ConfigError, match="loss=poisson is for counts, and diabetes is a regression"):
        check_learner(OtrConfig("otr", "otr", loss="poisson"), load_dataset("diabetes"))
