"""Certificates found: the network's regions inside each leaf's, and multipliers for every branch that is missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from otr.arrangement import Block, Walk
from otr.arrays import FloatArray, IntArray
from otr.certificate import Cell, Certificate, EmptyLeaf, Sum
from otr.domain import Box, Domain, as_domain
from otr.errors import CertificateError
from otr.linear_programs import Balls, Bases, Rows, largest_balls
from otr.network import ReluNetwork
from otr.regions import leaf_paths, leaf_rows
from otr.tree import ObliqueTree
from otr.verification import LARGEST_TOLERANCE, verify

__all__ = ["certify"]

_NEGLIGIBLE = 1e-13  # of the largest multiplier
_DIGITS = (3, 6)  # of multipliers, tried in this order
_CLEAR = 1e-9  # of a row of unit length: a remainder above it shows the sign beyond rounding


def certify(
    tree: ObliqueTree,
    network: ReluNetwork,
    domain: Domain | Box | None = None,
    *,
    exact: bool = False,
    max_error: float = 1e-6,
    tolerance: float = 1e-9,
    max_regions: int = 2**16,
    max_seconds: float | None = None,
) -> Certificate:
    """Return a proof that `tree` computes the same function as `network` on `domain`.

    Args:
        tree: any tree, with the network's numbers of inputs and outputs and its head.
        network: the network.
        domain: all of R^d if None, or a box (low, high) of which any side may be infinite.
        exact: bound the error in rational arithmetic.
        max_error: refuse a larger bound on the difference of outputs.
        tolerance: as in `otr.minimal_tree`.
        max_regions, max_seconds: refuse a longer proof, or to look for longer.

    Raises:
        CertificateError: the two differ; the message names the leaf, a state in it and the difference.
        TreeTooLargeError: a limit was met.
        ValueError: the domain or the tree does not fit the network.
    """
    if not isinstance(tree, ObliqueTree) or not isinstance(network, ReluNetwork):
        raise TypeError(
            f"certify takes an ObliqueTree and its ReluNetwork, got {type(tree).__name__} and {type(network).__name__}"
        )
    if not 0 <= tolerance <= LARGEST_TOLERANCE:
        raise ValueError(f"tolerance is {tolerance}, expected a radius from 0 to {LARGEST_TOLERANCE}")
    box = as_domain(domain, network.n_inputs)
    _check_fit(tree, network)
    walk = Walk(network, box, tolerance, max_regions, max_seconds)
    rows, signs = leaf_rows(tree, box, np.arange(tree.n_leaves))
    balls = largest_balls(rows, np.arange(tree.n_leaves), signs, Bases.start(tree.n_leaves, box.n_inputs), tolerance)
    names = _row_names(tree, box)
    empty = [_empty_leaf(leaf, balls, rows, names) for leaf in np.flatnonzero(balls.is_empty).tolist()]
    blocks = walk.run(_start(rows, signs, balls))
    _check_answers(tree, network, box, blocks, max_error)
    cells, n_programs = [], tree.n_leaves + walk.n_linear_programs
    for block in blocks:
        found, n_solved = _cells(block, names, rows.n_rows, box, tolerance)
        cells += found
        n_programs += n_solved
    cells.sort(key=lambda cell: (cell.leaf, cell.outcomes))
    draft = Certificate(box, tolerance, exact, max_error, tree.n_leaves, n_programs, tuple(cells), tuple(empty))
    try:
        return replace(draft, max_error=verify(draft, tree, network))
    except CertificateError as error:
        raise CertificateError(
            f"{error}\nthe two may well be the same function, but no proof to {max_error:g} was found; a smaller "
            "tolerance, a larger max_error or a smaller box may do"
        ) from error


def _check_fit(tree: ObliqueTree, network: ReluNetwork) -> None:
    ours = (tree.n_inputs, tree.n_outputs, tree.head)
    theirs = (network.n_inputs, network.n_outputs, network.head)
    if ours != theirs:
        raise ValueError(f"the tree has (inputs, outputs, head) {ours}, the network {theirs}; they must be the same")


def _start(rows: Rows, signs: NDArray[np.int8], balls: Balls) -> Block:
    """Return the regions of the leaves that have an inside, as the start of a walk."""
    leaves = np.flatnonzero(~balls.is_empty)
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


def _check_answers(
    tree: ObliqueTree, network: ReluNetwork, domain: Domain, blocks: list[Block], max_error: float
) -> None:
    """Raise CertificateError if tree and network differ at an inner point of a region: the quick way to see it."""
    for block in blocks:
        X = domain.unscaled(block.centres)
        ours, theirs = tree.predict(X), network.predict(X)
        if tree.labels is not None:
            wrong = np.flatnonzero(ours != theirs)
        else:
            gap = np.abs(tree.forward(X) - network.forward(X)).max(axis=1)
            wrong = np.flatnonzero(gap > max_error * (1 + 1e-9) + 1e-9 * np.abs(network.forward(X)).max(axis=1))
        if wrong.size:
            i = int(wrong[0])
            raise CertificateError(
                f"leaf {block.origin[i]}: at the state {X[i].tolist()} the tree answers {np.asarray(ours[i]).tolist()} "
                f"and the network {np.asarray(theirs[i]).tolist()}; they are not the same function"
            )


def _empty_leaf(leaf: int, balls: Balls, rows: Rows, names: list[list[str]]) -> EmptyLeaf:
    """Return the proof that a leaf's region, of the rows of group `leaf`, has no inside."""
    basis, multipliers = balls.bases.rows[leaf], balls.bases.multipliers[leaf]
    used = (basis >= 0) & (multipliers > _NEGLIGIBLE * multipliers.max())
    weights = np.where(used, multipliers / rows.lengths[leaf, np.where(used, basis, 0)], 0.0)
    return EmptyLeaf(leaf, _named_sum(basis.tolist(), weights.tolist(), names[leaf]))


def _row_names(tree: ObliqueTree, domain: Domain) -> list[list[str]]:
    """Return, for every leaf, the names of its region's rows: the domain's sides and the tests on its path."""
    _, sides = domain.sides()
    return [[*sides, *(f"test {node}" for node in path)] for path in leaf_paths(tree).nodes.tolist()]


def _cells(
    block: Block, names: list[list[str]], first: int, domain: Domain, tolerance: float
) -> tuple[list[Cell], int]:
    """Return a block's cells with their proofs, and how many linear programs these took.

    Args:
        block: finished regions.
        names: of the rows that the walk started from, by leaf.
        first: the row of the network's first test.
        domain, tolerance: as in `certify`.
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
        basis, multipliers = _multipliers(block, asked, row, test, domain, tolerance)
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
    block: Block, cells: IntArray, row: int, test: int, domain: Domain, tolerance: float
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
    balls = largest_balls(rows, block.group[cells], signs, block.bases.take(cells), tolerance)
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
