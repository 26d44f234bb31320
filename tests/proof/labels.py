"""Wrong labels, and whether the network's outputs tie near them: decided exactly, at points of every cell."""

from __future__ import annotations

from fractions import Fraction

import otr
from otr.core.domain import as_domain
from otr.geometry.rational import Point
from otr.proof.exact_cells import ExactCell, cells_near, cells_of_leaf, decide, largest_in_cell
from otr.proof.exact_rows import ExactRow, TreeAndNetwork


def wrong_states_far_from_a_tie(
    tree: otr.ObliqueTree, network: otr.ReluNetwork, box: tuple[float, float] | None, distance: Fraction
) -> list[Point]:
    """Return states with a wrong label from which none of the domain is near where that label has the largest output.

    From there to where the network has it lies a tie. States are asked about at a point of every cell and next to where
    each input is largest and smallest.
    """
    pair, found = TreeAndNetwork(tree, network, as_domain(box, network.n_inputs)), []
    for leaf in range(tree.n_leaves):
        label = int(tree.labels[leaf])
        for cell in cells_of_leaf(pair, leaf):
            if pair.label(cell.outcomes) != label:
                found += [
                    point for point in _points(pair, cell) if not has_tie_near(pair, leaf, label, point, distance)
                ]
    return found


def has_tie_near(pair: TreeAndNetwork, leaf: int, label: int, point: Point, distance: Fraction) -> bool:
    """Return whether a label's output is a largest one at a state of the domain no farther from a point."""
    for near in cells_near(pair, leaf, point, distance):
        rows = {name: ExactRow(row.numbers, False) for name, row in near.rows.items()}
        scores = pair.scores(near.forms)
        rows |= {f"score {k}": ExactRow(scores[label] - scores[k], False) for k in range(len(scores)) if k != label}
        if isinstance(decide(rows, pair.network.n_inputs), tuple):
            return True
    return False


def _points(pair: TreeAndNetwork, cell: ExactCell) -> list[Point]:
    sides = [0 * cell.forms[0] for _ in range(2 * pair.network.n_inputs)]
    for i, side in enumerate(sides):
        side[i // 2] = (-1) ** i
    corners = [corner for side in sides for corner in largest_in_cell(pair, cell, side)[0]]
    shares = (Fraction(1, 2**40), Fraction(1, 3))
    return [
        cell.point,
        *(
            tuple(a + (b - a) * share for a, b in zip(corner, cell.point, strict=True))
            for corner in corners
            for share in shares
        ),
    ]
