"""How trees on data are scored: the area under the ROC curve, accuracy or error, and their size."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipelines.datasets.dataset import Dataset

if TYPE_CHECKING:
    from otr import ObliqueTree, PatternTree

METRICS = {"auc": "AUC", "accuracy": "accuracy", "rmse": "RMSE"}


@dataclass(frozen=True)
class Size:
    """How large a tree is.

    Attributes:
        depth: tests on the longest path.
        leaves: leaves that the training rows reach, the leaves of OTR-hat.
    """

    depth: int
    leaves: int


def metric_of(dataset: Dataset) -> str:
    """Return what the data set is scored by: auc for labels 0 and 1, accuracy for more classes, rmse for numbers."""
    if dataset.task == "regression":
        return "rmse"
    return "auc" if np.nanmax(dataset.train.Y) <= 1 else "accuracy"


def outputs_of(tree: "ObliqueTree | PatternTree", X: np.ndarray) -> np.ndarray:
    """Return what the leaves answer: (n,) numbers, larger for label 1, or (n, c) for c > 2 classes."""
    outputs = tree.forward(X)
    if outputs.shape[1] == 1:
        return outputs[:, 0]
    return outputs[:, 1] - outputs[:, 0] if outputs.shape[1] == 2 else outputs


def score(metric: str, outputs: np.ndarray, y: np.ndarray) -> float:
    """Return the score of outputs for the labels (n,); NaN for an AUC where there is one class only."""
    if metric == "auc":
        from otr.learners.networks.validation_scores import areas_under_curve

        return float(areas_under_curve(outputs, y.astype(np.float64)))
    if metric == "accuracy":
        return float(np.mean(outputs.argmax(axis=1) == y))
    return float(np.sqrt(np.mean((outputs - y) ** 2)))


def gain(metric: str, value: float) -> float:
    """Return a score so that more is better."""
    return -value if metric == "rmse" else value


def size_of(tree: "ObliqueTree | PatternTree", X: np.ndarray) -> Size:
    """Return the tree's size, its leaves being those that X (n, d) reaches."""
    import otr

    if isinstance(tree, otr.PatternTree):
        return Size(tree.n_bits, len(tree.observe(X).patterns))
    return Size(tree.depth, len(np.unique(tree.apply(X))))
