"""The rules of the parts."""

import numpy as np

from pipelines.datasets.splits import random_split, scaffold_split, shuffled_scaffold_split


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


def test_a_shuffled_split_keeps_scaffolds_together_and_the_sizes():
    scaffolds = np.random.default_rng(0).integers(0, 300, size=1000)
    scaffolds[:80] = 300  # more than half of a part of a tenth: in train, whatever the seed
    splits = [shuffled_scaffold_split(scaffolds, seed) for seed in range(5)]
    for parts in splits:
        assert sorted(np.concatenate([*parts.values()]).tolist()) == list(range(1000))
        found = [set(scaffolds[rows].tolist()) for rows in parts.values()]
        assert not found[0] & found[1] and not found[0] & found[2] and not found[1] & found[2]
        assert [abs(len(parts[name]) - due) <= 10 for name, due in (("train", 800), ("valid", 100), ("test", 100))]
        assert 300 in found[0]
    assert not np.array_equal(splits[0]["test"], splits[1]["test"])
    np.testing.assert_array_equal(splits[2]["test"], shuffled_scaffold_split(scaffolds, 2)["test"])
