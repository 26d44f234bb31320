import numpy as np
import pytest
from sklearn.metrics import roc_auc_score

import otr
from otr.learners import CARTClassifier, OTRClassifier
from pipelines.datasets.load import load_dataset
from pipelines.supervised.metrics import metric_of, outputs_of, score, size_of


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


def test_leaves_are_those_of_the_pruned_tree_whatever_holds_it():
    X, y = load_dataset("breast_cancer").labelled("train")
    explicit = OTRClassifier((4,), epochs=5, random_state=0).fit(X, y).tree_
    patterns = OTRClassifier((4,), epochs=5, random_state=0, max_leaves=2).fit(X, y).tree_
    assert isinstance(explicit, otr.ObliqueTree) and isinstance(patterns, otr.PatternTree)
    pruned = otr.prune_unreached(explicit, X)
    assert size_of(explicit, X) == size_of(patterns, X) == (5, pruned.n_leaves)
