"""Certificates found: the network's regions inside each leaf's, and multipliers for every branch that is missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from otr.arrangement import Block, Walk
from otr.arrays import FloatArray
from otr.certificate import Cell, Certificate, EmptyLeaf, Sum
from otr.domain import Box, Domain, as_domain
from otr.errors import CertificateError
from otr.linear_programs import Balls, Bases, Rows, largest_balls
from otr.network import ReluNetwork
from otr.regions import leaf_paths, leaf_rows
from otr.tree import ObliqueTree
from otr.verification import verify

__all__ = ["certify"]

_NEGLIGIBLE = 1e-13  # of the largest multiplier


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
    box = as_domain(domain, network.n_inputs)
    _check_fit(tree, network)
    walk = Walk(network, box, tolerance, max_regions, max_seconds)
    rows, signs = leaf_rows(tree, box, np.arange(tree.n_leaves))
    balls = largest_balls(rows, np.arange(tree.n_leaves), signs, Bases.start(tree.n_leaves, box.n_inputs), tolerance)
    names = _row_names(tree, box)
    empty = [
        EmptyLeaf(leaf, _sum(balls.bases, leaf, rows.lengths[leaf], names[leaf]))
        for leaf in np.flatnonzero(balls.is_empty).tolist()
    ]
    blocks = walk.run(_start(rows, signs, balls))
    _check_answers(tree, network, box, blocks, max_error)
    cells, n_programs = [], tree.n_leaves + walk.n_linear_programs
    for block in blocks:
        found, n_solved = _cells(block, names, rows.n_rows, tolerance)
        cells += found
        n_programs += n_solved
    cells.sort(key=lambda cell: (cell.leaf, cell.outcomes))
    draft = Certificate(box, tolerance, exact, max_error, tree.n_leaves, n_programs, tuple(cells), tuple(empty))
    return replace(draft, max_error=verify(draft, tree, network))


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


def _row_names(tree: ObliqueTree, domain: Domain) -> list[list[str]]:
    """Return, for every leaf, the names of its region's rows: the domain's sides and the tests on its path."""
    _, sides = domain.sides()
    return [[*sides, *(f"test {node}" for node in path)] for path in leaf_paths(tree).nodes.tolist()]


def _cells(block: Block, names: list[list[str]], first: int, tolerance: float) -> tuple[list[Cell], int]:
    """Return a block's cells with their proofs, and how many linear programs these took.

    Args:
        block: finished regions.
        names: of the rows that the walk started from, by leaf.
        first: the row of the network's first test.
        tolerance: as in `certify`.
    """
    n, n_tests = block.outcomes.shape
    group = block.rows.of(block.group)
    proofs = np.full((n, n_tests), None, dtype=object)
    n_programs = 0
    for test in range(n_tests):
        row = first + test
        is_flat = ~block.rows.a[group, row].any(axis=1)
        is_fixed = block.signs[:, row] == 0
        for cell in np.flatnonzero(is_fixed & is_flat).tolist():
            proofs[cell, test] = Sum((), ())  # its sign is that of a constant
        asked = np.flatnonzero(is_fixed & ~is_flat)
        signs = block.signs[asked]
        signs[:, row] = np.where(block.outcomes[asked, test], -1, 1)
        other_side = largest_balls(block.rows, block.group[asked], signs, block.bases.take(asked), tolerance)
        n_programs += len(asked)
        for at, cell in enumerate(asked.tolist()):
            lengths = block.rows.lengths[group[cell]]
            proofs[cell, test] = _sum(other_side.bases, at, lengths, names[block.origin[cell]], turned=row)
    cells: list[Cell] = []
    for cell in range(n):
        outcomes = "".join("1" if outcome else "0" for outcome in block.outcomes[cell])
        splits = tuple(np.flatnonzero(block.signs[cell, first:]).tolist())
        fixed = tuple(proof for proof in proofs[cell].tolist() if proof is not None)
        cells.append(Cell(int(block.origin[cell]), outcomes, splits, fixed))
    return cells, n_programs


def _sum(bases: Bases, at: int, lengths: FloatArray, names: list[str], turned: int | None = None) -> Sum:
    """Return the multipliers of a polytope that was found empty, for its rows as they are, not of unit length.

    Args:
        bases: of problems.
        at: the problem.
        lengths: of all rows in its group.
        names: of the first rows; those after them are the network's tests.
        turned: a row that was turned round to find the polytope empty: the sum is then of the others, and such that
            this row, as it stands, is the sum and a remainder.
    """
    rows, multipliers = bases.rows[at], bases.multipliers[at]
    used = np.flatnonzero((rows >= 0) & (multipliers > _NEGLIGIBLE * multipliers.max()))
    weights = {int(rows[i]): float(multipliers[i] / lengths[rows[i]]) for i in used.tolist()}
    if turned is not None:
        scale = weights.pop(turned, 0.0)
        if scale == 0.0:
            return Sum((), ())  # nothing is shown; the remainder's bound will tell
        weights = {row: weight / scale for row, weight in weights.items()}
    chosen = sorted(weights)
    known = len(names)
    return Sum(
        tuple(names[row] if row < known else f"neuron {row - known}" for row in chosen),
        tuple(weights[row] for row in chosen),
    )
