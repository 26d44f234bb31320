"""Certificates: the proof that a tree and a network compute the same function on a domain, as a JSON file.

For each leaf the certificate lists the network's regions inside the leaf's own, and for each region and each hidden
neuron whose boundary does not cut it, Farkas multipliers: on the region the neuron's pre-activation, in the direction
of its sign, is a sum of the region's rows with weights that are not negative, up to a remainder that is bounded over
the domain. So the neuron cannot be on the other side by more than that remainder, the missing branch is empty, and the
network is an affine map there, which is compared with the leaf's. `otr.certify` (otr/proving.py) finds the proof,
`otr.verify` (otr/verification.py) checks it without a solver.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from otr.domain import Domain
from otr.errors import ArtefactError

__all__ = ["SCHEMA", "Cell", "Certificate", "EmptyLeaf", "Sum", "load_certificate"]

SCHEMA = "otr/certificate/1"


@dataclass(frozen=True)
class Sum:
    """A sum of rows with multipliers that are not negative.

    Attributes:
        rows: "low i", "high i": a side of the domain, ``x_i - low_i >= 0`` or ``high_i - x_i >= 0``; "test i": the
            leaf's path at test node i, ``P[i] @ x + v[i]`` with the sign of the path; "neuron i": a test of the
            network, with the sign that it has in the cell.
        multipliers: one each.
    """

    rows: tuple[str, ...]
    multipliers: tuple[float, ...]


@dataclass(frozen=True)
class Cell:
    """A region of the network inside a leaf's.

    Attributes:
        leaf: the leaf.
        outcomes: a character for each of the network's tests, hidden neurons first, then the head's: "1" for above 0.
        splits: the tests whose boundary cuts the leaf's region; they bound the cell.
        proofs: for every other test, in order: its value, in the direction of its outcome, is this sum and a remainder.
    """

    leaf: int
    outcomes: str
    splits: tuple[int, ...]
    proofs: tuple[Sum, ...]


@dataclass(frozen=True)
class EmptyLeaf:
    """A leaf whose region has no inside: this sum, at least 0 in the region, is nowhere above nearly nothing."""

    leaf: int
    proof: Sum


@dataclass(frozen=True)
class Certificate:
    """The proof that a tree and a network compute the same function on a domain.

    Attributes:
        domain: where.
        tolerance: radius, in the domain's scale, of the largest ball that an "empty" leaf's region may hold.
        exact: whether `max_error` was found in rational arithmetic, so that it holds for the numbers as they are
            stored; else in float64, so that it holds up to rounding.
        max_error: bound on the difference of any output, before the head, on the domain. For labels: the label is the
            network's wherever the outputs that decide it differ by more. On a domain with open sides all bounds are to
            be multiplied by 1 + the sum of |x_i| over the open inputs.
        n_leaves, n_empty, n_regions: leaves; those without an inside; regions of the network in the others.
        n_linear_programs: solved to find the proof.
        cells, empty: the proof.
    """

    domain: Domain
    tolerance: float
    exact: bool
    max_error: float
    n_leaves: int
    n_linear_programs: int
    cells: tuple[Cell, ...]
    empty: tuple[EmptyLeaf, ...]

    @property
    def n_regions(self) -> int:
        """Regions of the network in the leaves."""
        return len(self.cells)

    @property
    def n_empty(self) -> int:
        """Leaves without an inside."""
        return len(self.empty)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {
            "schema": SCHEMA,
            "domain": self.domain.to_dict(),
            "tolerance": self.tolerance,
            "exact": self.exact,
            "max_error": self.max_error,
            "n_leaves": self.n_leaves,
            "n_empty": self.n_empty,
            "n_regions": self.n_regions,
            "n_linear_programs": self.n_linear_programs,
            "cells": [
                {
                    "leaf": cell.leaf,
                    "outcomes": cell.outcomes,
                    "splits": list(cell.splits),
                    "proofs": [_listed(proof) for proof in cell.proofs],
                }
                for cell in self.cells
            ],
            "empty": [{"leaf": leaf.leaf, "proof": _listed(leaf.proof)} for leaf in self.empty],
        }

    @classmethod
    def from_dict(cls, description: dict[str, Any]) -> Certificate:
        """Return what `to_dict` described.

        Raises:
            ArtefactError: it is of another schema, or something is missing.
        """
        if not isinstance(description, dict) or description.get("schema") != SCHEMA:
            schema = description.get("schema") if isinstance(description, dict) else None
            raise ArtefactError(f"the certificate has the schema {schema!r}, expected {SCHEMA!r}")
        try:
            return cls(
                Domain.from_dict(description["domain"]),
                float(description["tolerance"]),
                bool(description["exact"]),
                float(description["max_error"]),
                int(description["n_leaves"]),
                int(description["n_linear_programs"]),
                tuple(_cell(cell) for cell in description["cells"]),
                tuple(EmptyLeaf(int(leaf["leaf"]), _sum(leaf["proof"])) for leaf in description["empty"]),
            )
        except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
            raise ArtefactError(f"the certificate cannot be read: {error!r}; certify the tree again") from error

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the certificate as JSON, a line for each cell."""
        description = self.to_dict()
        lists = {name: description.pop(name) for name in ("cells", "empty")}
        text = json.dumps(description, indent=2)[:-2]
        for name, entries in lists.items():
            lines = ",".join("\n    " + json.dumps(entry) for entry in entries)
            text += f',\n  "{name}": [{lines}' + ("\n  ]" if entries else "]")
        target = Path(path)
        target.write_text(text + "\n}\n")
        return target


def load_certificate(path: str | os.PathLike[str]) -> Certificate:
    """Read what `Certificate.save` wrote.

    Raises:
        ArtefactError: the file is missing, no JSON, or no certificate.
    """
    try:
        description = json.loads(Path(path).read_text())
    except (OSError, ValueError) as error:
        raise ArtefactError(f"{path} cannot be read as JSON ({error}); certify the tree again") from error
    return Certificate.from_dict(description)


def _listed(proof: Sum) -> dict[str, float]:
    return dict(zip(proof.rows, proof.multipliers, strict=True))


def _sum(description: dict[str, float]) -> Sum:
    return Sum(tuple(map(str, description)), tuple(float(multiplier) for multiplier in description.values()))


def _cell(description: dict[str, Any]) -> Cell:
    proofs = tuple(_sum(proof) for proof in description["proofs"])
    return Cell(int(description["leaf"]), str(description["outcomes"]), tuple(map(int, description["splits"])), proofs)
