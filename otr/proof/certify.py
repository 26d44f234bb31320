"""Certificates found: the network's cells inside each leaf's region, and multipliers for every branch that is missing.

The search is in floating point, and what it finds is checked in exact arithmetic. Where it does not hold, or where a
leaf is too thin for floating point, the search is repeated in exact arithmetic (`otr.proof.exact_cells`).
"""

from __future__ import annotations

import time
from dataclasses import replace
from fractions import Fraction
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import FloatArray, IntArray
from otr.core.domain import Box, Domain, as_domain
from otr.core.half_spaces import HalfSpaces
from otr.core.network import ReluNetwork
from otr.core.tree import ObliqueTree
from otr.errors import CertificateError, TreeTooLargeError
from otr.geometry.arrangement import Block, Walk
from otr.geometry.largest_balls import Balls, largest_balls
from otr.geometry.rational import Point, as_point
from otr.geometry.regions import leaf_paths, leaf_rows
from otr.geometry.simplex import Bases
from otr.proof.certificate import Cell, Certificate, Sum
from otr.proof.exact_cells import ExactCell, Multipliers, counterexample, decide, find_cells, largest_gap, refused_at
from otr.proof.statement import Row, Statement
from otr.proof.verify import Checker, check_cover, rounded_up

__all__ = ["certify"]

_NEGLIGIBLE = 1e-13  # of the largest multiplier
_DIGITS = (3, 6)  # of multipliers, tried in this order
_CLEAR = 1e-9  # of a row of unit length: a remainder above it shows the sign beyond rounding


def certify(
    tree: ObliqueTree,
    network: ReluNetwork,
    domain: Domain | Box | None = None,
    *,
    exact: Literal[True] = True,
    max_error: float = 1e-6,
    max_regions: int = 2**16,
    max_seconds: float | None = None,
) -> Certificate:
    """Return a proof that `tree` computes the same function as `network` at every real point of `domain`.

    Args:
        tree: any tree, with the network's numbers of inputs and outputs and its head.
        network: the network.
        domain: a box (low, high) of which any side may be infinite; None is the network's own domain, or all of R^d.
        exact: every certificate is found and checked in exact arithmetic; accepted for those who ask for it.
        max_error: refuse a larger bound on the difference of outputs.
        max_regions, max_seconds: refuse a longer proof, or to look for longer.

    Raises:
        CertificateError: the two differ; the message names the leaf, a point of it and the answers there. Or, rarely,
            they may be the same and no proof to `max_error` was found, which the message says.
        TreeTooLargeError: a limit was met.
        ValueError: the domain or the tree does not fit the network.
    """
    if not isinstance(tree, ObliqueTree) or not isinstance(network, ReluNetwork):
        raise TypeError(
            f"certify takes an ObliqueTree and its ReluNetwork, got {type(tree).__name__} and {type(network).__name__}"
        )
    if exact is not True:
        raise ValueError(f"exact is {exact!r}; every certificate is in exact arithmetic, leave the argument out")
    if not 0 <= max_error < np.inf:
        raise ValueError(f"max_error is {max_error}, expected a finite number of at least 0")
    box = as_domain(network.domain if domain is None else domain, network.n_inputs)
    _check_fit(tree, network)
    search = _Search(Statement(tree, network, box), max_error, max_regions, max_seconds)
    return search.run()


def _check_fit(tree: ObliqueTree, network: ReluNetwork) -> None:
    ours = (tree.n_inputs, tree.n_outputs, tree.head)
    theirs = (network.n_inputs, network.n_outputs, network.head)
    if ours != theirs:
        raise ValueError(f"the tree has (inputs, outputs, head) {ours}, the network {theirs}; they must be the same")


class _Search:
    def __init__(self, statement: Statement, max_error: float, max_regions: int, max_seconds: float | None) -> None:
        self.statement, self.checker = statement, Checker(statement)
        self.max_error, self.max_regions, self.max_seconds = Fraction(max_error), max_regions, max_seconds
        self.n_programs = 0
        self.worst = Fraction(0)
        self.began = time.monotonic()

    def run(self) -> Certificate:
        """Return the certificate."""
        tree, domain = self.statement.tree, self.statement.domain
        rows, signs = leaf_rows(tree, domain, np.arange(tree.n_leaves))
        balls = largest_balls(rows, np.arange(tree.n_leaves), signs, Bases.start(tree.n_leaves, domain.n_inputs))
        self.n_programs += tree.n_leaves
        names = _row_names(tree, domain)
        cells: list[Cell] = []
        for leaf in np.flatnonzero(balls.radii == 0).tolist():
            cells += self._cells_of_thin_leaf(leaf, balls, rows, names[leaf])
        for leaf, found in self._walked(rows, signs, balls, names).items():
            cells += self._proved(leaf, found)
        cells.sort(key=lambda cell: (cell.leaf, cell.outcomes))
        return Certificate(domain, rounded_up(self.worst), tree.n_leaves, self.n_programs, tuple(cells))

    def _walked(
        self, rows: HalfSpaces, signs: NDArray[np.int8], balls: Balls, names: list[list[str]]
    ) -> dict[int, list[Cell]]:
        """Return the cells, by leaf, that a walk in floating point finds in those that have an inner point."""
        network, domain = self.statement.network, self.statement.domain
        walk = Walk(network, network.unit_form(), domain, self.max_regions, self.max_seconds)
        by_leaf: dict[int, list[Cell]] = {}
        for block in walk.run(_start(rows, signs, balls)):
            self._check_answers(block)
            found, n_solved = _cells(block, names, rows.n_rows, domain)
            self.n_programs += n_solved
            for cell in found:
                by_leaf.setdefault(cell.leaf, []).append(cell)
        self.n_programs += walk.n_linear_programs
        return by_leaf

    def _check_answers(self, block: Block) -> None:
        """Raise CertificateError if tree and network differ at an inner point of a region: the quick way to see it."""
        tree, network = self.statement.tree, self.statement.network
        X = self.statement.domain.unscaled(block.centres)[block.radii > 0]
        if tree.labels is not None:
            suspect = tree.predict(X) != network.predict(X)
        else:
            suspect = np.abs(tree.forward(X) - network.forward(X)).max(axis=1, initial=0.0) > float(self.max_error)
        for x in X[suspect]:
            point = as_point(x)
            leaf, gap = self.statement.gap(point)
            if self.statement.is_inside(point) and gap > self.max_error * self.statement.unit_at(point):
                raise refused_at(self.statement, leaf, point)

    def _cells_of_thin_leaf(self, leaf: int, balls: Balls, rows: HalfSpaces, names: list[str]) -> list[Cell]:
        """Return the proof that a leaf's region is empty, or the cells in it, found in exact arithmetic."""
        if balls.is_empty[leaf]:
            cell = Cell(leaf, "", (), empty=_empty_sum(leaf, balls, rows, names))
            try:
                self.checker.error(cell)
                return [cell]
            except CertificateError:
                pass  # the sum is off by rounding, or shows no more than that
        of_leaf = self.statement.rows_of_leaf(leaf)
        point = decide(of_leaf, self.statement.network.n_inputs)
        self.n_programs += 1
        if not isinstance(point, tuple):
            return [Cell(leaf, "", (), empty=_as_sum(point))]
        return self._exact_cells(leaf, of_leaf, point)

    def _proved(self, leaf: int, cells: list[Cell]) -> list[Cell]:
        """Return a leaf's cells with proofs that hold, found again where these do not."""
        proved = []
        for cell in cells:
            better = cell if self._is_proved(cell) else self._closer(cell)
            if better is None:
                of_leaf = self.statement.rows_of_leaf(leaf)
                point = decide(of_leaf, self.statement.network.n_inputs)
                assert isinstance(point, tuple)  # the walk had an inner point
                proved = self._exact_cells(leaf, of_leaf, point)
                break
            proved.append(better)
        check_cover(leaf, proved)
        return proved

    def _closer(self, cell: Cell) -> Cell | None:
        """Return a cell as empty, or with bounds of its own on the differences in it; None if these do not do."""
        statement, n = self.statement, self.statement.network.n_hidden
        outcomes = tuple(outcome == "1" for outcome in cell.outcomes)
        forms = statement.forms(outcomes[:n])
        tests = [*forms[:n], *statement.head_tests(forms, outcomes)]
        rows = statement.rows_of_leaf(cell.leaf)
        for split in cell.splits:
            rows[f"neuron {split}"] = Row(tests[split] if outcomes[split] else -tests[split], outcomes[split])
        point = decide(rows, statement.network.n_inputs)
        self.n_programs += 1
        if not isinstance(point, tuple):
            if not cell.splits:
                return None
            return Cell(cell.leaf, cell.outcomes[: cell.splits[-1] + 1], cell.splits, empty=_as_sum(point))
        bounded = self._bounded(cell, ExactCell(cell.leaf, outcomes, rows, {}, point, forms))
        return bounded if self._is_proved(bounded) else None

    def _is_proved(self, cell: Cell) -> bool:
        """Return whether the bound on the difference in a cell is small enough, and keep it if so."""
        error = self.checker.error(cell)
        if error > self.max_error:
            return False
        self.worst = max(self.worst, error)
        return True

    def _bounded(self, cell: Cell, exact: ExactCell) -> Cell:
        """Return a cell with the bounds of its own that rational programs find."""
        gaps = largest_gap(self.statement, exact)
        self.n_programs += len(gaps)
        return replace(cell, bounds=tuple(_as_sum(multipliers) for _, multipliers in gaps))

    def _exact_cells(self, leaf: int, rows: dict[str, Row], point: Point) -> list[Cell]:
        """Return the cells of a leaf's region, in exact arithmetic.

        Raises:
            CertificateError: tree and network differ in one of them.
        """
        cells: list[Cell] = []
        for exact in find_cells(self.statement, leaf, rows, point):
            self.n_programs += len(exact.outcomes)
            self._check_limits(len(cells))
            splits = tuple(test for test in range(len(exact.outcomes)) if test not in exact.proofs)
            proofs = tuple(_as_sum(exact.proofs[test]) for test in sorted(exact.proofs))
            cell = Cell(leaf, "".join("1" if outcome else "0" for outcome in exact.outcomes), splits, proofs)
            if not self._is_proved(cell) and not self._is_proved(cell := self._bounded(cell, exact)):
                found = counterexample(self.statement, exact, self.max_error)
                if found is not None:
                    raise refused_at(self.statement, leaf, found)
                raise CertificateError(
                    f"leaf {leaf}: tree and network may differ by {rounded_up(self.checker.error(cell)):.3g} where the "
                    f"neurons are {cell.outcomes!r}; they may well be the same function, but no proof to "
                    f"{float(self.max_error):g} was found: a larger max_error or a smaller box may do",
                    leaf,
                )
            cells.append(cell)
        return cells

    def _check_limits(self, n_cells: int) -> None:
        seconds = time.monotonic() - self.began
        if n_cells > self.max_regions or (self.max_seconds is not None and seconds > self.max_seconds):
            limit = f"{self.max_regions:,} regions" if n_cells > self.max_regions else f"{self.max_seconds:g} s"
            raise TreeTooLargeError(
                f"the limit of {limit} was met after {seconds:.1f} s among the cells of one leaf; raise max_regions or "
                "max_seconds, or give a smaller domain"
            )


def _as_sum(multipliers: Multipliers) -> Sum:
    return Sum(tuple(multipliers), tuple(multipliers.values()))


def _start(rows: HalfSpaces, signs: NDArray[np.int8], balls: Balls) -> Block:
    """Return the regions of the leaves that have an inner point, as the start of a walk."""
    leaves = np.flatnonzero(balls.radii > 0)
    return Block(
        leaves,
        np.zeros((len(leaves), 0), dtype=np.bool_),
        signs[leaves],
        np.arange(len(leaves)),
        rows.take(leaves),
        balls.centres[leaves],
        balls.radii[leaves],
        balls.bases.take(leaves),
    )


def _empty_sum(leaf: int, balls: Balls, rows: HalfSpaces, names: list[str]) -> Sum:
    """Return the sum that showed in floating point that a leaf's region, of the rows of group `leaf`, is empty."""
    basis, multipliers = balls.bases.rows[leaf], balls.bases.multipliers[leaf]
    used = (basis >= 0) & (multipliers > _NEGLIGIBLE * multipliers.max())
    weights = np.where(used, multipliers / rows.lengths[leaf, np.where(used, basis, 0)], 0.0)
    return _named_sum(basis.tolist(), weights.tolist(), names)


def _row_names(tree: ObliqueTree, domain: Domain) -> list[list[str]]:
    """Return, for every leaf, the names of its region's rows: the domain's sides and the tests on its path."""
    _, sides = domain.sides()
    return [[*sides, *(f"test {node}" for node in path)] for path in leaf_paths(tree).nodes.tolist()]


def _cells(block: Block, names: list[list[str]], first: int, domain: Domain) -> tuple[list[Cell], int]:
    """Return a block's cells with their proofs, and how many linear programs these took.

    Args:
        block: finished regions.
        names: of the rows that the walk started from, by leaf.
        first: the row of the network's first test.
        domain: as in `certify`.
    """
    n, n_tests = block.outcomes.shape
    group = block.rows.of(block.group)
    proofs = np.full((n, n_tests), None, dtype=object)
    n_programs = 0
    for test in range(n_tests):
        row = first + test
        is_constant = domain.reach(block.rows.a[group, row]) < np.abs(block.rows.b[group, row])
        is_fixed = block.signs[:, row] == 0
        for cell in np.flatnonzero(is_fixed & is_constant).tolist():
            proofs[cell, test] = Sum((), ())  # the remainder is all of it
        asked = np.flatnonzero(is_fixed & ~is_constant)
        basis, multipliers = _multipliers(block, asked, row, test, domain)
        n_programs += len(asked)
        for cell, rows, weights in zip(asked.tolist(), basis.tolist(), multipliers.tolist(), strict=True):
            proofs[cell, test] = _named_sum(rows, weights, names[block.origin[cell]])
    cells = []
    for cell in range(n):
        outcomes = "".join("1" if outcome else "0" for outcome in block.outcomes[cell])
        splits = tuple(np.flatnonzero(block.signs[cell, first:]).tolist())
        fixed = tuple(proof for proof in proofs[cell].tolist() if proof is not None)
        cells.append(Cell(int(block.origin[cell]), outcomes, splits, fixed))
    return cells, n_programs


def _multipliers(
    block: Block, cells: IntArray, row: int, test: int, domain: Domain
) -> tuple[NDArray[np.int16], FloatArray]:
    """Return rows (n, q) and multipliers (n, q), of the rows as they are, of sums that a test is at least.

    They come from turning the test round: the region is then empty. Multipliers are rounded where what remains is
    clear or no worse, as in a row that is the test itself, for the sake of those who read or store them; places without
    a row have a multiplier of 0.
    """
    rows, group = block.rows, block.rows.of(block.group)[cells]
    near = np.where(block.outcomes[cells, test], 1.0, -1.0)
    signs = block.signs[cells]
    signs[:, row] = -near
    balls = largest_balls(rows, block.group[cells], signs, block.bases.take(cells), row)
    basis, found = balls.bases.rows, balls.bases.multipliers
    of_row = np.where(basis == row, found, 0.0).sum(axis=1, keepdims=True)
    used = (basis >= 0) & (basis != row) & (found > _NEGLIGIBLE * found.max(axis=1, keepdims=True)) & (of_row > 0)
    at = np.where(used, basis, 0).astype(np.int64)
    lengths = rows.lengths[group[:, None], at] / rows.lengths[group, row, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        multipliers = np.where(used, found / of_row / lengths, 0.0)
    forms = np.concatenate((rows.a[group[:, None], at], rows.b[group[:, None], at][..., None]), axis=2)
    forms *= np.take_along_axis(signs, at, axis=1)[..., None]
    whole = near[:, None] * np.column_stack((rows.a[group, row], rows.b[group, row]))

    def lowest(weights: FloatArray) -> FloatArray:
        remainder = whole - np.einsum("nq,nqd->nd", weights * lengths, forms)
        return np.asarray(remainder[:, -1] - domain.reach(remainder[:, :-1]))

    as_found = multipliers
    for digits in reversed(_DIGITS):
        few = _significant(as_found, digits)
        left = lowest(few)
        enough = np.isfinite(left) & (left >= np.minimum(_CLEAR, lowest(as_found)))
        multipliers = np.where(enough[:, None], few, multipliers)
    return basis, multipliers


def _significant(values: FloatArray, digits: int) -> FloatArray:
    """Return numbers of at least 0 with so many significant digits."""
    with np.errstate(divide="ignore"):
        scale = 10.0 ** (digits - 1 - np.floor(np.log10(np.where(values > 0, values, 1.0))))
    return np.asarray(np.round(values * scale) / scale)


def _named_sum(rows: list[int], multipliers: list[float], names: list[str]) -> Sum:
    """Return a sum of rows, those after the names being the network's tests."""
    chosen = sorted((row, multiplier) for row, multiplier in zip(rows, multipliers, strict=True) if multiplier > 0)
    known = len(names)
    return Sum(
        tuple(names[row] if row < known else f"neuron {row - known}" for row, _ in chosen),
        tuple(multiplier for _, multiplier in chosen),
    )
