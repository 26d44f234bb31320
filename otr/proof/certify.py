"""Certificates found: the network's cells inside each leaf's region, and multipliers for every branch that is missing.

The search is in floating point, and what it finds is checked in exact arithmetic. Where it does not hold, or where a
leaf is too thin for floating point, the search is repeated in exact arithmetic (`otr.proof.exact_cells`).

Of a tree that equals the network only roughly, as one with rounded coefficients, a side of a test is first left out
where the states in it change no output by more than `max_error`: their cells would be many slivers. What they do change
counts in the bound; where that is too large, less is left out.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from itertools import chain

import numpy as np

from otr.clock import check_time, time_limit
from otr.core.arrays import FloatArray, IntArray
from otr.core.domain import Box, Domain, as_domain
from otr.core.network import ReluNetwork
from otr.core.tree import ObliqueTree
from otr.errors import CertificateError, TreeTooLargeError
from otr.geometry.arrangement import Block, Walk
from otr.geometry.largest_balls import largest_balls
from otr.geometry.rational import Point, as_point
from otr.geometry.regions import chunks_of_leaves, leaf_rows
from otr.proof.certificate import Cell, Certificate, Sum, check_cover
from otr.proof.exact_cells import (
    ExactCell,
    as_sum,
    counterexample,
    decide_in,
    differs,
    find_cells,
    largest_gap,
    refused_at,
)
from otr.proof.exact_rows import ExactRow, TreeAndNetwork, is_wide, rounded_up
from otr.proof.float_cells import cells_of, empty_sum, row_names, start_of_walk, with_smallest_bounds
from otr.proof.label_cells import near_cell
from otr.proof.verify import NEGLIGIBLE, Checker, bits, rows_of

_MANY_INPUTS = 128  # of which the sides are never rows
_LARGE = 1e100
_INWARDS = 1e-3  # of the way from a corner of a cell to its middle
_SHARES = (1.0, 0.5, 0.2, 0.0)  # of max_error, by which a side of a test may count that is left out, in this order


def certify(
    tree: ObliqueTree,
    network: ReluNetwork,
    domain: Domain | Box | None = None,
    *,
    max_error: float = 1e-6,
    max_regions: int = 2**16,
    max_seconds: float | None = None,
) -> Certificate:
    """Return a proof that `tree` computes the same function as `network`, to `max_error`, at every point of `domain`.

    Args:
        tree: any tree, with the network's numbers of inputs and outputs and its head.
        network: the network.
        domain: a box (low, high) of which any side may be infinite; None is the network's own domain, or all of R^d.
        max_error: refuse a larger bound, as `Certificate.max_error` is defined, on the difference of outputs or, of
            labels, on the distance from where the network has the tree's label.
        max_regions, max_seconds: refuse a longer proof, or to look for longer.

    Raises:
        CertificateError: the two differ; the message names the leaf, a point of it and the answers there. Or, rarely,
            they may be the same and no proof to `max_error` was found, which the message says.
        TreeTooLargeError: a limit was met, of time a TimeLimitError.
        ValueError: the domain or the tree does not fit the network.

    Examples:
        >>> net = otr.ReluNetwork([[[1.0], [-1.0]], [[1.0, 1.0]]], [[0.0, 0.0], [0.0]])  # |x|
        >>> tree = otr.minimal_tree(net, ([-1], [1]))
        >>> otr.certify(tree, net, ([-1], [1])).max_error
        0.0
    """
    if not isinstance(tree, ObliqueTree) or not isinstance(network, ReluNetwork):
        raise TypeError(
            f"certify takes an ObliqueTree and its ReluNetwork, got {type(tree).__name__} and {type(network).__name__}"
        )
    if not 0 <= max_error < np.inf:
        raise ValueError(f"max_error is {max_error}, expected a finite number of at least 0")
    box = as_domain(network.domain if domain is None else domain, network.n_inputs)
    _check_fit(tree, network)
    search = _Certification(tree, network, box, max_error, max_regions, in_box=is_wide(tree, network, box))
    with time_limit(max_seconds, lambda: search.reached()):
        try:
            return search.run()
        except CertificateError as error:
            if error.state is not None or tree.labels is None or not search.pair.in_box or box.n_inputs > _MANY_INPUTS:
                raise
            # States that come to their label only along a side, or a sliver: found where the sides are rows.
            search = _Certification(tree, network, box, max_error, max_regions, in_box=False)
            return search.run()


def _check_fit(tree: ObliqueTree, network: ReluNetwork) -> None:
    ours = (tree.n_inputs, tree.n_outputs, tree.head)
    theirs = (network.n_inputs, network.n_outputs, network.head)
    if ours != theirs:
        raise ValueError(f"the tree has (inputs, outputs, head) {ours}, the network {theirs}; they must be the same")


class _Certification:
    def __init__(
        self,
        tree: ObliqueTree,
        network: ReluNetwork,
        domain: Domain,
        max_error: float,
        max_regions: int,
        *,
        in_box: bool,
    ) -> None:
        pair = self.pair = TreeAndNetwork(tree, network, domain, in_box=in_box)
        self.checker = Checker(pair)
        self.max_error, self.max_regions = Fraction(max_error), max_regions
        self.n_programs = 0
        self.errors: dict[int, Fraction] = {}  # by leaf, of the cells that are kept
        self.walk = Walk(pair.network, pair.network.unit_form(), pair.domain, max_regions)
        # Values of tests that change no output by more than max_error; of labels, which let states be so far away.
        self.allowed, self.allowed_share = np.zeros(self.walk.n_bits), 0.0
        if tree.labels is not None:
            self.allowed_share = max_error / 2
        elif max_error:
            self.allowed[: network.n_hidden] = min(max_error, _LARGE) / np.maximum(network.gains(), 1 / _LARGE)

    def reached(self) -> str:
        """Return the progress of the search, as text."""
        return f"{len(self.errors):,} of {self.pair.tree.n_leaves:,} leaves had cells that are proved"

    def run(self) -> Certificate:
        """Return the certificate."""
        tree, domain = self.pair.tree, self.pair.domain
        cells: list[Cell] = []
        for leaves in chunks_of_leaves(tree, domain, in_box=self.pair.in_box):
            cells += self._cells_of_leaves(leaves)
        self.n_programs += self.walk.n_linear_programs
        cells.sort(key=lambda cell: (cell.leaf, cell.outcomes))
        return Certificate(
            domain,
            rounded_up(max(self.errors.values(), default=Fraction(0))),
            tree.n_leaves,
            self.n_programs,
            tuple(cells),
        )

    def _cells_of_leaves(self, leaves: IntArray) -> list[Cell]:
        """Return the proved cells of some leaves."""
        rows, signs = leaf_rows(self.pair.tree, self.pair.domain, leaves, in_box=self.pair.in_box)
        balls = largest_balls(rows, np.arange(len(leaves)), signs)
        self.n_programs += len(leaves)
        _, sides = self.pair.domain.sides(in_box=self.pair.in_box)
        names = row_names(self.pair.tree, sides, leaves)
        cells: list[Cell] = []
        for at in np.flatnonzero(balls.radii == 0).tolist():
            check_time()
            leaf = int(leaves[at])
            shown = empty_sum(at, balls, rows, names[leaf]) if balls.is_empty[at] else None
            cells += self._cells_of_thin_leaf(leaf, shown)
        start = start_of_walk(leaves, rows, signs, balls)
        for share in _SHARES if self.pair.tree.labels is None else (_SHARES[0], _SHARES[-1]):
            if not len(start.origin):
                break
            self.walk.thin, self.walk.thin_share = share * self.allowed, share * self.allowed_share
            self.walk.n_thin = 0
            found = self._walked(start, names)
            is_last = not self.walk.n_thin  # with a smaller share the cells are the same
            proved = [self._proved(leaf, found[leaf], is_last=is_last) for leaf in start.origin.tolist()]
            cells += chain(*proved)
            start = start.take(np.array([not each for each in proved], dtype=np.bool_))
        return cells

    def _walked(self, start: Block, names: dict[int, list[str]]) -> dict[int, list[Cell]]:
        """Return the cells, by leaf, that a walk in floating point finds in those that have an inner point."""
        by_leaf: dict[int, list[Cell]] = {}
        for block in self.walk.run(start):
            # Labels are compared in wide regions: those of a sliver may differ where the network's tie.
            wide = block.radii > (0 if self.pair.tree.labels is None else 2 * float(self.max_error))
            self._check_answers(self.pair.domain.unscaled(block.centres[wide]))
            has_labels = self.pair.tree.labels is not None
            found, n_solved = cells_of(block, names, start.rows.n_rows, self.pair.domain, has_labels)
            self.n_programs += n_solved
            for cell in found:
                by_leaf.setdefault(cell.leaf, []).append(cell)
        return by_leaf

    def _check_answers(self, X: FloatArray) -> None:
        """Raise CertificateError if tree and network differ at one of some states (n, d): a quick check."""
        tree, network = self.pair.tree, self.pair.network
        if tree.labels is not None:
            suspect = tree.predict(X) != network.predict(X)
        else:
            suspect = np.abs(tree.forward(X) - network.forward(X)).max(axis=1, initial=0.0) > float(self.max_error)
        for x in X[suspect]:
            point = as_point(x)
            leaf = differs(self.pair, point, self.max_error) if self.pair.is_inside(point) else None
            if leaf is not None:
                raise refused_at(self.pair, leaf, point)

    def _cells_of_thin_leaf(self, leaf: int, shown: Sum | None) -> list[Cell]:
        """Return the proof that a leaf's region is empty, that of floating point or another, or the cells in it."""
        if shown is not None:
            cell = Cell(leaf, "", (), empty=shown)
            try:
                self.checker.error(cell)
                return [cell]
            except CertificateError:
                pass  # the sum is off by rounding, or shows no more than that
        of_leaf = self.pair.rows_of_leaf(leaf)
        point = decide_in(self.pair, of_leaf)
        self.n_programs += 1
        if not isinstance(point, tuple):
            return [Cell(leaf, "", (), empty=as_sum(point))]
        return self._exact_cells(leaf, of_leaf, point)

    def _proved(self, leaf: int, cells: list[Cell], *, is_last: bool) -> list[Cell]:
        """Return a leaf's cells with proofs that hold; where these do not, none or, at last, cells found again."""
        proved = []
        for cell in cells:
            check_time()
            better = self._sharp(cell) or (self._closer(cell) if is_last else None)
            if better is None and not is_last:
                self.errors.pop(leaf, None)
                self.walk.n_found -= len(cells)
                return []
            if better is None:
                of_leaf = self.pair.rows_of_leaf(leaf)
                point = decide_in(self.pair, of_leaf)
                assert isinstance(point, tuple)  # the walk had an inner point
                proved = self._exact_cells(leaf, of_leaf, point)
                break
            proved.append(better)
        check_cover(leaf, proved)
        return proved

    def _sharp(self, cell: Cell) -> Cell | None:
        """Return a cell, with the smallest bounds unless its own are negligible; None if these do not do."""
        error, has_labels = self.checker.error(cell), self.pair.tree.labels is not None
        if error > (self.max_error if has_labels else NEGLIGIBLE):
            self.n_programs += 1
            sharp, states = with_smallest_bounds(self.pair, cell)
            of_sharp = self.checker.error(sharp)
            cell, error = (sharp, of_sharp) if of_sharp < error else (cell, error)
            if error > self.max_error and len(states) and not has_labels:
                self._check_answers(states + _INWARDS * (states.mean(axis=0, keepdims=True) - states))
        return cell if self._keep(cell.leaf, error) else None

    def _closer(self, cell: Cell) -> Cell | None:
        """Return a cell as empty, or with bounds of its own on the differences in it; None if these do not do."""
        pair, outcomes = self.pair, tuple(bits(cell.outcomes))
        rows = rows_of(pair, cell, pair.turned(outcomes))
        point = decide_in(pair, rows)
        self.n_programs += 1
        if not isinstance(point, tuple):
            if not cell.splits:
                return None
            return Cell(cell.leaf, cell.outcomes[: cell.splits[-1] + 1], cell.splits, empty=as_sum(point))
        forms = pair.forms(outcomes[: pair.network.n_hidden])
        bounded = self._bounded(cell, ExactCell(cell.leaf, outcomes, rows, {}, point, forms))
        return bounded if self._is_proved(bounded) else None

    def _is_proved(self, cell: Cell) -> bool:
        return self._keep(cell.leaf, self.checker.error(cell))

    def _keep(self, leaf: int, error: Fraction) -> bool:
        """Return whether the bound on the difference in a cell of a leaf is small enough, and keep it if so."""
        if error > self.max_error:
            return False
        self.errors[leaf] = max(self.errors.get(leaf, error), error)
        return True

    def _bounded(self, cell: Cell, exact: ExactCell) -> Cell:
        """Return a cell with what rational programs find: bounds of its own, of labels a piece that it is near to."""
        if self.pair.tree.labels is not None:
            return near_cell(self.checker, cell, exact, self.max_error)
        gaps = largest_gap(self.pair, exact)
        self.n_programs += len(gaps)
        return replace(cell, bounds=tuple(as_sum(multipliers) for _, multipliers in gaps))

    def _exact_cells(self, leaf: int, rows: dict[str, ExactRow], point: Point) -> list[Cell]:
        """Return the cells of a leaf's region, in exact arithmetic; raise CertificateError if one differs."""
        cells: list[Cell] = []
        self.errors.pop(leaf, None)  # of cells that these replace
        for exact in find_cells(self.pair, leaf, rows, point):
            self.n_programs += len(exact.outcomes)
            self._check_limits(len(cells))
            splits = tuple(test for test in range(len(exact.outcomes)) if test not in exact.proofs)
            proofs = tuple(as_sum(exact.proofs[test]) for test in sorted(exact.proofs))
            cell = Cell(leaf, "".join("1" if outcome else "0" for outcome in exact.outcomes), splits, proofs)
            if not self._is_proved(cell) and not self._is_proved(cell := self._bounded(cell, exact)):
                found = counterexample(self.pair, exact, self.max_error)
                if found is not None:
                    raise refused_at(self.pair, leaf, found)
                raise CertificateError(
                    f"leaf {leaf}: tree and network may differ by {rounded_up(self.checker.error(cell)):.3g} where the "
                    f"neurons are {cell.outcomes!r}; they may well be the same function, but no proof to "
                    f"{float(self.max_error):g} was found: a larger max_error or a smaller box may do",
                    leaf,
                )
            cells.append(cell)
        return cells

    def _check_limits(self, n_cells: int) -> None:
        check_time()
        if n_cells > self.max_regions:
            raise TreeTooLargeError(
                f"the limit of {self.max_regions:,} regions was met among the cells of one leaf; raise the limit, or "
                "give a smaller domain"
            )
