"""scikit-learn's data sets with fixed parts."""

import numpy as np
import pytest

from pipelines.datasets import load_dataset
from pipelines.errors import ConfigError


@pytest.mark.parametrize(
    "name, task, sizes, n_features, label, first",
    [
        ("breast_cancer", "classification", (455, 57, 57), 30, "benign", 512),
        ("digits", "classification", (1437, 180, 180), 64, "digit", 1081),
        ("diabetes", "regression", (353, 45, 44), 10, "progression", 362),
    ],
)
def test_fixed_parts(name, task, sizes, n_features, label, first):
    from sklearn import datasets

    dataset = load_dataset(name)
    whole = getattr(datasets, f"load_{name}")()
    parts = [dataset.train, dataset.valid, dataset.test]
    assert (dataset.task, dataset.label_names, len(dataset.feature_names)) == (task, (label,), n_features)
    assert tuple(len(part.X) for part in parts) == sizes
    assert all(part.X.dtype == np.float32 and part.Y.dtype == np.float64 for part in parts)
    np.testing.assert_array_equal(dataset.train.X[0], whole.data[first].astype(np.float32))
    assert dataset.train.Y[0, 0] == whole.target[first]
    assert sorted(np.concatenate([part.Y[:, 0] for part in parts])) == sorted(whole.target)


def test_folds_of_rows_without_groups():
    dataset = load_dataset("breast_cancer")
    folds = dataset.folds(4)
    rows = np.concatenate([fold.test.X for fold in folds])
    pooled = np.concatenate([dataset.train.X, dataset.valid.X])
    assert sorted(map(tuple, rows.tolist())) == sorted(map(tuple, pooled.tolist()))
    assert all(fold.test.groups is None for fold in folds)


def test_what_has_no_scaffolds_is_not_split_by_them():
    with pytest.raises(ConfigError, match="digits has no scaffolds to split it by; those with scaffolds are bace"):
        load_dataset("digits", split=0)
