"""Certificates of rounded trees with one piece of the network a leaf, whose error is what that leaves open.

The network's activation pattern at an inner point of a leaf's region is that of the leaf. Rounded tests move the
region's sides, so it reaches a little beyond the pattern's: by how much each neuron's pre-activation is on the wrong
side, at most, is a linear program, and its multipliers are the neuron's proof. So a leaf takes one cell, and no search
among the slivers along its sides; for a bound without what that adds there is `otr.certify`.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np

from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.core.domain import Domain
from otr.core.network import ReluNetwork
from otr.core.tree import ObliqueTree
from otr.geometry.largest_balls import largest_balls
from otr.geometry.largest_values import largest_values
from otr.geometry.rational import Integers
from otr.geometry.regions import chunks_of_leaves, leaf_rows
from otr.proof.certificate import Cell, Certificate, Sum
from otr.proof.exact_cells import as_sum, decide_in
from otr.proof.exact_rows import INFINITE, ExactRow, TreeAndNetwork
from otr.proof.float_cells import row_names
from otr.proof.verify import Checker, verify

_ANY = 1e300  # an error that no proof has
_NEGLIGIBLE = 1e-13  # of the largest multiplier


def certificate_by_pieces(tree: ObliqueTree, network: ReluNetwork, domain: Domain) -> Certificate:
    """Return a certificate of a tree without labels, as `otr.certify`, or with them, by leads: see `bound_of`."""
    cells: list[Cell] = []
    for leaves in chunks_of_leaves(tree, domain):
        cells += _cells(tree, network, domain, leaves)
    n_tests = network.n_hidden + network.head.n_tests(network.n_outputs)
    n_programs = tree.n_leaves * (1 + n_tests + 2 * tree.n_outputs)
    certificate = Certificate(domain, _ANY, tree.n_leaves, n_programs, tuple(cells))
    return replace(certificate, max_error=bound_of(certificate, tree, network))


def bound_of(
    certificate: Certificate, tree: ObliqueTree, network: ReluNetwork, *, max_seconds: float | None = None
) -> float:
    """Return the bound that `otr.verify` returns or, of labels, one on the lead of other labels than a leaf's.

    Nowhere in the domain is an output of the network above that of the tree's label by more.
    """
    if tree.labels is None:
        return verify(certificate, tree, network, max_seconds=max_seconds)
    return _LeadChecker(TreeAndNetwork(tree, network, certificate.domain)).run(certificate)


class _LeadChecker(Checker):
    """A check of cells with labels, by how far other outputs may be above that of the label.

    In a piece where the tests have the outcomes A, the label's output wins a tournament: so that of any other label is
    above it by no more than what the tests fall short of A, and what the outputs are off those of A.
    """

    def _distance(self, cell: Cell, rows: dict[str, ExactRow], turned: list[Integers]) -> Fraction:
        outcomes = [outcome == "1" for outcome in cell.outcomes]
        assert self.pair.tree.labels is not None
        if cell.splits or self.pair.label(outcomes) != self.pair.tree.labels[cell.leaf]:
            return INFINITE
        n = self.pair.network.n_hidden
        pairs = zip(turned, cell.proofs, strict=True)
        short = [max(self.shortfall(cell.leaf, test, proof, rows), Fraction(0)) for test, proof in pairs]
        errors = self._output_errors(short[:n])
        return sum(short[n:], Fraction(0)) + min(len(errors), 2) * max(errors)


def _cells(tree: ObliqueTree, network: ReluNetwork, domain: Domain, leaves: IntArray) -> list[Cell]:
    """Return a cell for each leaf: empty, or with proofs of the tests, and of differences where there are no labels."""
    rows, signs = leaf_rows(tree, domain, leaves)
    balls = largest_balls(rows, np.arange(len(leaves)), signs)
    names = row_names(tree, domain.sides()[1], leaves)
    outcomes = _outcomes(tree, network, leaves, np.clip(domain.unscaled(balls.centres), domain.low, domain.high))
    turned, differences = _forms(tree, network, leaves, outcomes)
    objectives = np.concatenate((-turned, differences, -differences), axis=1)
    n, n_forms, _ = objectives.shape
    flat = domain.scaled(objectives).reshape(n * n_forms, -1)
    best = largest_values(rows, np.repeat(np.arange(n), n_forms), np.repeat(signs, n_forms, axis=0), flat)
    lengths = rows.lengths[np.repeat(np.arange(n), n_forms)[:, None], best.rows]
    used = best.multipliers > _NEGLIGIBLE * best.multipliers.max(axis=1, keepdims=True)
    weights = np.where(used & (best.values > -np.inf)[:, None], best.multipliers / lengths, 0.0)
    cells = []
    for at, leaf in enumerate(leaves.tolist()):
        empty = _empty_sum(tree, network, domain, leaf) if balls.radii[at] == 0 else None
        if empty is not None:
            cells.append(Cell(leaf, "", (), empty=empty))
            continue
        sums = []
        for i in range(at * n_forms, (at + 1) * n_forms):
            total: dict[str, float] = {}
            for row, weight in zip(best.rows[i].tolist(), weights[i].tolist(), strict=True):
                if weight > 0:
                    total[names[leaf][row]] = total.get(names[leaf][row], 0.0) + weight
            sums.append(Sum(tuple(total), tuple(total.values())))
        bits = "".join("1" if outcome else "0" for outcome in outcomes[at])
        n_tests, o = outcomes.shape[1], differences.shape[1]
        bounds = [sums[n_tests + side * o + k] for k in range(o) for side in (1, 0)]
        cells.append(Cell(leaf, bits, (), tuple(sums[:n_tests]), tuple(bounds)))
    return cells


def _empty_sum(tree: ObliqueTree, network: ReluNetwork, domain: Domain, leaf: int) -> Sum | None:
    """Return what shows that a leaf has no state; None if it has one, however thin it is."""
    pair = TreeAndNetwork(tree, network, domain)
    found = decide_in(pair, pair.rows_of_leaf(leaf))
    return None if isinstance(found, tuple) else as_sum(found)


def _outcomes(tree: ObliqueTree, network: ReluNetwork, leaves: IntArray, centres: FloatArray) -> BoolArray:
    """Return outcomes of the network's tests (n, n_tests): neurons as at the centres, and such that the label wins."""
    patterns, outputs = network.patterns_and_outputs(centres)
    if tree.labels is not None:
        labels = tree.labels[leaves]
        if network.n_outputs == 1:  # Sign
            outputs = np.where(labels, 1.0, -1.0)[:, None]
        else:
            outputs[np.arange(len(leaves)), labels] = outputs.max(axis=1) + 1 + np.abs(outputs).max(axis=1)
    return np.concatenate((patterns, network.head.tests(outputs)), axis=1)


def _forms(
    tree: ObliqueTree, network: ReluNetwork, leaves: IntArray, outcomes: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the tests' forms (n, n_tests, d + 1), which hold where not below 0, and leaf less network (n, o, d + 1).

    With labels there are no differences.
    """
    n = network.n_hidden
    forms = network.unit_form().forms(outcomes[:, :n], network.negative_slope)
    outputs, tests = forms[:, n:], forms[:, :n]
    for k in range(outcomes.shape[1] - n):
        tests = np.concatenate((tests, network.head.next_test(outputs, outcomes[:, n : n + k])[:, None]), axis=1)
    turned = np.where(outcomes, 1.0, -1.0)[..., None] * tests
    differences = tree.leaf_forms[leaves] - outputs
    return turned, differences[:, : 0 if tree.labels is not None else None]
