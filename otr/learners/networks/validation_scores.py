"""Validation scores of many models on many labels at once, with missing labels left out."""

from __future__ import annotations

import numpy as np
from scipy.stats import rankdata

from otr.core.arrays import FloatArray


def areas_under_curve(scores: FloatArray, labels: FloatArray) -> FloatArray:
    """Return the area under the ROC curve of every model; NaN where a label has one class only.

    AUC = (sum of the ranks of the ones - n_1 (n_1 + 1) / 2) / (n_0 n_1), ties at their mean rank. Scores (..., n) are
    larger for label 1; labels, 0, 1 or NaN where it is missing, have a shape that broadcasts to theirs.
    """
    labels = np.broadcast_to(labels, scores.shape)
    missing = np.isnan(labels)
    # Rows without a label rank after all others, where they change no rank.
    ranks = rankdata(np.where(missing, np.inf, scores), axis=-1)
    is_one = labels == 1
    n_ones = is_one.sum(axis=-1)
    n_zeros = (~missing).sum(axis=-1) - n_ones
    sums = np.where(is_one, ranks, 0.0).sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        areas: FloatArray = (sums - n_ones * (n_ones + 1) / 2) / (n_ones * n_zeros)
    return areas


def negative_losses(loss: str, outputs: FloatArray, labels: FloatArray) -> FloatArray:
    """Return minus the mean loss of every model over the labels that are there; NaN without any.

    Outputs (..., n, o) are affine, o is 1 but for softmax; labels are as in `areas_under_curve`, for softmax the
    class's number.
    """
    labels = np.broadcast_to(labels, outputs.shape[:-1])
    missing = np.isnan(labels)
    targets = np.where(missing, 0.0, labels)
    with np.errstate(invalid="ignore", over="ignore"):  # of models that diverged, and of no label
        if loss == "softmax":
            chosen = np.take_along_axis(outputs, targets.astype(np.int64)[..., None], axis=-1)[..., 0]
            losses = np.logaddexp.reduce(outputs, axis=-1) - chosen
        elif loss == "logistic":
            losses = np.logaddexp(0.0, outputs[..., 0]) - targets * outputs[..., 0]
        elif loss == "poisson":
            losses = np.exp(outputs[..., 0]) - targets * outputs[..., 0]
        else:
            losses = (outputs[..., 0] - targets) ** 2
        means: FloatArray = -np.where(missing, 0.0, losses).sum(axis=-1) / (~missing).sum(axis=-1)
    return means
