"""The cells that a walk in floating point finds inside leaves' regions, and multipliers for the branches it left out.

What is found here is a proposal: `otr.proof.certify` checks every cell in exact arithmetic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import FloatArray, IntArray
from otr.core.domain import Domain
from otr.core.half_spaces import HalfSpaces
from otr.core.tree import ObliqueTree
from otr.geometry.arrangement import Block
from otr.geometry.largest_balls import Balls, largest_balls
from otr.geometry.rational_linear_programs import near_largest
from otr.geometry.regions import leaf_paths
from otr.proof.certificate import Cell, Sum
from otr.proof.exact_rows import TreeAndNetwork
from otr.proof.verify import bits, rows_of

_NEGLIGIBLE = 1e-13  # of the largest multiplier
_DIGITS = (3, 6)  # of multipliers, tried in this order
_CLEAR = 1e-9  # of a row of unit length: a remainder above it shows the sign beyond rounding


def start_of_walk(leaves: IntArray, rows: HalfSpaces, signs: NDArray[np.int8], balls: Balls) -> Block:
    """Return the regions of those of the leaves (n,) that have an inner point, as the start of a walk."""
    at = np.flatnonzero(balls.radii > 0)
    return Block(
        leaves[at],
        np.zeros((len(at), 0), dtype=np.bool_),
        signs[at],
        np.arange(len(at)),
        rows.take(at),
        balls.centres[at],
        balls.radii[at],
        balls.bases.take(at),
    )


def empty_sum(at: int, balls: Balls, rows: HalfSpaces, names: list[str]) -> Sum:
    """Return the sum that showed in floating point that a leaf's region, of the rows of group `at`, is empty."""
    basis, multipliers = balls.bases.rows[at], balls.bases.multipliers[at]
    used = (basis >= 0) & (multipliers > _NEGLIGIBLE * multipliers.max())
    weights = np.where(used, multipliers / rows.lengths[at, np.where(used, basis, 0)], 0.0)
    return _named_sum(basis.tolist(), weights.tolist(), names)


def row_names(tree: ObliqueTree, sides: Sequence[str], leaves: IntArray) -> dict[int, list[str]]:
    """Return, by leaf, the names of its region's rows: the domain's sides and the tests on its path."""
    paths = zip(leaves.tolist(), leaf_paths(tree)[0][leaves].tolist(), strict=True)
    return {leaf: [*sides, *(f"test {node}" for node in path)] for leaf, path in paths}


def cells_of(
    block: Block, names: dict[int, list[str]], first: int, domain: Domain, has_labels: bool
) -> tuple[list[Cell], int]:
    """Return the cells of a finished block with their proofs, and how many linear programs these took.

    `names` are those of the rows that the walk started from, by leaf; `first` is the row of the network's first test.
    Of labels, states just beyond a piece of the network come to it towards the cell's inner point.
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
            proofs[cell, test] = _named_sum(rows, weights, names[int(block.origin[cell])])
    cells, centres = [], domain.unscaled(block.centres)
    for cell in range(n):
        outcomes = "".join("1" if outcome else "0" for outcome in block.outcomes[cell])
        splits = tuple(np.flatnonzero(block.signs[cell, first:]).tolist())
        fixed = tuple(proof for proof in proofs[cell].tolist() if proof is not None)
        towards = (*centres[cell].tolist(), 1.0) if has_labels else ()
        cells.append(Cell(int(block.origin[cell]), outcomes, splits, fixed, towards=towards))
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


def with_smallest_bounds(pair: TreeAndNetwork, cell: Cell) -> tuple[Cell, FloatArray]:
    """Return a cell with the sums that bound its tests and differences best, and states (n, d) where these are largest.

    Where no sums are found it is the cell as it was, and no states.
    """
    outcomes = bits(cell.outcomes)
    turned = pair.turned(outcomes)
    implied = set(pair.sides).difference(pair.domain.sides(in_box=True)[1])  # by the limits
    rows = {name: row for name, row in rows_of(pair, cell, turned).items() if name not in implied}
    tests = [-form for test, form in enumerate(turned) if test not in cell.splits]
    differences = np.empty((0, pair.n_coordinates + 1), dtype=object)
    if pair.tree.labels is None:
        differences = pair.differences(cell.leaf, pair.forms(outcomes[: pair.network.n_hidden]), outcomes)
    forms = [*tests, *differences, *-differences]
    found = near_largest(pair.stacked(rows), pair.written_out(np.array(forms))[0], pair.two_limits) if forms else None
    if found is None:
        return cell, np.empty((0, pair.domain.n_inputs))
    names, n, (states, multipliers) = list(rows), len(tests), found
    sums = [Sum(tuple(names[row] for row in each), tuple(each.values())) for each in multipliers]
    both = zip(sums[n : n + len(differences)], sums[n + len(differences) :], strict=True)
    return replace(cell, proofs=tuple(sums[:n]), bounds=tuple(chain(*both))), states


def _significant(values: FloatArray, digits: int) -> FloatArray:
    """Return numbers of at least 0 with so many significant digits."""
    with np.errstate(divide="ignore"):
        scale = 10.0 ** (digits - 1 - np.floor(np.log10(np.where(values > 0, values, 1.0))))
    return np.asarray(np.round(values * scale) / scale)


def _named_sum(rows: list[int], multipliers: list[float], names: list[str]) -> Sum:
    """Return a sum of rows, those after the names being the network's tests; each is named once."""
    total: dict[str, float] = {}
    for row, multiplier in sorted(zip(rows, multipliers, strict=True)):
        if multiplier > 0:
            name = names[row] if row < len(names) else f"neuron {row - len(names)}"
            total[name] = total.get(name, 0.0) + multiplier
    return Sum(tuple(total), tuple(total.values()))
