"""Questions about a tree on a box, answered exactly: the range of its actions, and whether a linear condition holds.

A leaf counts if a real point reaches it, however thin its region: where floating point cannot tell, rational arithmetic
does. Each leaf's region is a polytope and its outputs are affine there, so every question is a linear program a leaf. A
head that clips is affine in pieces; tanh is bounded by lines, and a piece is cut in two where these are too loose
(branch and bound).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from otr.core.arrays import FloatArray, IntArray
from otr.core.domain import Box, Domain, as_domain
from otr.core.tree import ObliqueTree
from otr.geometry.largest_balls import largest_balls
from otr.geometry.largest_values import largest_values
from otr.geometry.regions import leaf_rows
from otr.geometry.simplex import Bases
from otr.proof.branch_and_bound import Search
from otr.proof.exact_cells import decide, largest_over, stacked
from otr.proof.exact_rows import TreeOnDomain
from otr.proof.head_bounds import require_decided
from otr.proof.verdict import Condition, Question, Verdict

_MAX_PIECES = 2**17


@dataclass(frozen=True)
class OutputRange:
    """The smallest and the largest value of every action on a box, and a state where it is taken, or near to which.

    Attributes:
        low, high: (o,) actions.
        low_states, high_states: (o, d).
    """

    low: FloatArray
    high: FloatArray
    low_states: FloatArray
    high_states: FloatArray


def output_range(tree: ObliqueTree, box: Box | Domain) -> OutputRange:
    """Return the minimum and maximum of every action over a box, to the rounding of a linear program.

    Regions are closed: where the tree jumps at a test, the value on either side counts.

    Raises:
        ValueError: the box is unbounded, the head multiplies outputs, or the tree answers with labels (then
            `reachable_labels` tells).
    """
    _require_known_head(tree)
    if tree.labels is not None:
        raise ValueError("the tree answers with labels, which have no range; use reachable_labels(tree, box)")
    domain = _bounded(tree, box)
    wide, thin = _reached(tree, domain)
    o = tree.n_outputs
    values, every = _largest_outputs(TreeOnDomain(tree, domain), thin)
    if len(wide):
        rows, signs = leaf_rows(tree, domain, wide)
        forms = domain.scaled(tree.leaf_forms[wide])
        objectives = np.concatenate((-forms, forms), axis=1).reshape(len(wide) * 2 * o, -1)
        best = largest_values(rows, np.repeat(np.arange(len(wide)), 2 * o), np.repeat(signs, 2 * o, axis=0), objectives)
        of_wide = np.clip(domain.unscaled(best.states), domain.low, domain.high).reshape(len(wide), 2 * o, -1)
        values = np.concatenate((best.values.reshape(len(wide), 2 * o), values))
        every = np.concatenate((of_wide, every))
    states = every[values.argmax(axis=0), np.arange(2 * o)]
    low, high = (np.asarray(tree.head(y)) for y in (-values.max(axis=0)[:o], values.max(axis=0)[o:]))
    return OutputRange(low, high, states[:o], states[o:])


def reachable_labels(tree: ObliqueTree, box: Box | Domain | None = None) -> IntArray:
    """Return the labels of the leaves that some real point of a box reaches, ascending; to 1e150 on an open side.

    Raises:
        ValueError: the tree has no labels.
    """
    require_decided(tree)
    if tree.labels is None:
        raise ValueError("the tree has no labels; use output_range(tree, box)")
    return np.unique(tree.labels[np.concatenate(_reached(tree, as_domain(box, tree.n_inputs)))])


def find_violation(
    tree: ObliqueTree,
    condition: Condition,
    box: Box | Domain,
    *,
    tolerance: float = 1e-6,
    max_pieces: int = _MAX_PIECES,
) -> Verdict:
    """Return a proof that a condition holds for all states of a box, or a state where it fails.

    It holds where it does at every real point of the box; a state that fails it does so under the tree's own answer.

    Args:
        tree: any tree.
        condition: with coefficients (d,) and (o,).
        box: bounded.
        tolerance: with a head that goes through tanh or exp, a condition may be called kept that fails by no more than
            this.
        max_pieces: refuse to look at more.

    Raises:
        ValueError: the box is unbounded, the head multiplies outputs, the condition does not fit the tree, or the
            tolerance is no number of at least 0.
        OtrError: more than `max_pieces` regions would have to be looked at.
    """
    _require_known_head(tree)
    if not 0 <= tolerance < np.inf:
        raise ValueError(f"tolerance is {tolerance}, expected a number of at least 0")
    return Search(Question(tree, condition, _bounded(tree, box)), tolerance).run(max_pieces)


def check_verdict(verdict: Verdict, tree: ObliqueTree, condition: Condition, box: Box | Domain) -> None:
    """Check what `find_violation` answered, in exact arithmetic and without a solver: its proof, or where it fails.

    Raises:
        CertificateError: it is not shown; the message names the leaf.
        ValueError: as in `find_violation`.
    """
    _require_known_head(tree)
    Question(tree, condition, _bounded(tree, box)).check(verdict)


def _require_known_head(tree: ObliqueTree) -> None:
    require_decided(tree)
    if not tree.head.acts_by_output:
        raise ValueError(
            f"the head {type(tree.head).__name__} multiplies outputs, which no linear program bounds; "
            "otr.control.constant_gains(tree, X) returns an affine tree with the gains averaged"
        )


def _bounded(tree: ObliqueTree, box: Box | Domain) -> Domain:
    domain = as_domain(box, tree.n_inputs)
    domain.require_bounded()
    return domain


def _reached(tree: ObliqueTree, domain: Domain) -> tuple[IntArray, IntArray]:
    """Return the leaves that some real point reaches: those in which a ball was found, and the thinner ones."""
    rows, signs = leaf_rows(tree, domain, np.arange(tree.n_leaves))
    balls = largest_balls(rows, np.arange(tree.n_leaves), signs, Bases.start(tree.n_leaves, tree.n_inputs))
    undecided = np.flatnonzero(~balls.is_empty & (balls.radii == 0)).tolist()
    exact = TreeOnDomain(tree, domain) if undecided else None
    thin = [leaf for leaf in undecided if exact and isinstance(decide(exact.rows_of_leaf(leaf), tree.n_inputs), tuple)]
    return np.flatnonzero(balls.radii > 0), np.array(thin, dtype=np.int64)


def _largest_outputs(exact: TreeOnDomain, leaves: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the largest values (n, 2 o) of leaves' negative outputs, then of their outputs, and the states where."""
    tree = exact.tree
    n_values = 2 * tree.n_outputs
    values, states = np.zeros((len(leaves), n_values)), np.zeros((len(leaves), n_values, tree.n_inputs))
    forms = tree.leaf_forms
    for at, leaf in enumerate(leaves.tolist()):
        rows = stacked(exact.rows_of_leaf(leaf), tree.n_inputs)
        for i, form in enumerate((*-forms[leaf], *forms[leaf])):
            values[at, i], states[at, i] = largest_over(rows, form, exact.domain)
    return values, states
