"""The two rules of the parts, by hand."""

import numpy as np

from pipelines.datasets.splits import random_split, scaffold_split


def test_random_split_takes_test_before_valid():
    parts = random_split(19)
    order = np.random.RandomState(0).permutation(19)
    np.testing.assert_array_equal(np.concatenate([parts["train"], parts["test"], parts["valid"]]), order)
    assert {name: len(rows) for name, rows in parts.items()} == {"train": 15, "valid": 2, "test": 2}


def test_scaffolds_stay_together_and_large_ones_go_first():
    # 10 rows: a has 5, b and c have 2 each (c's first row is later), d has 1; 8 rows fit into train, 9 with valid.
    parts = scaffold_split(["a", "b", "a", "c", "a", "b", "a", "c", "a", "d"])
    assert {name: rows.tolist() for name, rows in parts.items()} == {
        "train": [0, 2, 4, 6, 8, 3, 7, 9],
        "valid": [1, 5],
        "test": [],
    }


def test_a_scaffold_that_fits_nowhere_else_goes_to_test():
    parts = scaffold_split(["a"] * 10 + ["b"])
    assert parts["train"].tolist() == [10]
    assert parts["valid"].tolist() == []
    assert parts["test"].tolist() == list(range(10))
