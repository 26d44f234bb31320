"""Certificates of rounded trees with labels: by how much a network may prefer another label than its leaf's.

`otr.certify` bounds how far states are from where the network has the label. A lead is about outputs: a leaf takes one
cell, with the outcomes of the network's tests at an inner point and such that the label wins. Rounded tests move the
region's sides, so some states are beyond: the proofs bound by how much each test is on the wrong side, at most, so no
search is needed among the slivers along its sides.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np

from otr.clock import check_time
from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.core.domain import Domain
from otr.core.network import ReluNetwork
from otr.core.tree import ObliqueTree
from otr.geometry.largest_balls import largest_balls
from otr.geometry.rational import Integers
from otr.geometry.regions import chunks_of_leaves, leaf_rows
from otr.proof.certificate import Cell, Certificate, Sum
from otr.proof.exact_cells import as_sum, decide_in
from otr.proof.exact_rows import INFINITE, ExactRow, TreeAndNetwork
from otr.proof.float_cells import with_smallest_bounds
from otr.proof.verify import Checker, bits

ANY_ERROR = 1e300  # that no proof has


def certificate_of_leads(tree: ObliqueTree, network: ReluNetwork, domain: Domain) -> Certificate:
    """Return a certificate whose error is what `LeadChecker` bounds, of a tree with labels."""
    pair, cells = TreeAndNetwork(tree, network, domain), list[Cell]()
    for leaves in chunks_of_leaves(tree, domain):
        rows, signs = leaf_rows(tree, domain, leaves)
        balls = largest_balls(rows, np.arange(len(leaves)), signs)
        centres = np.clip(domain.unscaled(balls.centres), domain.low, domain.high)
        outcomes = _outcomes(network, tree.labels[leaves], centres)  # type: ignore[index]
        for leaf, radius, of_leaf in zip(leaves.tolist(), balls.radii.tolist(), outcomes, strict=True):
            check_time()
            point = decide_in(pair, pair.rows_of_leaf(leaf)) if radius == 0 else ()
            if isinstance(point, tuple):
                text = "".join("1" if bit else "0" for bit in of_leaf)
                cells.append(with_smallest_bounds(pair, Cell(leaf, text, (), (Sum((), ()),) * pair.n_tests))[0])
            else:
                cells.append(Cell(leaf, "", (), empty=as_sum(point)))
    found = Certificate(domain, ANY_ERROR, tree.n_leaves, tree.n_leaves * (1 + pair.n_tests), tuple(cells))
    return replace(found, max_error=LeadChecker(pair).run(found))


class LeadChecker(Checker):
    """A check of cells with labels, by how far other outputs may be above that of the label.

    In a piece where the tests have the outcomes A, the label's output wins a tournament: so that of any other label is
    above it by no more than what the tests fall short of A, and what the outputs are off those of A.
    """

    def _distance(self, cell: Cell, rows: dict[str, ExactRow], turned: list[Integers]) -> Fraction:
        outcomes = bits(cell.outcomes)
        assert self.pair.tree.labels is not None
        if cell.splits or self.pair.label(outcomes) != self.pair.tree.labels[cell.leaf]:
            return INFINITE
        n = self.pair.network.n_hidden
        pairs = zip(turned, cell.proofs, strict=True)
        short = [max(self.shortfall(cell.leaf, test, proof, rows), Fraction(0)) for test, proof in pairs]
        errors = self._output_errors(short[:n])
        up, down = max(errors[::2]), max(errors[1::2])
        return sum(short[n:], Fraction(0)) + (up + down if len(errors) > 2 else max(up, down))


def _outcomes(network: ReluNetwork, labels: IntArray, centres: FloatArray) -> BoolArray:
    """Return outcomes of the network's tests (n, n_tests): neurons as at the centres, and such that the labels win."""
    patterns, outputs = network.patterns_and_outputs(centres)
    if network.n_outputs == 1:  # Sign
        outputs = np.where(labels, 1.0, -1.0)[:, None]
    else:
        outputs[np.arange(len(labels)), labels] = outputs.max(axis=1) + 1 + np.abs(outputs).max(axis=1)
    return np.concatenate((patterns, network.head.tests(outputs)), axis=1)
