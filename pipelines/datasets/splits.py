"""The rules that parts follow; the row order within a part is the rule's.

`scaffolds.safetensors` has an array for every data set of molecules, a number for each row of its file of SMILES (as of
January 2019, github.com/chemprop/chemprop, a68ade20): rows with the same number have the same Murcko scaffold (Bemis &
Murcko 1996, without chirality) in RDKit 2026.9.1, numbered as they are met.
"""

import functools
from collections.abc import Hashable, Sequence
from importlib import resources

import numpy as np
from safetensors.numpy import load

from pipelines.datasets.catalogue import MoleculeSet


@functools.lru_cache
def scaffolds_of(name: str) -> np.ndarray:
    """Return the scaffold's number of each row of a data set's file of SMILES, (n,) int64."""
    content = resources.files("pipelines.datasets").joinpath("scaffolds.safetensors").read_bytes()
    return np.asarray(load(content)[name], dtype=np.int64)


def scaffolds_by_part(entry: MoleculeSet) -> dict[str, np.ndarray]:
    """Return the scaffold's number of each row of a data set's parts, as LCN split them."""
    scaffolds = scaffolds_of(entry.name)
    rows = scaffold_split(scaffolds.tolist()) if entry.split_rule == "scaffold" else random_split(len(scaffolds))
    return {part: scaffolds[of_part] for part, of_part in rows.items()}


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


def shuffled_scaffold_split(scaffolds: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Return the rows of each part, 80/10/10, whole scaffolds together, in an order that the seed draws.

    Scaffolds with more rows than half of a tenth are dealt first, so that a part is never one of them alone; each goes
    to train while it fits into 80 % of the rows, else to valid while it fits into 10 %, else to test. That is the
    balanced scaffold split of Yang et al. ("Analyzing learned molecular representations", 2019).

    Args:
        scaffolds: (n,) the scaffold's number of each row.
        seed: of the order.
    """
    n_rows = len(scaffolds)
    ends = np.cumsum(np.unique(scaffolds, return_counts=True)[1])
    groups = np.split(np.argsort(scaffolds, kind="stable"), ends[:-1])
    order = np.random.default_rng(seed).permutation(len(groups))
    is_large = np.array([len(groups[i]) > 0.05 * n_rows for i in order])
    parts: dict[str, list[np.ndarray]] = {"train": [], "valid": [], "test": []}
    sizes = dict.fromkeys(parts, 0)
    room = {"train": 0.8 * n_rows, "valid": 0.1 * n_rows, "test": n_rows}
    for i in np.concatenate([order[is_large], order[~is_large]]):
        n = len(groups[i])
        fits = next(name for name in parts if sizes[name] + n <= room[name])
        parts[fits].append(groups[i])
        sizes[fits] += n
    return {name: np.sort(np.concatenate(rows)) for name, rows in parts.items()}
