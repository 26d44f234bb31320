import numpy as np
import pytest
import torch
from sklearn.metrics import log_loss, roc_auc_score

from otr.learners.networks.validation_scores import areas_under_curve, negative_losses


def test_areas_equal_scikit_learns_with_ties_and_missing_labels():
    rng = np.random.default_rng(0)
    scores = rng.integers(0, 6, size=(4, 3, 50)).astype(float)  # seeds, labels, rows
    labels = rng.integers(0, 2, size=(3, 50)).astype(float)
    labels[rng.random(labels.shape) < 0.3] = np.nan
    areas = areas_under_curve(scores, labels)
    for seed in range(4):
        for label in range(3):
            there = ~np.isnan(labels[label])
            expected = roc_auc_score(labels[label, there], scores[seed, label, there])
            assert areas[seed, label] == pytest.approx(expected, abs=1e-12)


def test_one_class_has_no_area():
    assert np.isnan(areas_under_curve(np.arange(3.0), np.array([1.0, 1.0, np.nan])))


def test_losses_are_the_means_over_labels_that_are_there():
    outputs = np.random.default_rng(0).normal(size=(2, 6, 3))
    labels = np.array([0.0, 2.0, 1.0, np.nan, 1.0, 0.0])
    there = ~np.isnan(labels)
    probabilities = torch.softmax(torch.tensor(outputs), -1).numpy()
    for model in range(2):
        expected = -log_loss(labels[there], probabilities[model, there])
        assert negative_losses("softmax", outputs, labels)[model] == pytest.approx(expected, abs=1e-12)
    binary = np.array([0.0, 1.0, 1.0, np.nan, 1.0, 0.0])
    ones = 1 / (1 + np.exp(-outputs[0, there, 0]))
    assert negative_losses("logistic", outputs[0, :, :1], binary) == pytest.approx(-log_loss(binary[there], ones))
    assert negative_losses("squared", np.array([[1.0], [5.0]]), np.array([3.0, np.nan])) == -4.0
    assert np.isnan(negative_losses("squared", np.array([[1.0]]), np.array([np.nan])))
