"""What the bits of a fingerprint stand for: names of features for people.

A bit of a Morgan fingerprint is set by the surroundings of an atom, up to two bonds away, whose hash falls on it; other
surroundings may fall on the same bit. `bace_fragments.csv` has, for every bit, the fragment that sets it most often
among the training molecules, as SMILES without chirality; an atom alone has its hydrogens, ``[CH3]``. RDKit 2024.9.6
and 2026.9.1 agree on it.
"""

import csv
from importlib import resources

from pipelines.datasets.catalogue import MOLECULES
from pipelines.datasets.load import check_name, load_dataset
from pipelines.datasets.molecules import FEATURE_NAMES

TABLES = {"bace": "bace_fragments.csv"}
# A fragment lends its name to a bit that it sets in more than half of the bit's molecules.
LEAST_SHARE = 0.5
LONGEST_NAME = 20  # characters of SMILES; the longest of Bace has 28


def fragment_names(name: str) -> tuple[str, ...]:
    """Return a data set's feature names for people: ``C=O (bit1917)`` where a table knows the bit, else its own names.

    A long SMILES is cut short; the number of the bit never is.
    """
    check_name(name)
    if name in TABLES:
        text = resources.files("pipelines.datasets").joinpath(TABLES[name]).read_text(encoding="utf-8")
        rows = csv.DictReader(text.splitlines())  # of the bits in order
        return tuple(
            _name(bit, row["fragment"], float(row["share"])) for bit, row in zip(FEATURE_NAMES, rows, strict=True)
        )
    return FEATURE_NAMES if name in MOLECULES else load_dataset(name).feature_names


def _name(bit: str, fragment: str, share: float) -> str:
    if share <= LEAST_SHARE:
        return bit
    short = fragment if len(fragment) <= LONGEST_NAME else fragment[: LONGEST_NAME - 1] + "…"
    return f"{short} ({bit})"
