"""What the bits of a fingerprint stand for: tables of substructures, and names of features for people.

A bit of a Morgan fingerprint is set by the surroundings of an atom, up to two bonds away, whose hash falls on it; other
surroundings may fall on the same bit. `bace_fragments.csv` has, for every bit, the fragment that sets it most often
among the training molecules. `otr-data bace --fragments FILE` makes it again; RDKit 2024.9.6 and 2026.9.1 agree on it.
"""

import csv
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from pipelines.datasets.catalogue import MOLECULES, MoleculeSet
from pipelines.datasets.load import check_name, load_dataset
from pipelines.datasets.molecules import FEATURE_NAMES, N_BITS
from pipelines.datasets.rebuild import fingerprint_generator, molecule_of, perceive
from pipelines.errors import PipelineError

COLUMNS = ("bit", "fragment", "n_molecules", "share")
TABLES = {"bace": "bace_fragments.csv"}
# A fragment lends its name to a bit that it sets in more than half of the bit's molecules.
LEAST_SHARE = 0.5
LONGEST_NAME = 20  # characters of SMILES; the longest of Bace has 28


@dataclass(frozen=True)
class Fragment:
    """What a bit stands for."""

    bit: int  # 0 .. 2047.
    # SMILES without chirality; an atom alone has its hydrogens, ``[CH3]``. Empty if no molecule has the bit.
    fragment: str
    n_molecules: int  # training molecules with the bit
    share: float  # of these, in how many the fragment sets it; below 1 where others do, too. 0 if there are none.


def fragment_names(name: str) -> tuple[str, ...]:
    """Return a data set's feature names for people: ``C=O (bit1917)`` where a table knows the bit, else its own names.

    A long SMILES is cut short; the number of the bit never is.
    """
    check_name(name)
    if name in TABLES:
        return tuple(map(_name, read_fragments(name)))
    return FEATURE_NAMES if name in MOLECULES else load_dataset(name).feature_names


def read_fragments(name: str) -> tuple[Fragment, ...]:
    """Return the table of a data set in `TABLES`, a row for each bit in order."""
    text = resources.files("pipelines.datasets").joinpath(TABLES[name]).read_text(encoding="utf-8")
    return tuple(
        Fragment(int(row["bit"]), row["fragment"], int(row["n_molecules"]), float(row["share"]))
        for row in csv.DictReader(text.splitlines())
    )


def write_fragments(fragments: Iterable[Fragment], path: Path) -> None:
    """Write a table as CSV."""
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(COLUMNS)
            writer.writerows((row.bit, row.fragment, row.n_molecules, f"{row.share:.4g}") for row in fragments)
    except OSError as error:
        raise PipelineError(f"cannot write {path}: {error.strerror or error}") from error


def find_fragments(entry: MoleculeSet) -> list[Fragment]:
    """Return what each bit stands for in a data set's training molecules; raises as `perceive`."""
    perceived = perceive(entry)
    n_molecules = [0] * N_BITS
    n_with: list[Counter[str]] = [Counter() for _ in range(N_BITS)]
    for row in perceived.split["train"]:
        found = _fragments_by_bit(perceived.rows[row][0])
        for bit in (bit for bit, digit in enumerate(perceived.fingerprints[row]) if digit == "1"):
            n_molecules[bit] += 1
            n_with[bit].update(found.get(bit, ()))
    return [_most_common(bit, n_molecules[bit], n_with[bit]) for bit in range(N_BITS)]


def _most_common(bit: int, n_molecules: int, n_with: Counter[str]) -> Fragment:
    """Return the fragment of most molecules; of equal ones the shortest, then the first by alphabet."""
    if not n_with:
        return Fragment(bit, "", n_molecules, 0.0)
    fragment = min(n_with, key=lambda smiles: (-n_with[smiles], len(smiles), smiles))
    return Fragment(bit, fragment, n_molecules, n_with[fragment] / n_molecules)


def _fragments_by_bit(smiles: str) -> dict[int, set[str]]:
    """Return the fragments that set each bit of a molecule's fingerprint."""
    from rdkit import rdBase
    from rdkit.Chem import rdFingerprintGenerator

    output = rdFingerprintGenerator.AdditionalOutput()
    output.AllocateBitInfoMap()
    with rdBase.BlockLogs():
        molecule = molecule_of(smiles)
        fingerprint_generator().GetFingerprint(molecule, additionalOutput=output)
    return {
        bit: {_smiles(molecule, atom, radius) for atom, radius in environments}
        for bit, environments in output.GetBitInfoMap().items()
    }


def _smiles(molecule: Any, centre: int, radius: int) -> str:
    """Return the SMILES of the bonds up to `radius` away from an atom, and of the atoms at their ends."""
    from rdkit import Chem

    bonds = list(Chem.FindAtomEnvironmentOfRadiusN(molecule, radius, centre)) if radius else []
    ends = [molecule.GetBondWithIdx(bond) for bond in bonds]
    atoms = {centre, *(bond.GetBeginAtomIdx() for bond in ends), *(bond.GetEndAtomIdx() for bond in ends)}
    # An atom alone says too little without its hydrogens: C may be CH, CH2 or CH3, which are different bits.
    smiles: str = Chem.MolFragmentToSmiles(
        molecule, sorted(atoms), bonds, isomericSmiles=False, allHsExplicit=radius == 0
    )
    return smiles


def _name(row: Fragment) -> str:
    if row.share <= LEAST_SHARE:
        return FEATURE_NAMES[row.bit]
    short = row.fragment if len(row.fragment) <= LONGEST_NAME else row.fragment[: LONGEST_NAME - 1] + "…"
    return f"{short} ({FEATURE_NAMES[row.bit]})"
