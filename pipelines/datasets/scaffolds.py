"""Which molecules share a scaffold, from a file that comes with the package: RDKit is not needed.

`scaffolds.safetensors` has an array for every data set, a number for each row of its file of SMILES: rows with the same
number have the same Murcko scaffold (Bemis & Murcko 1996, without chirality) in RDKit 2026.9.1. `write_scaffolds` made
it.
"""

import functools
from importlib import resources
from pathlib import Path

import numpy as np
from safetensors.numpy import load, save_file

from pipelines.datasets.catalogue import MOLECULES, MoleculeSet
from pipelines.datasets.splits import random_split, scaffold_split

FILE = "scaffolds.safetensors"


@functools.lru_cache
def scaffolds_of(name: str) -> np.ndarray:
    """Return the scaffold's number of each row of a data set's file of SMILES, (n,) int64."""
    content = resources.files("pipelines.datasets").joinpath(FILE).read_bytes()
    return np.asarray(load(content)[name], dtype=np.int64)


def scaffolds_by_part(entry: MoleculeSet) -> dict[str, np.ndarray]:
    """Return the scaffold's number of each row of a data set's parts, as LCN split them."""
    scaffolds = scaffolds_of(entry.name)
    rows = scaffold_split(scaffolds.tolist()) if entry.split_rule == "scaffold" else random_split(len(scaffolds))
    return {part: scaffolds[of_part] for part, of_part in rows.items()}


def number_scaffolds(entry: MoleculeSet) -> np.ndarray:
    """Return what `scaffolds_of` has read, found again by RDKit; scaffolds are numbered as they are met."""
    from pipelines.datasets.rebuild import perceive

    numbers: dict[str, int] = {}
    scaffolds = perceive(entry).scaffolds
    return np.array([numbers.setdefault(scaffold, len(numbers)) for scaffold in scaffolds], dtype=np.uint16)


def write_scaffolds() -> None:
    """Write the file again; needs RDKit and the files of SMILES."""
    save_file({name: number_scaffolds(entry) for name, entry in MOLECULES.items()}, Path(__file__).with_name(FILE))
