"""LCN's split files rebuilt from SMILES, byte for byte, with RDKit (extra `molecules`).

Morgan fingerprints of radius 2, 2,048 bits, no chirality. Today's RDKit perceives 77 molecules differently from that of
2019 (aromaticity of fused rings, hydrogens of two-coordinate iodine, some metals): `old_rdkit_rows.json` has their
on-bits by row of the file of SMILES. Tried with RDKit 2024.9.6 and 2026.9.1.
"""

import csv
import importlib.util
import io
import json
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np

from pipelines.datasets.catalogue import MoleculeSet
from pipelines.datasets.download import read
from pipelines.datasets.molecules import N_BITS
from pipelines.datasets.splits import random_split, scaffold_split
from pipelines.errors import PipelineError


def can_rebuild() -> bool:
    """Return whether RDKit is installed."""
    return importlib.util.find_spec("rdkit") is not None


def rebuild(entry: MoleculeSet) -> dict[str, bytes]:
    """Return the content of a data set's split files, made from SMILES; PipelineError where it is not LCN's."""
    perceived = perceive(entry)
    import rdkit

    contents = {}
    for part, file in entry.parts.items():
        lines = [perceived.header]
        lines += [",".join([perceived.fingerprints[row], *perceived.rows[row][1:]]) for row in perceived.split[part]]
        contents[part] = ("\n".join(lines) + "\n").encode()
        difference = file.difference(contents[part])
        if difference:
            raise PipelineError(
                f"{file.path} as RDKit {rdkit.__version__} gives it is not LCN's: {difference}\n"
                f"Try RDKit 2026.9.1, or fetch the file from {' or '.join(file.addresses)}."
            )
    return contents


@dataclass(frozen=True)
class Perceived:
    """A data set's molecules as RDKit sees them."""

    header: str  # first line of the file of SMILES
    rows: list[list[str]]  # its other lines: SMILES, then labels as text
    fingerprints: list[str]  # one a row, 2,048 characters 0 and 1
    scaffolds: list[str]  # one a row, the Murcko scaffold without chirality
    split: dict[str, np.ndarray]  # the rows of train, valid and test


def perceive(entry: MoleculeSet) -> Perceived:
    """Return a data set's molecules with their fingerprints and parts.

    Raises:
        MissingInputError: the file of SMILES is not here and could not be fetched.
        PipelineError: RDKit is not installed.
    """
    if not can_rebuild():
        raise PipelineError(f"rebuilding {entry.name} needs RDKit: pip install 'otr[molecules]'")
    text = read(entry.raw).decode()
    rows = list(csv.reader(io.StringIO(text)))[1:]
    fingerprints, scaffolds = _perceive([row[0] for row in rows])
    for row, bits in _old_rows(entry.lcn_name).items():
        fingerprints[int(row)] = "".join("1" if bit in bits else "0" for bit in range(N_BITS))
    split = scaffold_split(scaffolds) if entry.split_rule == "scaffold" else random_split(len(rows))
    return Perceived(text.splitlines()[0], rows, fingerprints, scaffolds, split)


def fingerprint_generator() -> Any:
    """Return RDKit's generator of the fingerprints."""
    from rdkit.Chem import rdFingerprintGenerator

    return rdFingerprintGenerator.GetMorganGenerator(radius=2, fpSize=N_BITS)


def _perceive(smiles: list[str]) -> tuple[list[str], list[str]]:
    """Return each molecule's fingerprint as text and its Murcko scaffold without chirality."""
    from rdkit import Chem, rdBase
    from rdkit.Chem.Scaffolds import MurckoScaffold

    generator = fingerprint_generator()
    fingerprints, scaffolds = [], []
    with rdBase.BlockLogs():
        for row, text in enumerate(smiles):
            molecule = molecule_of(text)
            fingerprints.append(generator.GetFingerprint(molecule).ToBitString())
            try:
                scaffold = MurckoScaffold.MurckoScaffoldSmiles(mol=molecule, includeChirality=False)
            except (ValueError, RuntimeError, Chem.MolSanitizeException):
                scaffold = f"row {row}"  # a scaffold of its own
            scaffolds.append(scaffold)
    return fingerprints, scaffolds


def molecule_of(smiles: str) -> Any:
    """Return the molecule; valences that RDKit has come to refuse (mostly of aluminium) are let through."""
    from rdkit import Chem

    molecule = Chem.MolFromSmiles(smiles)
    if molecule is None:
        molecule = Chem.MolFromSmiles(smiles, sanitize=False)
        molecule.UpdatePropertyCache(strict=False)
        Chem.SanitizeMol(molecule, Chem.SANITIZE_ALL ^ Chem.SANITIZE_PROPERTIES)
    return molecule


def _old_rows(lcn_name: str) -> dict[str, set[int]]:
    text = resources.files("pipelines.datasets").joinpath("old_rdkit_rows.json").read_text(encoding="utf-8")
    return {row: set(bits) for row, bits in json.loads(text).get(lcn_name, {}).items()}
