"""Questions about a tree on a box, answered exactly: the range of its actions, and whether a linear condition holds.

Each leaf's region is a polytope and its outputs are affine there, so every question is a linear program a leaf. A head
that clips is affine in pieces; tanh is bounded by lines, and a piece is cut in two where these are too loose
(branch and bound).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from otr.arrays import FloatArray, IntArray
from otr.branch_and_bound import Condition, Search, Verdict
from otr.domain import Box, Domain, as_domain
from otr.linear_programs import Bases, Rows, largest_balls, largest_values
from otr.regions import leaf_rows
from otr.tree import ObliqueTree

__all__ = ["Condition", "OutputRange", "Verdict", "check_verdict", "find_violation", "output_range", "reachable_labels"]

_MAX_PIECES = 2**17


@dataclass(frozen=True)
class OutputRange:
    """The smallest and the largest value of every action on a box, and a state where it is taken, or on whose brink.

    Attributes:
        low, high: (o,) actions.
        low_states, high_states: (o, d).
    """

    low: FloatArray
    high: FloatArray
    low_states: FloatArray
    high_states: FloatArray


def output_range(tree: ObliqueTree, box: Box | Domain, *, tolerance: float = 1e-9) -> OutputRange:
    """Return the exact minimum and maximum of every action over a box, to the accuracy of a linear program.

    Regions are closed: where the tree jumps at a test, the value on either side counts. Leaves into which no ball of a
    radius above `tolerance` fits, in the box's scale, do not.

    Raises:
        ValueError: the box is unbounded, the head multiplies outputs, or the tree has labels (then `reachable_labels`
            tells).
    """
    _require_known_head(tree)
    if tree.labels is not None:
        raise ValueError("the tree answers with labels, which have no range; use reachable_labels(tree, box)")
    domain = _bounded(tree, box)
    leaves, rows, signs = _reached(tree, domain, tolerance)
    n, o = len(leaves), tree.n_outputs
    forms = domain.scaled(np.concatenate((tree.M[leaves], tree.c[leaves][:, :, None]), axis=2))
    objectives = np.concatenate((-forms, forms), axis=1).reshape(n * 2 * o, -1)
    best = largest_values(rows, np.repeat(np.arange(n), 2 * o), np.repeat(signs, 2 * o, axis=0), objectives)
    values = best.values.reshape(n, 2 * o)
    at = values.argmax(axis=0)
    states = np.clip(domain.unscaled(best.states), domain.low, domain.high)
    states = states.reshape(n, 2 * o, -1)[at, np.arange(2 * o)]
    low, high = (np.asarray(tree.head(y)) for y in (-values.max(axis=0)[:o], values.max(axis=0)[o:]))
    return OutputRange(low, high, states[:o], states[o:])


def reachable_labels(tree: ObliqueTree, box: Box | Domain | None = None, *, tolerance: float = 1e-9) -> IntArray:
    """Return the labels of the leaves whose regions have an inside in a box, ascending.

    Raises:
        ValueError: the tree has no labels.
    """
    if tree.labels is None:
        raise ValueError("the tree has no labels; use output_range(tree, box)")
    leaves, _, _ = _reached(tree, as_domain(box, tree.n_inputs), tolerance)
    return np.unique(tree.labels[leaves])


def find_violation(
    tree: ObliqueTree,
    condition: Condition,
    box: Box | Domain,
    *,
    tolerance: float = 1e-6,
    max_pieces: int = _MAX_PIECES,
) -> Verdict:
    """Return a proof that a condition holds for all states of a box, or a state where it fails.

    The states are those of the regions with an inside, as in `output_range`.

    Args:
        tree: any tree.
        condition: with coefficients (d,) and (o,).
        box: bounded.
        tolerance: with a tanh head, a condition may be called kept that fails by no more than this.
        max_pieces: refuse to look at more.

    Raises:
        ValueError: the box is unbounded, the head multiplies outputs, or the condition does not fit the tree.
        OtrError: more than `max_pieces` regions would have to be looked at.
    """
    _require_known_head(tree)
    return Search(tree, condition, _bounded(tree, box), tolerance).run(max_pieces)


def check_verdict(verdict: Verdict, tree: ObliqueTree, condition: Condition, box: Box | Domain) -> None:
    """Check what `find_violation` answered, without a solver: its pieces and multipliers, or the state where it fails.

    Raises:
        CertificateError: it is not shown; the message names the leaf.
        ValueError: as in `find_violation`.
    """
    _require_known_head(tree)
    Search(tree, condition, _bounded(tree, box), verdict.tolerance).check(verdict)


def _require_known_head(tree: ObliqueTree) -> None:
    if not isinstance(tree, ObliqueTree):
        raise TypeError(f"tree is a {type(tree).__name__}, expected an ObliqueTree; otr.map_network makes one")
    if not tree.head.acts_by_output:
        raise ValueError(
            f"the head {type(tree.head).__name__} multiplies outputs, which no linear program bounds; "
            "otr.control.constant_gains(tree, X) returns an affine tree with the gains averaged"
        )


def _bounded(tree: ObliqueTree, box: Box | Domain) -> Domain:
    domain = as_domain(box, tree.n_inputs)
    domain.require_bounded()
    return domain


def _reached(tree: ObliqueTree, domain: Domain, tolerance: float) -> tuple[IntArray, Rows, NDArray[np.int8]]:
    """Return the leaves with an inside, and the rows and signs of their regions."""
    rows, signs = leaf_rows(tree, domain, np.arange(tree.n_leaves))
    balls = largest_balls(rows, np.arange(tree.n_leaves), signs, Bases.start(tree.n_leaves, tree.n_inputs), tolerance)
    leaves = np.flatnonzero(~balls.is_empty)
    return leaves, rows.take(leaves), signs[leaves]
