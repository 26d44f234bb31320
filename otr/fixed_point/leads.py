"""Certificates of rounded trees with labels: by how much a network may prefer another label than its leaf's.

`otr.certify` bounds how far states are from where the network has the label. A lead is about outputs: a cell has the
outcomes of the network's neurons at an inner point, and such of the head's tests that the label wins. Rounded tests
move a region's sides, so some states are beyond: the proofs bound by how much each test is on the wrong side, at most,
so no search is needed among the slivers along its sides. A leaf takes one cell or, where several regions of the network
lie in it and that bound is large, one for each.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from itertools import chain

import numpy as np

from otr.clock import check_time
from otr.core.arrays import BoolArray, FloatArray
from otr.core.domain import Domain
from otr.core.network import ReluNetwork
from otr.core.tree import ObliqueTree
from otr.errors import TimeLimitError, TreeTooLargeError
from otr.geometry.arrangement import Block, Walk
from otr.geometry.largest_balls import largest_balls
from otr.geometry.rational import Integers
from otr.geometry.regions import chunks_of_leaves, leaf_rows
from otr.proof.certificate import Cell, Certificate, Sum
from otr.proof.exact_cells import as_sum, decide_in
from otr.proof.exact_rows import INFINITE, ExactRow, TreeAndNetwork
from otr.proof.float_cells import start_of_walk, with_smallest_bounds
from otr.proof.verify import Checker, bits, proved_tests

ANY_ERROR = 1e300  # that no proof has
TINY = 1e-100
# By how much of what is enough a side of a neuron, and of a test of the head, may count that is left out, in this order
THIN = ((0.5, 1.0), (0.1, 1.0), (0.0, 1.0), (0.5, 8.0), (0.5, 64.0))


def certificate_of_leads(
    tree: ObliqueTree, network: ReluNetwork, domain: Domain, enough: float, max_regions: int
) -> Certificate:
    """Return a certificate whose error is what `LeadChecker` bounds, of a tree with labels.

    A leaf with a larger error than `enough` in one cell is divided into the network's regions in it, unless these are
    more than `max_regions`, or no better.
    """
    pair, cells = TreeAndNetwork(tree, network, domain), list[Cell]()
    checker, walk = LeadChecker(pair), Walk(network, network.unit_form(), domain, max_regions)
    for leaves in chunks_of_leaves(tree, domain):
        rows, signs = leaf_rows(tree, domain, leaves)
        balls = largest_balls(rows, np.arange(len(leaves)), signs)
        centres = np.clip(domain.unscaled(balls.centres), domain.low, domain.high)
        found: dict[int, list[Cell]] = {}
        for leaf, radius, x, pattern in zip(
            leaves.tolist(), balls.radii.tolist(), centres, network.patterns(centres), strict=True
        ):
            check_time()
            point = decide_in(pair, pair.rows_of_leaf(leaf)) if radius == 0 else ()
            if isinstance(point, tuple):
                found[leaf] = [_cell(pair, leaf, x, pattern)]
            else:
                found[leaf] = [Cell(leaf, "", (), empty=as_sum(point))]
        errors = {leaf: checker.error(cell) for leaf, (cell,) in found.items()}
        start = start_of_walk(leaves, rows, signs, balls)
        for at, leaf in enumerate(start.origin.tolist()):
            for of_neurons, of_tests in THIN:
                if errors[leaf] <= enough:
                    break
                walk.thin[: network.n_hidden] = of_neurons * enough / np.maximum(network.gains(), TINY)
                walk.thin[network.n_hidden :] = of_tests * enough
                divided = _divided(checker, walk, start.take(slice(at, at + 1)), rows.n_rows, errors[leaf])
                if divided is not None:
                    found[leaf], errors[leaf] = divided
        cells += chain(*found.values())
    whole = Certificate(domain, ANY_ERROR, tree.n_leaves, len(cells) * (1 + pair.n_tests), tuple(cells))
    return replace(whole, max_error=checker.run(whole))


class LeadChecker(Checker):
    """A check of cells with labels, by how far other outputs may be above that of the label.

    In a piece where the tests have the outcomes A, the label's output wins a tournament: so that of any other label is
    above it by no more than what the tests fall short of A, and what the outputs are off those of A.
    """

    def _distance(self, cell: Cell, rows: dict[str, ExactRow], turned: list[Integers]) -> Fraction:
        outcomes = bits(cell.outcomes)
        assert self.pair.tree.labels is not None
        if cell.near or self.pair.label(outcomes) != self.pair.tree.labels[cell.leaf]:
            return INFINITE
        n, short = self.pair.network.n_hidden, [Fraction(0)] * self.pair.n_tests
        for test, proof in zip(proved_tests(cell), cell.proofs, strict=True):
            short[test] = max(self.shortfall(cell.leaf, turned[test], proof, rows), Fraction(0))
        errors = self._output_errors(short[:n])
        up, down = max(errors[::2]), max(errors[1::2])
        return sum(short[n:], Fraction(0)) + (up + down if len(errors) > 2 else max(up, down))


def _divided(
    checker: LeadChecker, walk: Walk, start: Block, first: int, error: Fraction
) -> tuple[list[Cell], Fraction] | None:
    """Return the cells of a leaf's regions, and their error; None where it is not below `error`, or they are too many.

    `first` is the row of the network's first test.
    """
    cells, worst = list[Cell](), Fraction(0)
    walk.n_found = 0
    try:
        for block in walk.run(start):
            states, sides = walk.domain.unscaled(block.centres), block.signs[:, first:]
            for leaf, x, outcomes, side in zip(block.origin.tolist(), states, block.outcomes, sides, strict=True):
                cells.append(_cell(checker.pair, leaf, x, outcomes, tuple(np.flatnonzero(side).tolist())))
                worst = max(worst, checker.error(cells[-1]))
                if worst >= error:
                    return None
    except TimeLimitError:
        raise
    except TreeTooLargeError:
        return None
    return cells, worst


def _cell(pair: TreeAndNetwork, leaf: int, x: FloatArray, outcomes: BoolArray, splits: tuple[int, ...] = ()) -> Cell:
    """Return a leaf's cell of outcomes of the neurons, and of the head's tests such that the leaf's label wins at x.

    Of tests that split the leaf the outcomes are those given.
    """
    network, labels = pair.network, pair.tree.labels
    assert labels is not None
    outputs, label, n = network.forward(x), int(labels[leaf]), network.n_hidden
    if network.n_outputs == 1:  # Sign
        outputs = np.array([1.0 if label else -1.0])
    else:
        outputs[label] = outputs.max() + 1 + np.abs(outputs).max()
    all_outcomes = np.append(outcomes[:n], network.head.tests(outputs[None])[0])
    all_outcomes[list(splits)] = outcomes[list(splits)]
    text = "".join("1" if outcome else "0" for outcome in all_outcomes)
    return with_smallest_bounds(pair, Cell(leaf, text, splits, (Sum((), ()),) * (pair.n_tests - len(splits))))[0]
