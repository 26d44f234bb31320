"""Three of scikit-learn's built-in data sets, for examples and smoke tests without a network."""

import numpy as np

from pipelines.datasets.columns import TaskKind
from pipelines.datasets.dataset import Dataset, Part
from pipelines.datasets.splits import random_split


def load_example(name: str) -> Dataset:
    """Return breast_cancer (label: benign), digits (0 to 9) or diabetes (regression), split by `random_split`."""
    from sklearn import datasets

    bunch = {
        "breast_cancer": datasets.load_breast_cancer,
        "digits": datasets.load_digits,
        "diabetes": datasets.load_diabetes,
    }[name]()
    label = {"breast_cancer": "benign", "digits": "digit", "diabetes": "progression"}[name]
    task: TaskKind = "regression" if name == "diabetes" else "classification"
    X = np.asarray(bunch.data, dtype=np.float32)
    Y = np.asarray(bunch.target, dtype=np.float64)[:, None]
    parts = {part: Part(X[rows], Y[rows]) for part, rows in random_split(len(X)).items()}
    return Dataset(name, task, (label,), tuple(map(str, bunch.feature_names)), *parts.values())
