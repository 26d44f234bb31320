"""The two rules that the parts follow; the row order within a part is the rule's."""

from collections.abc import Hashable, Sequence

import numpy as np


def random_split(n_rows: int) -> dict[str, np.ndarray]:
    """Return the rows of each part: 80/10/10 of `RandomState(0).permutation`, whose stream NumPy has frozen.

    Test comes before valid in the permutation: that is how LCN's files are made, and their names are right.
    """
    order = np.random.RandomState(0).permutation(n_rows)
    first, second = int(0.8 * n_rows), int(0.9 * n_rows)
    return {"train": order[:first], "valid": order[second:], "test": order[first:second]}


def scaffold_split(scaffolds: Sequence[Hashable]) -> dict[str, np.ndarray]:
    """Return the rows of each part, whole scaffolds together (DeepChem's ScaffoldSplitter, 80/10/10).

    Scaffolds go from the largest to the smallest, of equal ones that with the later first row before; each goes to
    train while it fits into 80 % of the rows, else to valid while train and valid fit into 90 %, else to test.
    """
    groups: dict[Hashable, list[int]] = {}
    for row, scaffold in enumerate(scaffolds):
        groups.setdefault(scaffold, []).append(row)
    parts: dict[str, list[int]] = {"train": [], "valid": [], "test": []}
    n_rows = len(scaffolds)
    for group in sorted(groups.values(), key=lambda rows: (len(rows), rows[0]), reverse=True):
        n_train, n_valid = len(parts["train"]) + len(group), len(parts["valid"])
        fits = "train" if n_train <= 0.8 * n_rows else "valid" if n_train + n_valid <= 0.9 * n_rows else "test"
        parts[fits] += group
    return {name: np.array(rows, dtype=np.int64) for name, rows in parts.items()}
