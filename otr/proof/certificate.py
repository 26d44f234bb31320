"""Certificates: the proof that a tree and a network compute the same function on a domain, as a JSON file.

For each leaf the certificate lists the network's cells inside the leaf's region, and for each cell and each hidden
neuron whose boundary does not cut it, Farkas multipliers: in the cell the neuron's pre-activation, in the direction of
its sign, is a sum of the cell's rows with weights that are not negative, up to a remainder that is bounded over the
domain. So the neuron cannot be on the other side by more than that remainder, and the network is an affine map there
but for what such remainders change of its outputs; the leaf's map is compared with that. A leaf that no state reaches,
or a cell that holds none, comes with multipliers that show it. `otr.certify` (otr/proof/certify.py) finds the proof,
`otr.verify` (otr/proof/verify.py) checks it without a solver.
"""

from __future__ import annotations

import importlib
import json
import os
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from otr.core.domain import Domain
from otr.errors import ArtefactError, CertificateError

SCHEMA = "otr/certificate/2"


@dataclass(frozen=True)
class Sum:
    """A sum of rows with multipliers that are not negative."""

    rows: tuple[str, ...]  # names, as in otr/proof/exact_rows.py: "low i", "high i", "test i", "neuron i"
    multipliers: tuple[float | Fraction, ...]  # one each; a fraction where no float64 would do


@dataclass(frozen=True)
class Cell:
    """What some outcomes of the network's tests leave of a leaf's region.

    An outcome is "1" for above 0, one for each of the network's tests, hidden neurons first, then the head's; an empty
    cell has those up to its last split. The value of every test but the splits, in the direction of its outcome, is its
    proof and a remainder. Every difference of leaf and network in the cell, and its negative, is with its bound a form
    that is small over the domain; there are no bounds where the differences themselves are. No state is in a cell with
    a sum `empty`, which is nowhere above 0, and not 0 where the rows hold.

    Of a tree with labels, `near` are the outcomes of a piece of the network with the leaf's label that the cell's
    states are near to, if that is another than its `outcomes`; then there are proofs of all its tests, and the bounds
    are sums that the domain's sides are at least. The states come to the piece `towards` (d + 1,) a point (q, 1) or in
    a direction (p, 0), times any number; none are needed where all are in it. Where outputs tie throughout the piece,
    the cell is a sliver: by the sums `thin`, of test `onto` of the piece and of its negative, it is thin along the
    input that `towards` has, and the proofs are of the tests and sides where that input has brought test `onto` to 0.
    """

    leaf: int
    outcomes: str
    splits: tuple[int, ...]  # the tests whose boundary cuts the leaf's region; they bound the cell
    proofs: tuple[Sum, ...] = ()
    bounds: tuple[Sum, ...] = ()
    empty: Sum | None = None
    near: str = ""
    towards: tuple[float | Fraction, ...] = ()
    thin: tuple[Sum, ...] = ()
    onto: int = 0


@dataclass(frozen=True, repr=False)
class Certificate:
    """The proof that a tree and a network compute the same function on a domain: at every real point of it.

    The numbers of both are taken as they are stored, and nothing in the proof is rounded. A state is in a leaf where
    all tests on its path hold, at most 0 on the left and above 0 on the right.

    Attributes:
        domain: where.
        max_error: bound on the difference of any output, before the head, at every real point of the domain. Of labels
            it is a distance: no farther from a state with another label than the network's there are states of the
            domain at which the network has the tree's label (the largest change of an input, each counted in units of
            1 or of its width in the domain if that is smaller), or outputs tie for both throughout and the states are
            in a sliver no thicker. It is 5e-324, the smallest float64, if labels can differ on boundaries alone, and 0
            if nowhere. On a domain with open sides all bounds are to be multiplied by 1 + the sum of |x_i| over the
            open inputs, of labels by its square.
        n_leaves, n_empty, n_regions: leaves; those that no state reaches; cells of the network in the others.
        n_linear_programs: solved to find the proof.
        cells: the proof.

    Examples:
        >>> net = otr.ReluNetwork([[[1.0], [-1.0]], [[1.0, 1.0]]], [[0.0, 0.0], [0.0]])  # |x|
        >>> tree = otr.minimal_tree(net, ([-1], [1]))
        >>> proof = otr.certify(tree, net, ([-1], [1]))
        >>> proof.n_leaves, proof.max_error
        (2, 0.0)
        >>> otr.verify(proof, tree, net)  # checks it, and returns the bound
        0.0
    """

    domain: Domain
    max_error: float
    n_leaves: int
    n_linear_programs: int
    cells: tuple[Cell, ...]

    @property
    def n_regions(self) -> int:
        """Cells of the network in the leaves, without those that no state is in."""
        return sum(cell.empty is None for cell in self.cells)

    @property
    def n_empty(self) -> int:
        """Leaves that no state reaches."""
        return sum(cell.empty is not None and not cell.outcomes for cell in self.cells)

    def __repr__(self) -> str:
        where = "R^d" if not self.domain.is_bounded else "a box"
        return (
            f"Certificate({self.n_leaves:,} leaves, {self.n_empty:,} of them empty, {self.n_regions:,} regions, "
            f"max_error={self.max_error:.3g} on {where} of {self.domain.n_inputs} inputs)"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {
            "schema": SCHEMA,
            "domain": self.domain.to_dict(),
            "max_error": self.max_error,
            "n_leaves": self.n_leaves,
            "n_empty": self.n_empty,
            "n_regions": self.n_regions,
            "n_linear_programs": self.n_linear_programs,
            "cells": [_described(cell) for cell in self.cells],
        }

    @classmethod
    def from_dict(cls, description: dict[str, Any]) -> Certificate:
        """Return what `to_dict` described.

        Raises:
            ArtefactError: it is of another schema, or something is missing.
        """
        if not isinstance(description, dict) or description.get("schema") != SCHEMA:
            schema = description.get("schema") if isinstance(description, dict) else None
            raise ArtefactError(
                f"the certificate has the schema {schema!r}, expected {SCHEMA!r}; certify the tree again"
            )
        try:
            return cls(
                Domain.from_dict(description["domain"]),
                float(description["max_error"]),
                int(description["n_leaves"]),
                int(description["n_linear_programs"]),
                tuple(_cell(cell) for cell in description["cells"]),
            )
        except (AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError) as error:
            raise ArtefactError(f"the certificate cannot be read: {error!r}; certify the tree again") from error

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the certificate as JSON, a line for each cell."""
        description = self.to_dict()
        cells = description.pop("cells")
        lines = ",".join("\n    " + json.dumps(cell) for cell in cells)
        target = Path(path)
        target.write_text(json.dumps(description, indent=2)[:-2] + f',\n  "cells": [{lines}\n  ]\n}}\n')
        return target


def load_certificate(path: str | os.PathLike[str]) -> Any:
    """Read what `Certificate.save` wrote, or `FixedPointCertificate.save`.

    Raises:
        ArtefactError: the file is missing, no JSON, or no certificate.

    Examples:
        >>> net = otr.ReluNetwork([[[1.0], [-1.0]], [[1.0, 1.0]]], [[0.0, 0.0], [0.0]])  # |x|
        >>> tree = otr.minimal_tree(net, ([-1], [1]))
        >>> path = otr.certify(tree, net, ([-1], [1])).save("certificate.json")
        >>> otr.verify(otr.load_certificate(path), tree, net)
        0.0
    """
    try:
        description = json.loads(Path(path).read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise ArtefactError(f"{path} cannot be read as JSON ({error}); certify the tree again") from error
    if isinstance(description, dict) and str(description.get("schema")).startswith("otr/fixed-point-certificate/"):
        return importlib.import_module("otr").FixedPointCertificate.from_dict(description)  # of a floor above this one
    return Certificate.from_dict(description)


def check_cover(leaf: int, cells: Sequence[Cell]) -> None:
    """Raise CertificateError unless cells are all of a leaf's region: both sides of every test that splits it."""
    waiting = [(list(cells), 0)]  # cells, and the first of the tests that may part them
    while waiting:
        cells, after = waiting.pop()
        firsts = {_first_split(cell, after) for cell in cells}
        if firsts == {None} and len(cells) == 1:
            continue
        if len(firsts) != 1 or None in firsts:
            raise CertificateError(f"leaf {leaf}: its cells do not cover it; the tests that split it disagree", leaf)
        (test,) = firsts
        assert test is not None
        shared = {cell.outcomes[after:test] for cell in cells}
        sides = [[cell for cell in cells if cell.outcomes[test] == outcome] for outcome in "01"]
        if len(shared) != 1 or not all(sides):
            raise CertificateError(f"leaf {leaf}: its cells do not cover it; one side of test {test} is missing", leaf)
        waiting += [(side, test + 1) for side in sides]


def _first_split(cell: Cell, after: int) -> int | None:
    at = bisect_left(cell.splits, after)
    return cell.splits[at] if at < len(cell.splits) else None


def _described(cell: Cell) -> dict[str, Any]:
    description: dict[str, Any] = {"leaf": cell.leaf, "outcomes": cell.outcomes, "splits": list(cell.splits)}
    if cell.empty is not None:
        return description | {"empty": _listed(cell.empty)}
    description["proofs"] = [_listed(proof) for proof in cell.proofs]
    if cell.bounds:
        description["bounds"] = [_listed(bound) for bound in cell.bounds]
    if cell.near:
        description["near"] = cell.near
    if cell.towards:
        description["towards"] = [_written(number) for number in cell.towards]
    if cell.thin:
        description |= {"thin": [_listed(sum_) for sum_ in cell.thin], "onto": cell.onto}
    return description


def _cell(description: dict[str, Any]) -> Cell:
    return Cell(
        int(description["leaf"]),
        str(description["outcomes"]),
        tuple(map(int, description["splits"])),
        tuple(_sum(proof) for proof in description.get("proofs", ())),
        tuple(_sum(bound) for bound in description.get("bounds", ())),
        _sum(description["empty"]) if "empty" in description else None,
        str(description.get("near", "")),
        tuple(map(_number, description.get("towards", ()))),
        tuple(_sum(sum_) for sum_ in description.get("thin", ())),
        int(description.get("onto", 0)),
    )


def _listed(proof: Sum) -> dict[str, float | str]:
    """Return multipliers by row."""
    return {row: _written(multiplier) for row, multiplier in zip(proof.rows, proof.multipliers, strict=True)}


def _written(number: float | Fraction) -> float | str:
    """Return a number for JSON; a fraction as hexadecimal text, since its numbers may be long."""
    return number if isinstance(number, float) else f"{number.numerator:#x}/{number.denominator:#x}"


def _sum(description: dict[str, float | str]) -> Sum:
    return Sum(tuple(map(str, description)), tuple(map(_number, description.values())))


def _number(value: float | str) -> float | Fraction:
    if not isinstance(value, str):
        return float(value)
    numerator, denominator = value.split("/")
    return Fraction(int(numerator, 16), int(denominator, 16))
