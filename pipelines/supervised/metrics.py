"""How trees on data are scored: the area under the ROC curve, accuracy or error."""

from typing import TYPE_CHECKING

import numpy as np

from pipelines.datasets.dataset import Dataset

if TYPE_CHECKING:
    from otr import ObliqueTree, PatternTree

METRICS = {"auc": "AUC", "accuracy": "accuracy", "rmse": "RMSE", "deviance": "mean Poisson deviance"}
LOSSES = ("rmse", "deviance")  # of which less is better
LEAST_COUNT = 1e-3  # an expected count below it counts as this: a deviance is infinite where a leaf expects 0


def metric_of(dataset: Dataset) -> str:
    """Return what the data set is scored by: auc for labels 0 and 1, accuracy for more classes, rmse, or deviance."""
    if dataset.task != "classification":
        return {"regression": "rmse", "counts": "deviance"}[dataset.task]
    return "auc" if np.nanmax(dataset.train.Y) <= 1 else "accuracy"


def outputs_of(tree: "ObliqueTree | PatternTree", X: np.ndarray) -> np.ndarray:
    """Return what a tree answers (n,): numbers or counts, larger for label 1, or of more than two classes the class.

    The class is that of the tree's own tests: the largest output of a leaf may be of another one where paths between
    classes were pruned.
    """
    from otr import Exp, PatternTree

    head = tree.network.head if isinstance(tree, PatternTree) else tree.head
    outputs = head(tree.forward(X)) if isinstance(head, Exp) else tree.forward(X)
    if outputs.shape[1] == 1:
        return outputs[:, 0]
    return outputs[:, 1] - outputs[:, 0] if outputs.shape[1] == 2 else tree.predict(X)


def score(metric: str, outputs: np.ndarray, y: np.ndarray) -> float:
    """Return the score of outputs for the labels (n,); NaN for an AUC where there is one class only."""
    if metric == "auc":
        from otr.learners.networks.validation_scores import areas_under_curve

        return float(areas_under_curve(outputs, y.astype(np.float64)))
    if metric == "accuracy":
        return float(np.mean(outputs == y))
    if metric == "deviance":
        from sklearn.metrics import mean_poisson_deviance

        return float(mean_poisson_deviance(y, np.maximum(outputs, LEAST_COUNT)))
    return float(np.sqrt(np.mean((outputs - y) ** 2)))


def gain(metric: str, value: float) -> float:
    """Return a score so that more is better."""
    return -value if metric in LOSSES else value
